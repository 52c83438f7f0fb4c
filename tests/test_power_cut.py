"""The power is cut between any two steps of writing a state file: the next start finds the old one or the new one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import msgspec
import numpy as np
import pytest
from daemons import make_policy
from faults.power import Disk, PowerCut

from drivers import calibration
from drivers.calibration import Calibration, fingerprint
from drivers.commissioning import FoundJoint, joint_name
from drivers.durable import replacing
from runtime import config, policies, recording
from runtime.control.policy import encode_policy
from runtime.cycle import Fault
from runtime.faults import FaultHistory, fault_file
from runtime.messages.fault import Evidence
from runtime.messages.mode import Mode
from runtime.messages.tick import TICK_DTYPE
from runtime.recording import Header, layout, list_recordings
from trotd.commission.steps import Commission, Task

NAMES = ("first", "second", "third")
COINS = 6
STOCH3 = config.load(config.find_robot("stoch3"))
assert STOCH3.motors is not None
MOTORS = STOCH3.motors


@dataclass
class Kept:
    """A kind of state file: one after the other is written, and the next start says which it finds."""

    write: Callable[[Path, str], None]
    find: Callable[[Path], set[str]]
    """Names of what is there and whole; raises where something half is believed."""
    shelf: bool = False
    """All that were written stay, instead of the newest."""
    once: bool = False
    """What is there already is not written again."""


def write_policy(folder: Path, name: str) -> None:
    from drivers.durable import write_whole

    write_whole(folder / "policies" / "stoch3.json", encode_policy(msgspec.structs.replace(make_policy(), name=name)))


def find_policy(folder: Path) -> set[str]:
    path = folder / "policies" / "stoch3.json"
    return {policies.load(path, "stoch3").name} if path.exists() else set()


def made(name: str) -> Calibration:
    date = datetime(2026, 1, 1 + NAMES.index(name), tzinfo=UTC)
    return Calibration(
        version=calibration.VERSION,
        robot="stoch3",
        body=fingerprint(STOCH3.robot, MOTORS),
        date=date,
        id=MOTORS.id,
        bus=MOTORS.bus,
        direction=MOTORS.direction,
        offset=MOTORS.offset,
        mount=(1.0, 0.0, 0.0, 0.0),
    )


def write_calibration(folder: Path, name: str) -> None:
    calibration.save(made(name), folder / "calibration" / "stoch3.json")


def find_calibration(folder: Path) -> set[str]:
    path = folder / "calibration" / "stoch3.json"
    if not path.exists():
        return set()
    date = calibration.load(path, STOCH3.robot, MOTORS).date
    return {name for name in NAMES if made(name).date == date}


def write_recording(folder: Path, name: str) -> None:
    ticks = np.zeros(20, TICK_DTYPE)
    header = Header(
        robot="stoch3",
        robot_toml="",
        policy="",
        rate_hz=200.0,
        reason=name,
        written="",
        versions={},
        layout=layout(),
        itemsize=TICK_DTYPE.itemsize,
        events=[],
    )
    recording.save(folder / f"{name}.trotd", header, [ticks[:9].tobytes(), ticks[9:].tobytes()])


def find_recordings(folder: Path) -> set[str]:
    found = [recording.load(path) for path in list_recordings(folder)]
    assert all(len(one.ticks) == 20 for one in found)
    return {one.header.reason for one in found}


def write_fault(folder: Path, name: str) -> None:
    history = FaultHistory(fault_file(folder, "stoch3"))
    history.take(Fault(NAMES.index(name), Mode.WALK, Mode.DAMP, Evidence(reason="tilted", words=name)))
    history.save()
    assert not history.problem


def find_faults(folder: Path) -> set[str]:
    history = FaultHistory(fault_file(folder, "stoch3"))
    assert not history.problem
    found = [record.evidence.words for record in history.records]
    assert found == list(NAMES[: len(found)]), "oldest first, none twice"
    return set(found)


def commission(folder: Path) -> Commission:
    def nobody(_task: Task) -> str:
        raise AssertionError("nothing is asked")

    return Commission(STOCH3, MOTORS, folder / "stoch3.json", None, nobody)  # type: ignore[arg-type]


def write_progress(folder: Path, name: str) -> None:
    """What commissioning does with every joint that it found."""
    one = commission(folder)
    one._found(joint_name(0, NAMES.index(name)), FoundJoint((1, 11 + NAMES.index(name)), 1.0))


def find_progress(folder: Path) -> set[str]:
    joints = commission(folder).progress.joints
    return {name for index, name in enumerate(NAMES) if joint_name(0, index) in joints}


KINDS = {
    "policy": Kept(write_policy, find_policy),
    "calibration": Kept(write_calibration, find_calibration),
    "recording": Kept(write_recording, find_recordings, shelf=True),
    "fault history": Kept(write_fault, find_faults, shelf=True, once=True),
    "commissioning": Kept(write_progress, find_progress, shelf=True, once=True),
}


def cut_at(folder: Path, kind: Kept, cut: int, seed: int) -> tuple[int, bool, list[str]]:
    """Write all, with the power cut before step ``cut``: how many were written, whether it was cut, the steps."""
    folder.mkdir()
    written = 0
    with pytest.MonkeyPatch.context() as patched:
        disk = Disk(patched, folder, cut, seed)
        try:
            for name in NAMES:
                kind.write(folder, name)
                written += 1
        except PowerCut:
            pass
    if written < len(NAMES):
        disk.lose()
    return written, written < len(NAMES), disk.steps


@pytest.mark.parametrize("name", KINDS)
def test_no_cut_loses_or_halves_anything(tmp_path: Path, name: str) -> None:
    kind = KINDS[name]
    _, _, steps = cut_at(tmp_path / "whole", kind, 0, 0)
    assert steps.count("replace") == len(NAMES) and len(steps) >= 5 * len(NAMES)
    for cut in range(1, len(steps) + 1):
        for seed in range(COINS):
            folder = tmp_path / f"{cut}-{seed}"
            written, was_cut, _ = cut_at(folder, kind, cut, seed)
            assert was_cut
            certain = set(NAMES[:written]) if kind.shelf else set(NAMES[:written][-1:])
            under_way = NAMES[written]
            allowed = (certain, certain | {under_way}) if kind.shelf else (certain, {under_way})
            assert kind.find(folder) in allowed, f"power cut before step {cut} ({steps[cut - 1]}), coins {seed}"
            if under_way not in kind.find(folder) or not kind.once:
                kind.write(folder, under_way)
            assert under_way in kind.find(folder), "what the cut left is in the way of the next write"


@pytest.mark.parametrize("flaw", ["no sync", "in place"])
def test_the_disk_loses_what_a_careless_program_writes(tmp_path: Path, flaw: str) -> None:
    """The proof that the cuts above could have been seen."""

    def careless(folder: Path, name: str) -> None:
        folder.mkdir(exist_ok=True)
        path = folder / "policies.json"
        data = encode_policy(msgspec.structs.replace(make_policy(), name=name))
        part = path if flaw == "in place" else path.with_suffix(".part")
        with part.open("wb") as file:
            file.write(data)
        if part != path:
            part.replace(path)

    def find(folder: Path) -> set[str]:
        path = folder / "policies.json"
        return {policies.load(path, "stoch3").name} if path.exists() else set()

    kind, halves = Kept(careless, find), 0
    for cut in range(1, 10):
        for seed in range(COINS):
            folder = tmp_path / f"{cut}-{seed}"
            _, was_cut, _ = cut_at(folder, kind, cut, seed)
            try:
                find(folder)
            except policies.PolicyError:
                halves += was_cut
    assert halves > 0


def test_what_fails_to_be_written_in_the_middle_leaves_the_old_one(tmp_path: Path) -> None:
    write_policy(tmp_path, "first")
    path = tmp_path / "policies" / "stoch3.json"
    with pytest.raises(ZeroDivisionError), replacing(path) as file:
        file.write(b"half")
        raise ZeroDivisionError
    assert find_policy(tmp_path) == {"first"} and list(path.parent.iterdir()) == [path]
