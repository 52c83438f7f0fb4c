"""Who is on the buses, and the judgement of the pre-flight about it."""

from __future__ import annotations

import asyncio
from pathlib import Path

import numpy as np
import pytest
from bench_robot import Bench

from drivers.errors import DriverError
from drivers.survey import survey
from sim.moteus_emulator import MoteusEmulator
from trotd.check import check_system, check_timing, judge_gravity, judge_motors

WANTED = {(1, 11): "FL abduction", (1, 12): "FL hip", (2, 21): "FR abduction"}


def find(bench: Bench):
    return asyncio.run(survey(bench.bus, range(1, 5)))


def test_everybody_is_found_as_it_is_and_nobody_is_energised():
    bench = Bench()
    bench.servos[0].fail(38)
    bench.servos[1].position = 0.25
    bench.servos[2].silent = True
    found = {(motor.bus, motor.id): motor for motor in find(bench)}
    assert len(found) == 11
    assert "over-temperature" in found[1, 11].state
    assert found[1, 12].position == pytest.approx(np.pi / 2, abs=1e-4)
    assert (found[1, 12].voltage, found[1, 12].firmware, found[1, 12].replies) == (24.0, "0.1.6", 1)
    assert {servo.mode for servo in bench.servos} <= {0, 1}


def test_two_motors_with_one_id_answer_twice():
    bench = Bench()
    bench.bus.servos[0, 99] = MoteusEmulator(11)
    assert {(m.bus, m.id): m.replies for m in find(bench)}[1, 11] == 2


def test_each_motor_gets_its_row():
    bench = Bench()
    bench.servos[0].fail(40)
    bench.servos[3].silent = True
    rows = {row.what: row for row in judge_motors(WANTED, find(bench))}
    assert rows["FL abduction (id 11, bus 1)"].verdict == "fail"
    assert "under-voltage" in rows["FL abduction (id 11, bus 1)"].found
    assert rows["FL hip (id 12, bus 1)"].verdict == "ok"
    assert rows["FR abduction (id 21, bus 2)"].found == "no answer"
    assert rows["id 13, bus 1"].verdict == "warn"
    assert len(rows) == 3 + 9


def test_a_motor_on_the_wrong_bus_is_pointed_at():
    bench = Bench(bus=((2, 1, 1), (2, 2, 2), (3, 3, 3), (4, 4, 4)))
    rows = {row.what: row for row in judge_motors(WANTED, find(bench))}
    assert "answers on bus 2" in rows["FL abduction (id 11, bus 1)"].advice


@pytest.mark.parametrize(
    ("force", "verdict"),
    [
        ((0.0, 0.0, 9.8), "ok"),
        ((0.5, 0.0, 9.78), "ok"),
        ((0.0, 0.0, -9.8), "fail"),
        ((0.0, 6.0, 7.75), "warn"),
        ((0.0, 0.0, 8.0), "fail"),
        ((0.0, 0.0, 0.0), "fail"),
    ],
)
def test_gravity_must_have_its_size_and_direction(force, verdict):
    assert judge_gravity(np.array(force)).verdict == verdict


def test_system_and_timing_are_told(tmp_path: Path):
    governor = tmp_path / "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor"
    governor.parent.mkdir(parents=True)
    governor.write_text("powersave\n")
    rows = {row.what: row for row in check_system(tmp_path)}
    assert (rows["CPU governor"].verdict, rows["CPU governor"].advice) == ("warn", "performance")
    assert rows["isolated cores"].verdict == "warn"
    (timing,) = asyncio.run(check_timing(200.0, 0.1))
    assert "lateness" in timing.found


def test_a_bus_that_is_missing_is_an_error_and_not_an_empty_table():
    bench = Bench()

    async def refuse(receive):
        raise DriverError("bus 1 (socketcan can0): no such device")

    bench.bus.open = refuse  # type: ignore[method-assign]
    with pytest.raises(DriverError, match="no such device"):
        find(bench)
