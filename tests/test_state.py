"""A state folder that takes nothing: the daemon says so in one line, starts in DAMP, and walks when it is asked to."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from daemons import PATIENCE, Served, make_config, quick_robot, running, status_when
from disks import fill, forbid, small_file_system

from drivers import durable
from runtime.messages.mode import Mode
from runtime.messages.recording import RecordingReply
from runtime.state import AlreadyRunning, LockError, lock, refusal
from station.monitor import Level, examine, gather
from station.requests import set_off
from station.session import Station


def full(folder: Path) -> None:
    fill(folder, leave=0)


def read_only(folder: Path) -> None:
    forbid(folder)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    with small_file_system(tmp_path / "disk") as disk:
        yield disk


def told(served: Served) -> list[str]:
    return [event.text for event in served.daemon.link.history if event.kind == "state"]


def examined(served: Served) -> Callable[[Station], Level]:
    def act(station: Station) -> Level:
        ticks, lost = gather(station, 0.5)
        (disk,) = (c for c in examine(ticks, station.next_status(), served.config, lost) if c.name == "disk")
        return disk.level

    return act


@pytest.mark.parametrize(("spoil", "why"), [(full, "No space left on device"), (read_only, "Read-only file system")])
def test_a_start_on_a_disk_that_refuses_is_damped_reachable_and_tells(
    small_disk: Path, tmp_path: Path, spoil: Callable[[Path], None], why: str
) -> None:
    folder = small_disk / "state"
    folder.mkdir()
    spoil(small_disk if spoil is full else folder)

    async def main() -> None:
        memory = tmp_path / "memory"
        memory.mkdir()
        served = Served(make_config(), folder, memory=memory)
        async with served:
            status = await served.client(lambda station: station.next_status())
            assert status.mode == "DAMP" and not status.armed and status.recordings_refused == {why: 1}
            assert told(served) == [f"{folder}: {why}: recordings, faults, policies and tuning cannot be kept"]
            assert await served.client(examined(served)) is Level.WARNING
            second = Served(served.config, folder, memory=memory)
            with pytest.raises(AlreadyRunning, match=served.config.robot.name):
                async with second:
                    pass
            await served.walk()
            reply = await served.client(
                lambda station: station.ask_for(RecordingReply, station.keys.recording, parameters="write")
            )
            assert not reply.accepted and why in reply.reason
            assert served.daemon.cycle.state.mode is Mode.WALK
        assert served.body.closed

    asyncio.run(main())
    assert not [path for path in folder.rglob("*") if path.suffix in (".part", ".probe", ".trotd")]


def test_a_disk_that_refuses_at_the_door_of_every_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    @contextlib.contextmanager
    def refuse(_path: Path) -> Iterator[None]:
        raise OSError(errno.EIO, os.strerror(errno.EIO))
        yield

    monkeypatch.setattr(durable, "replacing", refuse)

    async def main() -> None:
        async with Served(make_config(), tmp_path) as served:
            assert "Input/output error" in told(served)[0]
            await served.stand()

    asyncio.run(main())


def test_the_command_starts_on_a_read_only_folder_that_is_not_even_there(small_disk: Path, tmp_path: Path) -> None:
    forbid(small_disk)
    with running(tmp_path, quick_robot(tmp_path), "null", small_disk / "state") as (process, station):
        set_off(station)
        status_when(station, lambda status: status.mode == "WALK")
        process.send_signal(signal.SIGTERM)
        log = process.communicate(timeout=PATIENCE)[1]
    assert process.returncode == 0 and "Traceback" not in log
    (line,) = (line for line in log.splitlines() if " state: " in line)
    assert f"{small_disk / 'state'}: Read-only file system: recordings, faults, policies and tuning" in line


def test_a_lock_that_finds_no_room_on_the_disk_lies_in_memory_and_counts(small_disk: Path, tmp_path: Path) -> None:
    folder, memory = small_disk / "state", tmp_path
    mend = forbid(small_disk)
    with pytest.raises(LockError, match="Read-only file system"), lock(folder, "r"):
        pass
    with lock(folder, "r", memory):
        with pytest.raises(AlreadyRunning, match=str(os.getpid())), lock(folder, "r", memory):
            pass
        mend()
        with pytest.raises(AlreadyRunning), lock(folder, "r", memory):
            pass
    with lock(folder, "r", memory):
        forbid(small_disk)
        with pytest.raises(AlreadyRunning), lock(folder, "r", memory):
            pass


def test_a_folder_that_takes_what_is_written_is_left_as_it_was(tmp_path: Path) -> None:
    assert refusal(tmp_path) == "" and list(tmp_path.iterdir()) == []
