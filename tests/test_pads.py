"""``trotd joystick`` as a user starts it, with a pad: event bytes through a pipe, and a real one that uinput makes."""

from __future__ import annotations

import os
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol

import pytest
from daemons import PATIENCE, quick_robot, running, status_when

from runtime.messages.status import Status
from station.pad import EVENT
from station.session import Station

EV_SYN, EV_KEY, EV_ABS = 0, 1, 3
X, Y, RX, RY = 0, 1, 3, 4
"""Axes of both sticks."""
BUMPER, BUTTON_Y, BUTTON_B = 311, 308, 305
KEYS = (304, BUTTON_B, 307, BUTTON_Y, 310, BUMPER, 314, 315, 316)
FAR = -32768
NAME = "Logitech Gamepad F710"


class Plugged(Protocol):
    """A pad that is there."""

    arguments: list[str]
    """How the command is told of it."""

    def write(self, kind: int, code: int, value: int) -> None: ...

    def report(self) -> None: ...

    def pull_out(self) -> None: ...


class PipedPad:
    """Event bytes through a pipe: what no kernel is needed for."""

    def __init__(self, path: Path, forward: int) -> None:
        os.mkfifo(path)
        self.path, self.arguments = path, ["--pad", str(path)]
        self._fd = os.open(path, os.O_RDWR)
        for code in (X, RX, RY):
            self.write(EV_ABS, code, 0)
        self.write(EV_ABS, Y, forward)
        self.report()

    def write(self, kind: int, code: int, value: int) -> None:
        os.write(self._fd, struct.pack(EVENT.format, 0, 0, kind, code, value))

    def report(self) -> None:
        self.write(EV_SYN, 0, 0)

    def pull_out(self) -> None:
        self.path.unlink()
        os.close(self._fd)


class KernelPad:
    """A pad that the kernel has, by uinput; the command finds it by its name."""

    def __init__(self, forward: int) -> None:
        evdev = pytest.importorskip("evdev", reason="evdev-binary is not installed: no pad by uinput")
        middle = {"min": -32768, "max": 32767, "fuzz": 16, "flat": 128, "resolution": 0}
        axes = [(code, evdev.AbsInfo(value=forward if code == Y else 0, **middle)) for code in (X, Y, RX, RY)]
        try:
            self._pad: Any = evdev.UInput({EV_KEY: list(KEYS), EV_ABS: axes}, name=NAME)
        except (evdev.UInputError, OSError) as error:
            pytest.skip(f"no pad by uinput: {error}")
        self.arguments: list[str] = []
        if self._pad.device is None:
            self._pad.close()
            pytest.skip("no pad by uinput: its event device may not be opened")

    def write(self, kind: int, code: int, value: int) -> None:
        self._pad.write(kind, code, value)

    def report(self) -> None:
        self._pad.syn()

    def pull_out(self) -> None:
        self._pad.close()


Plug = Callable[[int], Plugged]


@pytest.fixture(params=["pipe", "uinput"])
def plug(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Plug]:
    """Plugs a pad in whose left stick is where it is told to be."""
    if request.param == "uinput":
        yield KernelPad
    else:
        yield lambda forward: PipedPad(tmp_path / "event0", forward)


def press(pad: Plugged, code: int) -> None:
    for value in (0, 1):
        pad.write(EV_KEY, code, value)
        pad.report()


def again_until(station: Station, act: Callable[[], None], fact: Callable[[Status], bool]) -> None:
    """Do it as a driver would who looks at the robot: again, until it obeys."""
    end = time.monotonic() + PATIENCE
    while True:
        act()
        for _ in range(5):
            if fact(status := station.next_status()):
                return
        assert time.monotonic() < end, status


def mode_is(mode: str) -> Callable[[Status], bool]:
    return lambda status: status.mode == mode


def test_a_pad_stands_a_robot_up_walks_it_and_lets_go_of_it(tmp_path: Path, plug: Plug) -> None:
    robot, pad = quick_robot(tmp_path), plug(0)
    with running(tmp_path, robot, "null") as (_, station):
        command = [sys.executable, "-m", "trotd.cli", "joystick", "--robot", str(robot), "--connect", station.endpoint]
        driver = subprocess.Popen([*command, *pad.arguments], stderr=subprocess.PIPE, text=True)

        def stand_up() -> None:
            press(pad, BUMPER)
            press(pad, BUTTON_Y)

        def push() -> None:
            for forward in (0, FAR):
                pad.write(EV_ABS, Y, forward)
                pad.report()
                station.next_status()

        try:
            again_until(station, stand_up, mode_is("STAND"))
            again_until(station, lambda: press(pad, BUTTON_B), mode_is("WALK"))
            again_until(station, push, lambda status: status.velocity_command[0] > 0.0)
            pad.pull_out()
            status_when(station, mode_is("STAND"))
            pad = plug(FAR)
            press(pad, BUMPER)
            again_until(station, lambda: press(pad, BUTTON_B), mode_is("WALK"))
            press(pad, BUMPER)
            for _ in range(5):
                assert station.next_status().velocity_command == (0.0, 0.0, 0.0), "the stick was pushed all the time"
            again_until(station, push, lambda status: status.velocity_command[0] > 0.0)
            driver.send_signal(signal.SIGINT)
            words = driver.communicate(timeout=PATIENCE)[1]
            assert driver.returncode == 0 and "Traceback" not in words
            status_when(station, mode_is("STAND"))
        finally:
            driver.kill()
            driver.communicate()
            pad.pull_out()
