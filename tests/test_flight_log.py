"""A disk that refuses: full, or read-only. The reason is told and counted, nothing half is left, the tick goes on."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from daemons import Served, make_config
from disks import fill, forbid, small_file_system

from drivers.robot import Measurement
from runtime.messages.mode import Mode, Request
from runtime.messages.recording import RecordingReply
from runtime.recording import list_recordings, load


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    with small_file_system(tmp_path / "disk") as disk:
        yield disk


def unfinished(folder: Path) -> list[Path]:
    return list(folder.rglob("*.part"))


def break_motor(measurement: Measurement) -> Measurement:
    fault = measurement.joints.fault.copy()
    fault[2, 1] = 7
    return replace(measurement, joints=replace(measurement.joints, fault=fault))


async def ask(served: Served) -> RecordingReply:
    reply: RecordingReply = await served.client(
        lambda station: station.ask_for(RecordingReply, station.keys.recording, parameters="write")
    )
    return reply


async def still_walks(served: Served) -> None:
    await served.ticks(4)
    assert served.daemon.cycle.state.mode is Mode.WALK and served.daemon.cycle.state.armed


def told(served: Served) -> list[str]:
    return [event.text for event in served.daemon.flight.recorder.events if event.kind == "recording"]


@pytest.mark.parametrize("trouble", ["No space left on device", "Read-only file system"])
def test_a_disk_that_refuses_is_told_and_counted_and_the_walk_goes_on(
    small_disk: Path, tmp_path: Path, trouble: str
) -> None:
    made = make_config(recorder__seconds=4.0)

    async def main() -> None:
        served = Served(made, small_disk, memory=tmp_path / "memory")
        async with served:
            await served.walk()
            await served.ticks(200)  # more than what is left on the disk
            mend = fill(small_disk) if "space" in trouble else forbid(served.daemon.flight.folder)
            for _ in range(2):
                reply = await ask(served)
                assert not reply.accepted and trouble in reply.reason
            await still_walks(served)
            served.body.change = break_motor
            await served.reach(Mode.DAMP)
            await served.until(lambda: f"{trouble} (3 times so far)" in told(served)[-1])
            assert told(served)[-1].startswith("fault: ")
            assert served.daemon.status().recordings_refused == {trouble: 3}
            assert list_recordings(served.daemon.flight.folder) == []
            assert unfinished(small_disk) == []
            served.body.change = lambda measurement: measurement
            mend()
            await served.ticks(3)
            for wish in (Request.CLEAR, Request.ARM):
                assert served.daemon.take_request(wish).accepted
            reply = await ask(served)
            assert reply.accepted and len(load(Path(reply.path)).ticks) > 10

    asyncio.run(main())


def test_a_stop_on_a_full_disk_keeps_the_ring_for_the_next_start(small_disk: Path, tmp_path: Path) -> None:
    made = make_config(recorder__seconds=4.0)
    mend: list[Callable[[], None]] = []

    async def walk_and_stop() -> None:
        async with Served(made, small_disk, memory=tmp_path / "memory") as served:
            await served.walk()
            await served.ticks(200)
            mend.append(fill(small_disk))

    async def start_again() -> Path:
        async with Served(made, small_disk, memory=tmp_path / "memory") as served:
            await served.until(lambda: bool(list_recordings(served.daemon.flight.folder)))
            return list_recordings(served.daemon.flight.folder)[0]

    asyncio.run(walk_and_stop())
    assert list_recordings(small_disk / "recordings" / made.robot.name) == []
    mend[0]()
    path = asyncio.run(start_again())
    assert path.stem.endswith("-crash") and load(path).ticks["mode"][-1] == Mode.WALK


def test_no_memory_for_the_ring_is_told_and_the_robot_serves_without(small_disk: Path, tmp_path: Path) -> None:
    made = make_config(recorder__seconds=10.0)

    async def main() -> None:
        async with Served(made, tmp_path, memory=small_disk / "memory") as served:
            await served.walk()
            await still_walks(served)
            assert any("not kept over a crash" in text and "No space left" in text for text in told(served))
            assert (await ask(served)).accepted

    asyncio.run(main())
