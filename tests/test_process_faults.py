"""What happens to the process around the loop: signals, a busy or a stopped processor, disks, clients, clocks."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import gc
import json
import os
import random
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path

import pytest
import zenoh
from daemons import PATIENCE, Served, free_endpoint, is_damp, make_config, quick_robot, running, status_when

from drivers import durable
from runtime.link import session_config
from runtime.messages.mode import Mode, ModeReply, Request
from runtime.messages.recording import RecordingReply
from runtime.recording import list_recordings, load
from station.requests import CENTRED, set_off
from station.session import Station, StationError, connected

FORWARD = b'{"linear": [0.3, 0.0], "yaw_rate": 0.0}'


def serve(folder: Path, act: Callable[[Served], Awaitable[None]], **changes: object) -> Served:
    async def main() -> Served:
        served = Served(make_config(**changes), folder)
        async with served:
            await act(served)
        return served

    return asyncio.run(main())


async def stopped_by_the_operator(served: Served) -> None:
    """The one thing that must always work, and go out at once."""
    assert (await served.ask("damp")).accepted
    await served.ticks(2)
    assert is_damp(served.body.commands[-1]) and served.daemon.cycle.state.mode is Mode.DAMP


def ended_in_damp(served: Served) -> bool:
    return all(is_damp(command) for command in served.body.commands[-3:]) and bool(served.body.closed)


async def into(served: Served, mode: Mode) -> None:
    """Be in ``mode`` now."""
    if mode is Mode.DAMP:
        return
    if mode is Mode.STAND_UP:
        for wish in (Request.ARM, Request.STAND):
            assert served.daemon.take_request(wish).accepted
        return
    await served.stand()
    if mode is not Mode.STAND:
        assert served.daemon.take_request(Request.WALK if mode is Mode.WALK else Request.SIT).accepted
    await served.ticks(2)


@pytest.mark.parametrize("mode", Mode)
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_in_every_mode_ends_in_damp(tmp_path: Path, mode: Mode, number: signal.Signals) -> None:
    async def act(served: Served) -> None:
        await into(served, mode)
        os.kill(os.getpid(), number)
        await served.task

    assert ended_in_damp(serve(tmp_path, act))


def test_a_storm_of_garbage_does_not_reach_the_loop(tmp_path: Path) -> None:
    class Node:
        pass

    def litter(stop: threading.Event) -> None:
        while not stop.is_set():
            for _ in range(2000):
                one, other = Node(), Node()
                one.other, other.other = other, one  # type: ignore[attr-defined]
            gc.collect()

    async def act(served: Served) -> None:
        await served.walk()
        stop = threading.Event()
        storm = threading.Thread(target=litter, args=(stop,))
        storm.start()
        try:
            await served.ticks(150)
            assert not served.task.done()
            await stopped_by_the_operator(served)
        finally:
            stop.set()
            storm.join()

    assert ended_in_damp(serve(tmp_path, act))


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EROFS, errno.EIO])
def test_a_disk_that_refuses_is_told_and_the_walk_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int
) -> None:
    @contextlib.contextmanager
    def refuse(_path: Path) -> Iterator[None]:
        raise OSError(code, os.strerror(code))
        yield

    async def act(served: Served) -> None:
        await served.walk()
        monkeypatch.setattr("runtime.recording.replacing", refuse)
        monkeypatch.setattr(durable, "replacing", refuse)
        reply = await served.client(
            lambda station: station.ask_for(RecordingReply, station.keys.recording, parameters="write")
        )
        assert not reply.accepted and os.strerror(code) in reply.reason
        await served.ticks(20)
        assert served.daemon.cycle.state.mode is Mode.WALK
        assert any(os.strerror(code) in event.text for event in served.daemon.link.history)
        await stopped_by_the_operator(served)

    served = serve(tmp_path, act)
    assert ended_in_damp(served)
    assert not list(tmp_path.rglob("*.trotd"))


def test_a_disk_that_hangs_holds_up_neither_the_loop_nor_the_stop_nor_the_damping(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    free, hanging = threading.Event(), threading.Event()
    sync = os.fsync

    def hang(fd: int) -> None:
        hanging.set()
        free.wait(PATIENCE)
        sync(fd)

    seen: list[bool] = []

    async def act(served: Served) -> None:
        await served.walk()
        monkeypatch.setattr(durable.os, "fsync", hang)
        done = asyncio.get_running_loop().run_in_executor(
            None, lambda: _write_recording(served.config.robot.name, served.config.link.listen[0])
        )
        await served.until(hanging.is_set)
        await served.ticks(40)
        assert served.daemon.cycle.state.mode is Mode.WALK
        watcher = threading.Thread(target=_free_once_damped, args=(served, free, seen))
        watcher.start()
        served.daemon.stop()
        await asyncio.wait([served.task])
        watcher.join()
        with contextlib.suppress(StationError):
            await done

    served = serve(tmp_path, act)
    assert ended_in_damp(served)
    assert seen == [True], "the disk was waited for before the robot was damped"


def _write_recording(robot: str, endpoint: str) -> None:
    with connected(robot, endpoint, PATIENCE) as station:
        station.ask(station.keys.recording, parameters="write")


def _free_once_damped(served: Served, free: threading.Event, seen: list[bool]) -> None:
    """Lets the disk go on as soon as the body was damped; or after a while, which is the failure."""
    end = time.monotonic() + 60.0
    count = len(served.body.commands)
    while time.monotonic() < end:
        last = served.body.commands[-3:]
        if len(served.body.commands) >= count + 3 and all(is_damp(command) for command in last):
            seen.append(True)
            break
        time.sleep(0.005)
    else:
        seen.append(False)
    free.set()


def test_a_router_that_goes_away_stops_the_walk_and_not_the_daemon(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    router = zenoh.open(session_config("router", [endpoint], []))

    async def act(served: Served) -> None:
        with connected(served.config.robot.name, endpoint) as station:
            await served.walk()
            token = await asyncio.to_thread(
                station.session.liveliness().declare_token, f"{station.keys.operator}/through-the-router"
            )
            station.session.put(station.keys.velocity, FORWARD)
            await served.ticks(20)
            assert token is not None
            await asyncio.to_thread(router.close)  # type: ignore[arg-type]
            await served.reach(Mode.STAND)
        await stopped_by_the_operator(served)

    assert ended_in_damp(serve(tmp_path, act, link__connect=[endpoint]))


def test_a_joystick_that_is_killed_stops_the_walk(tmp_path: Path) -> None:
    async def act(served: Served) -> None:
        code = (
            "import select, sys, time; from station.session import connected\n"
            "with connected(sys.argv[1], sys.argv[2]) as s:\n"
            "    t = s.session.liveliness().declare_token(s.keys.operator + '/me')\n"
            "    told = False\n"
            "    while True:\n"
            "        told = told or bool(select.select([sys.stdin], [], [], 0)[0])\n"
            "        s.session.put(s.keys.velocity, sys.argv[3 + told].encode())\n"
            "        print('x', flush=True); time.sleep(0.02)"
        )
        arguments = [served.config.robot.name, served.config.link.listen[0], CENTRED.decode(), FORWARD.decode()]
        with subprocess.Popen(  # noqa: ASYNC220
            [sys.executable, "-c", code, *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        ) as pad:
            assert pad.stdout is not None and pad.stdin is not None
            await asyncio.to_thread(pad.stdout.readline)  # it speaks: a walk without a word would end by itself
            await served.walk()
            pad.stdin.write(b"forward\n")
            pad.stdin.flush()
            await served.until(lambda: bool(served.daemon.cycle.tick["asked_velocity"][0, 0]))
            assert served.daemon.cycle.state.mode is Mode.WALK
            pad.kill()
            await served.reach(Mode.STAND)
        await served.until(lambda: any("operator is gone" in event.text for event in served.daemon.link.history))

    assert ended_in_damp(serve(tmp_path, act))


def test_a_crowd_at_the_door_and_garbage_from_it(tmp_path: Path) -> None:
    """Connections that say nothing or nonsense, and a few clients that listen to everything."""
    crowd = 1000

    def storm(host: str, port: int, rng: random.Random) -> None:
        with contextlib.ExitStack() as stack:
            for index in range(crowd):
                try:
                    door = stack.enter_context(socket.create_connection((host, port), timeout=5.0))
                    if index % 2:
                        door.sendall(rng.randbytes(rng.randrange(1, 300)))
                except OSError:
                    continue  # turned away at the door is as good

    async def act(served: Served) -> None:
        await served.walk()
        host, port = served.config.link.listen[0].removeprefix("tcp/").split(":")
        robot, endpoint = served.config.robot.name, served.config.link.listen[0]
        with contextlib.ExitStack() as stack:
            heard: list[int] = []
            for _ in range(8):
                station = stack.enter_context(connected(robot, endpoint))
                station.session.declare_subscriber(f"{station.keys.root}/**", lambda _sample: heard.append(1))
            await asyncio.to_thread(storm, host, int(port), random.Random(7))
            await served.ticks(40)
            await served.until(lambda: bool(heard))
            assert not served.task.done()
        await stopped_by_the_operator(served)

    assert ended_in_damp(serve(tmp_path, act))


def test_garbage_on_every_key_moves_nothing(tmp_path: Path) -> None:
    rng = random.Random(11)
    nearly = [b'{"linear": [NaN, 0], "yaw_rate": 0}', b'{"linear": [1e99, 0], "yaw_rate": 0}', b"[" * 5000, b"", b"\0"]

    def shout(station: Station) -> None:
        keys = station.keys
        for _ in range(150):
            payload = rng.choice([*nearly, rng.randbytes(rng.randrange(2000))])
            for key in (keys.velocity, keys.mode, keys.policy, keys.recording, keys.alive, f"{keys.root}/no/such/key"):
                station.session.put(key, payload)
            station.session.delete(rng.choice([keys.velocity, keys.status]))
        for key in (keys.mode, keys.policy, keys.recording, keys.tick_schema, keys.event):
            for payload in (*nearly[:3], rng.randbytes(500)):
                with contextlib.suppress(StationError):
                    station.ask(key, payload, parameters=rng.choice(["", "name=../../etc/passwd", "rollback", "=;&"]))

    async def act(served: Served) -> None:
        await served.stand()
        await served.ticks(20)
        before, policy = served.daemon.cycle.state, served.daemon.cycle.policy
        await served.client(shout)
        await served.ticks(20)
        assert served.daemon.cycle.state == before and served.daemon.cycle.policy is policy
        await stopped_by_the_operator(served)

    assert ended_in_damp(serve(tmp_path, act))


def test_a_wall_clock_that_jumps_is_not_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rng, now = random.Random(3), time.time

    async def act(served: Served) -> None:
        monkeypatch.setattr(time, "time", lambda: now() + rng.uniform(-3e7, 3e7))
        await served.walk()
        await served.ticks(100)
        assert served.daemon.cycle.state.mode is Mode.WALK
        reply = await served.client(
            lambda station: station.ask_for(RecordingReply, station.keys.recording, parameters="write")
        )
        assert load(Path(reply.path)).header.reason == "asked for"
        monkeypatch.setattr(time, "time", now)

    assert ended_in_damp(serve(tmp_path, act))


# Daemons of their own -------------------------------------------------------------------------------------------------


def walk(station: Station) -> None:
    set_off(station)
    station.session.put(station.keys.velocity, FORWARD)


def end(process: subprocess.Popen[str]) -> None:
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=PATIENCE)
    assert process.returncode == 0


def test_a_process_that_is_stopped_and_goes_on_counts_what_it_missed_and_stands(tmp_path: Path) -> None:
    robot = quick_robot(tmp_path, tables=("posture", "arming", "limits"))
    with running(tmp_path, robot, "null") as (process, station):
        walk(station)
        before = station.next_status()
        process.send_signal(signal.SIGSTOP)
        time.sleep(2.5)
        process.send_signal(signal.SIGCONT)
        status_when(station, lambda status: status.overruns - before.overruns >= 300)
        rested = status_when(station, lambda status: status.mode != "WALK")  # nobody has said anything for too long
        assert rested.mode in ("STAND", "DAMP") and rested.velocity_command == (0.0, 0.0, 0.0)
        assert station.ask_for(ModeReply, station.keys.mode, b"damp").accepted
        end(process)


def test_the_operators_stop_gets_through_while_another_process_takes_the_core(tmp_path: Path) -> None:
    core = min(os.sched_getaffinity(0))
    with running(tmp_path, quick_robot(tmp_path), "null") as (process, station):
        walk(station)
        for task in Path(f"/proc/{process.pid}/task").iterdir():
            with contextlib.suppress(ProcessLookupError):
                os.sched_setaffinity(int(task.name), {core})
        hogs = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(3)]
        try:
            for hog in hogs:
                os.sched_setaffinity(hog.pid, {core})
            time.sleep(1.0)
            reply = json.loads(station.ask(station.keys.mode, b"damp"))
            assert reply["accepted"] and reply["mode"] == "DAMP"
            assert station.next_status().mode == "DAMP"
        finally:
            for hog in hogs:
                hog.kill()
                hog.wait()
        end(process)


@pytest.mark.parametrize("mode", ["DAMP", "STAND", "WALK"])
def test_a_daemon_killed_in_any_mode_starts_again_in_damp_with_its_state_whole(tmp_path: Path, mode: str) -> None:
    robot = quick_robot(tmp_path)
    with running(tmp_path, robot, "null") as (process, station):
        if mode != "DAMP":
            walk(station)
        if mode == "STAND":
            assert station.ask_for(ModeReply, station.keys.mode, b"stand").accepted
        process.kill()
        process.wait()
    with running(tmp_path, robot, "null") as (process, station):
        first = station.next_status()
        assert first.mode == "DAMP" and not first.armed
        end(process)
    for file in list_recordings(tmp_path / "recordings" / "stoch3"):
        load(file)
