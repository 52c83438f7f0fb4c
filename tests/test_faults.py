"""The history of faults: evidence whole, kept across restarts, bounded, never half, never lost to a file of others."""

from __future__ import annotations

import asyncio
from pathlib import Path

import msgspec
import numpy as np
import pytest
from daemons import Served, make_config
from test_cycle import Bench, spoil

from runtime.cycle import Fault
from runtime.faults import KEPT, VERSION, FaultFileError, FaultHistory, fault_file, load_faults
from runtime.messages.fault import Evidence, FaultRecord
from runtime.messages.mode import Mode, Request
from runtime.reasons import Reason
from station.session import Station


def fault(tick: int) -> Fault:
    evidence = Evidence(reason="hot_motor", words="hot", where="FL knee", value=81.0, bound=80.0, unit="°C")
    return Fault(tick, Mode.WALK, Mode.STAND, evidence)


def test_a_fault_names_what_where_value_bound_and_tick() -> None:
    bench = Bench()
    bench.walk()
    hot = np.full((4, 3), 30.0)
    hot[2, 1] = 95.0
    bench.body.change = lambda m: spoil(m, temperature=hot)
    bench.tick()
    (found,) = bench.cycle.faults
    assert (found.tick, found.mode, found.led_to) == (bench.index, Mode.WALK, Mode.STAND)
    evidence = found.evidence
    assert (evidence.reason, evidence.where, evidence.unit) == ("hot_motor", "BL hip", "°C")
    assert (evidence.value, evidence.bound) == (95.0, 80.0)
    assert bench.cycle.evidence is evidence


def test_a_fault_is_cleared_by_the_operator_only_and_only_when_its_cause_is_gone() -> None:
    bench = Bench()
    bench.walk()
    good = bench.body.change
    bench.body.change = lambda m: spoil(m, temperature=np.full((4, 3), 90.0))
    bench.tick()
    assert bench.ask(Request.CLEAR) == (False, Reason.NOT_DAMPED.words)
    bench.reach(Mode.DAMP)
    bench.tick(50)
    accepted, words = bench.ask(Request.CLEAR)
    assert not accepted and "90 °C, bound 80" in words
    bench.body.change = good
    bench.tick(50)
    assert bench.cycle.state.fault is Reason.HOT_MOTOR and bench.cycle.evidence is not None, "it does not go by itself"
    assert bench.ask(Request.CLEAR)[0]
    assert bench.cycle.state.fault is Reason.OK and bench.cycle.evidence is None


def test_the_history_outlives_the_process_and_is_bounded(tmp_path: Path) -> None:
    path = fault_file(tmp_path, "stoch3")
    history = FaultHistory(path)
    for tick in range(KEPT + 5):
        history.take(fault(tick))
    history.save()
    assert not list(path.parent.glob(".*")), "nothing half written is left"
    again = FaultHistory(path)
    assert [record.tick for record in again.records] == list(range(5, KEPT + 5))
    assert again.records[-1].evidence == fault(0).evidence and again.records[-1].led_to == "STAND"


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b'{"version": 2, "faults": []}', "format 2, this program reads 1"),
        (b'{"version": 1, "faults": [{}]}', "missing required field"),
        (b"\x00\x01", "malformed"),
        (b"[]", "Expected `object`"),
    ],
)
def test_a_file_that_is_not_ours_is_named_and_put_aside(tmp_path: Path, data: bytes, words: str) -> None:
    path = fault_file(tmp_path, "stoch3")
    path.parent.mkdir()
    path.write_bytes(data)
    with pytest.raises(FaultFileError, match=words):
        load_faults(path)
    history = FaultHistory(path)
    assert words in history.problem
    history.take(fault(1))
    history.save()
    assert [record.tick for record in load_faults(path)] == [1]
    (kept,) = path.parent.glob("stoch3.json.*")
    assert kept.read_bytes() == data


def test_a_disk_that_refuses_is_noted_and_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = fault_file(tmp_path, "stoch3")
    history = FaultHistory(path)
    history.take(fault(1))

    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr("runtime.faults.write_whole", refuse)
        history.save()
    assert "No space left" in history.problem and not path.exists()
    history.save()
    assert load_faults(path)[0].tick == 1


def test_a_daemon_tells_its_history_over_the_link_and_keeps_it(tmp_path: Path) -> None:
    made = make_config()
    robot = made.robot.name

    async def break_it() -> None:
        async with Served(made, tmp_path) as served:
            await served.walk()
            served.body.change = lambda m: spoil(m, fault=np.full((4, 3), 33, np.int32))
            await served.reach(Mode.DAMP)
            status = await served.client(lambda station: station.next_status())
            assert status.evidence is not None and status.evidence.reason == "motor_fault"

    def ask(station: Station) -> list[FaultRecord]:
        return station.ask_for(list[FaultRecord], station.keys.faults)

    async def look() -> list[FaultRecord]:
        async with Served(made, tmp_path) as served:
            return await served.client(ask)

    asyncio.run(break_it())
    (kept,) = load_faults(fault_file(tmp_path, robot))
    assert kept.mode == "WALK" and kept.led_to == "DAMP" and kept.evidence.where == "FL abduction"
    assert asyncio.run(look()) == [kept]
    assert msgspec.json.decode(fault_file(tmp_path, robot).read_bytes())["version"] == VERSION
