"""Hands to robot: what a driver does to a robot, and what a lost driver does to a walking one."""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import ExitStack, asynccontextmanager
from pathlib import Path

import pytest
from daemons import PATIENCE, Served, make_config, until
from pad_events import (
    BUMPER,
    CENTRED,
    FORWARD,
    LEFT,
    REPORT,
    RISE,
    TURN,
    XPAD,
    B,
    axis,
    button,
)

from runtime import config
from runtime.control.records import Clamp
from runtime.messages.mode import Mode, Request
from station.driving import Driving
from station.joystick import Joystick
from station.pad import PadDevice
from station.session import Station, connected

Script = Callable[[Served, "Desk"], Awaitable[None]]
EXPIRY = 3.0
"""s, more than a busy machine pauses."""


class Desk:
    """A joystick on a thread of its own, and the bytes that its pad sends."""

    def __init__(self, path: Path, fd: int) -> None:
        self.fd = fd
        self.driving = Driving(0.5, 0.4, 1.0)
        self.said: list[str] = []
        self.mode = ""
        """The robot's, as the joystick heard it."""
        self._path, self._done = path, threading.Event()

    def drive(self, station: Station) -> None:
        def note(seen: Joystick) -> None:
            self.mode = seen.status.mode if seen.status is not None else ""
            if not self.said or self.said[-1] != seen.words:
                self.said.append(seen.words)

        Joystick(station, self.driving).run(lambda: PadDevice(self._path, XPAD), note, lambda: not self._done.is_set())

    def send(self, data: bytes) -> None:
        os.write(self.fd, data)

    @asynccontextmanager
    async def at(self, served: Served) -> AsyncIterator[None]:
        driver = asyncio.get_running_loop().create_task(served.client(self.drive))
        try:
            yield
        finally:
            self._done.set()
            await driver


def _serve_and_drive(tmp_path: Path, fifo: tuple[Path, int], script: Script) -> list[str]:
    desk = Desk(*fifo)

    async def play() -> None:
        async with Served(make_config(command__expiry=EXPIRY), tmp_path) as served, desk.at(served):
            await script(served, desk)

    asyncio.run(play())
    return desk.said


def _asked(served: Served) -> list[float]:
    return [round(value, 6) for value in served.daemon.cycle.tick["asked_velocity"][0].tolist()]


async def _hears(served: Served, count: int) -> None:
    """Until the robot has heard ``count`` commands more."""
    for _ in range(count):
        last = served.daemon.cycle.sources.velocity.stamp
        await until(lambda last=last: served.daemon.cycle.sources.velocity.stamp != last)  # type: ignore[misc]


async def _lean(served: Served, desk: Desk) -> None:
    """Right, and down; from the start where the joystick did not hear the robot for a moment."""
    pose, middle = served.daemon.cycle.tick["tuned_body_pose"][0], axis(RISE, 0) + CENTRED
    async with asyncio.timeout(PATIENCE):
        while not (pose[0] > 0.2 and pose[3] < -0.05):
            if not desk.driving.posing:
                desk.send(middle + button(304) + REPORT)
            else:
                desk.send(axis(TURN, 32767) + axis(RISE, 32767) + REPORT if desk.driving.centred else middle)
            await asyncio.sleep(0.3)


async def _push_forward(served: Served, fd: int) -> None:
    """Centre the stick, then push it, as a driver would: again where a gap on a busy machine got in between."""
    async with asyncio.timeout(PATIENCE):
        while _asked(served) != [0.5, 0.0, 0.0]:
            os.write(fd, CENTRED)
            await _hears(served, 3)
            os.write(fd, axis(FORWARD, -32768) + REPORT)
            await _hears(served, 10)


def test_buttons_stand_it_up_and_sticks_walk_it_once_they_were_centred(tmp_path: Path, fifo: tuple[Path, int]) -> None:
    async def script(served: Served, desk: Desk) -> None:
        desk.send(axis(FORWARD, -32768) + axis(TURN, 0) + axis(LEFT, 0) + button(BUMPER) + button(308) + REPORT)
        await served.reach(Mode.STAND)
        desk.send(button(B))
        await served.reach(Mode.WALK)
        await _hears(served, 10)
        assert _asked(served) == [0.0, 0.0, 0.0], "the stick was never centred"
        await _push_forward(served, desk.fd)
        desk.send(button(BUMPER, 0))
        await until(lambda: _asked(served) == [0.0, 0.0, 0.0])

    said = _serve_and_drive(tmp_path, fifo, script)
    assert any(words.startswith("walk: ") for words in said)


def test_a_leans_the_standing_body_and_the_gait_button_changes_the_gait(tmp_path: Path, fifo: tuple[Path, int]) -> None:
    async def script(served: Served, desk: Desk) -> None:
        tick = served.daemon.cycle.tick
        desk.send(CENTRED + button(BUMPER) + button(308) + REPORT)
        await served.reach(Mode.STAND)
        await until(lambda: desk.mode == "STAND")
        await _lean(served, desk)
        desk.send(axis(TURN, 0) + axis(RISE, 0) + button(304) + button(310) + REPORT)
        await until(lambda: not tick["tuned_body_pose"].any())
        await until(lambda: tick["tuned_gait_offset"][0].tolist() == [0.75, 0.25, 0.0, 0.5])

    said = _serve_and_drive(tmp_path, fifo, script)
    assert "the sticks move the body" in said


async def _walk_forward(served: Served, fd: int) -> None:
    """Stand up, walk, and push the stick."""
    os.write(fd, CENTRED + button(BUMPER) + button(308) + REPORT)
    await served.reach(Mode.STAND)
    os.write(fd, button(B))
    await served.reach(Mode.WALK)
    await _push_forward(served, fd)


def test_a_pad_that_is_pulled_out_makes_a_walking_robot_stand_and_nothing_moves_when_it_is_back(tmp_path: Path) -> None:
    path = tmp_path / "event0"

    def plug() -> int:
        os.mkfifo(path)
        return os.open(path, os.O_RDWR)

    async def play() -> None:
        async with Served(make_config(command__expiry=EXPIRY), tmp_path) as served:
            fd = plug()
            async with Desk(path, fd).at(served):
                await _walk_forward(served, fd)
                path.unlink()
                os.close(fd)  # the last writer: the pad is gone
                await served.reach(Mode.STAND)
                fd = plug()
                os.write(
                    fd, axis(FORWARD, -32768) + axis(TURN, 0) + axis(LEFT, 0) + button(BUMPER) + button(B) + REPORT
                )
                await served.reach(Mode.WALK)
                await _hears(served, 10)
                assert _asked(served) == [0.0, 0.0, 0.0], "the stick was pushed all the time"
                os.close(fd)

    asyncio.run(play())


def test_after_a_silent_network_the_sticks_have_to_be_centred(tmp_path: Path) -> None:
    def say(forward: float) -> Callable[[Station], None]:
        payload = json.dumps({"linear": [forward, 0.0], "yaw_rate": 0.0, "sticks": True})
        return lambda station: station.session.put(station.keys.velocity, payload)

    async def play() -> None:
        async with Served(make_config(command__expiry=EXPIRY), tmp_path) as served:
            await served.walk()
            tick, entrance = served.daemon.cycle.tick, served.daemon.link.entrance

            async def talk(station: Station, forward: float) -> None:
                for _ in range(5):
                    say(forward)(station)
                    await _hears(served, 1)
                await served.ticks(3)

            with ExitStack() as stack:
                link = connected(served.config.robot.name, served.config.link.listen[0])
                station = await asyncio.to_thread(stack.enter_context, link)
                await talk(station, 0.0)
                await talk(station, 0.3)
                assert _asked(served) == [0.3, 0.0, 0.0]
                await until(lambda: bool(tick["clamps"][0] & Clamp.EXPIRED))  # nobody says anything
                await until(lambda: time.monotonic() - entrance._velocity._heard > EXPIRY)
                for number in range(5):
                    say(0.3)(station)
                    await until(lambda n=number: entrance.refused["command/velocity"] > n)  # type: ignore[misc]
                await served.ticks(3)
                assert _asked(served) == [0.0, 0.0, 0.0] and served.daemon.cycle.state.mode is Mode.WALK
                await talk(station, 0.0)
                await talk(station, 0.3)
                assert _asked(served) == [0.3, 0.0, 0.0]

    asyncio.run(play())


DRIVER = """
import sys
from pathlib import Path
from station.driving import Driving
from station.joystick import Joystick
from station.pad import PadDevice, shipped_mappings
from station.session import connected
with connected(sys.argv[1], sys.argv[2]) as station:
    joystick = Joystick(station, Driving(0.5, 0.4, 1.0))
    joystick.run(lambda: PadDevice(Path(sys.argv[3]), dict(shipped_mappings())["xpad"]), lambda _: None, lambda: True)
"""


def test_a_driver_s_process_that_is_killed_makes_a_walking_robot_stand(tmp_path: Path, fifo: tuple[Path, int]) -> None:
    path, fd = fifo

    async def play() -> None:
        async with Served(make_config(command__expiry=EXPIRY), tmp_path) as served:
            made = served.config
            command = [sys.executable, "-c", DRIVER, made.robot.name, made.link.listen[0], str(path)]
            driver = await asyncio.to_thread(subprocess.Popen, command)
            try:
                await _walk_forward(served, fd)
                driver.kill()
                await served.reach(Mode.STAND)
                await until(lambda: any("operator is gone" in e.text for e in served.daemon.link.history))
            finally:
                driver.kill()
                driver.wait()

    asyncio.run(play())


@pytest.mark.parametrize("robot", ["stoch3", "a1", "mini_cheetah", "stoch3-socketcan"])
def test_a_silent_driver_s_command_ends_within_a_quarter_of_a_second_on_every_shipped_robot(robot: str) -> None:
    made = config.load(config.find_robot(robot))
    assert made.command.expiry + 2.0 / made.control.rate_hz <= 0.25


def test_a_refusal_is_shown_with_its_reason(tmp_path: Path, fifo: tuple[Path, int]) -> None:
    async def script(served: Served, desk: Desk) -> None:
        desk.send(CENTRED + button(B))
        await until(lambda: any(event.kind == "refused" for event in served.daemon.link.history))
        await until(lambda: "walk: refused: not standing: ask for stand first" in desk.said)
        assert served.daemon.cycle.state.mode is Mode.DAMP

    assert "walk: refused: not standing: ask for stand first" in _serve_and_drive(tmp_path, fifo, script)


def test_a_driver_that_leaves_makes_a_walking_robot_stand(tmp_path: Path) -> None:
    async def play() -> None:
        async with Served(make_config(command__expiry=EXPIRY), tmp_path) as served:

            def hold_token(station: Station) -> None:
                token = station.session.liveliness().declare_token(f"{station.keys.operator}/1")
                asyncio.run_coroutine_threadsafe(served.walk(), loop).result(PATIENCE)
                assert served.daemon.cycle.state.mode is Mode.WALK
                del token

            loop = asyncio.get_running_loop()
            await served.client(hold_token)
            await served.reach(Mode.STAND)
            assert any(event.text == "WALK -> STAND: the operator is gone" for event in served.daemon.link.history)

    asyncio.run(play())


def test_a_driver_that_leaves_moves_nothing_that_does_not_walk(tmp_path: Path) -> None:
    async def play() -> None:
        async with Served(make_config(command__expiry=EXPIRY), tmp_path) as served:
            await until(lambda: served.daemon.flight.recorder.count > 2)
            assert served.daemon.take_request(Request.ARM).accepted
            await served.client(
                lambda station: station.session.liveliness().declare_token(f"{station.keys.operator}/1").undeclare()
            )
            await served.ticks(40)
            assert served.daemon.cycle.state.mode is Mode.DAMP

    asyncio.run(play())
