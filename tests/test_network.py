"""A bad network between joystick and robot: delay, loss, silence, a lost session. Nothing moves that should not.

The robot's own recording is the witness: what every tick heard and did, on the clock by which the faults were made.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from daemons import PATIENCE, quick_robot
from network import Cable, End, cabled

from runtime.messages.mode import Mode
from runtime.recording import list_recordings, load

PORT = 7447
STOP = 0.25
"""s within which a walk without its operator ends."""


@dataclass
class Stage:
    """A robot at one end, a driver at the other."""

    desk: End
    cable: Cable
    driver: subprocess.Popen[str]
    daemon: subprocess.Popen[str]
    folder: Path

    def say(self, word: str) -> dict[str, Any]:
        """Tell the driver; what the joystick knows."""
        assert self.driver.stdin is not None and self.driver.stdout is not None
        self.driver.stdin.write(f"{word}\n")
        self.driver.stdin.flush()
        known: dict[str, Any] = json.loads(self.driver.stdout.readline())
        return known

    def until(self, reached: Callable[[dict[str, Any]], bool]) -> None:
        end = time.monotonic() + PATIENCE
        while not reached(known := self.say("look")):
            assert time.monotonic() < end, f"the driver knows {known}"
            time.sleep(0.02)

    def walk(self) -> None:
        """From wherever it is, to walking forward; again if a gap got in between, as a driver would."""
        end = time.monotonic() + PATIENCE
        while not self._sets_out():
            assert time.monotonic() < end, f"it does not walk: {self.say('look')}"

    def _sets_out(self) -> bool:
        self.say("centre")
        while self.say("look")["mode"] == "DAMP":  # a busy robot may refuse to be armed at first
            self.say("stand")
            time.sleep(0.5)
        self.until(lambda known: known["mode"] in ("STAND", "WALK"))
        self.say("walk")
        self.until(lambda known: known["mode"] == "WALK")
        time.sleep(0.3)
        self.say("push")
        time.sleep(0.5)
        return bool(self.say("look")["moves"])

    def ticks(self) -> np.ndarray:
        """End it, and read what the robot recorded."""
        self.daemon.terminate()
        self.daemon.wait(PATIENCE)
        (path,) = list_recordings(self.folder / "recordings" / "stoch3")
        return load(path).ticks


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    with cabled() as (robot_end, desk_end, cable):
        robot = quick_robot(tmp_path, "[link]\nallow_unprotected = true\n", ("posture", "arming", "limits"))
        endpoint = f"tcp/{robot_end.address}:{PORT}"
        serve = ["-m", "trotd.cli", "run", "--body", "null", "--robot", str(robot), "--state", str(tmp_path)]
        daemon = subprocess.Popen(
            robot_end.command(sys.executable, *serve, "--listen", endpoint), stderr=subprocess.PIPE, text=True
        )
        driver = None
        try:
            assert daemon.stderr is not None
            while "ready" not in (line := daemon.stderr.readline()):
                assert line, "the daemon does not come up"
            drive = [str(Path(__file__).with_name("network_driver.py")), endpoint, "stoch3"]
            driver = subprocess.Popen(
                desk_end.command(sys.executable, *drive), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
            )
            made = Stage(desk_end, cable, driver, daemon, tmp_path)
            made.until(lambda known: known["mode"] == "DAMP")
            yield made
        finally:
            for process in filter(None, (driver, daemon)):
                process.kill()
                process.communicate()


def between(ticks: np.ndarray, begin: float, end: float) -> np.ndarray:
    chosen: np.ndarray = ticks[(ticks["stamp"] > begin) & (ticks["stamp"] < end)]
    assert len(chosen) > 5
    return chosen


def moves(ticks: np.ndarray) -> np.ndarray:
    """Whether the robot follows a wish other than to rest, tick by tick."""
    moving: np.ndarray = (ticks["mode"] == Mode.WALK) & ticks["asked_velocity"].any(axis=1)
    return moving


def test_delay_and_loss(stage: Stage) -> None:
    """With packets lost there are gaps, and after each the sticks have to be centred; that is all."""
    marks = []
    for seconds, delay, loss in ((1.0, 0.0, 0.0), (1.5, 0.1, 0.0), (4.0, 0.1, 0.1)):
        stage.cable.delay, stage.cable.loss = delay, loss
        stage.walk()
        marks.append(time.monotonic())
        time.sleep(seconds)
        if delay and not loss:
            assert stage.say("look")["latency"] >= 0.2
    ticks = stage.ticks()
    nothing_but(ticks)
    for mark in marks:
        assert moves(between(ticks, mark - 0.3, mark + 1.0)).any()
    assert stage.cable.lost > 10


@pytest.mark.parametrize("seconds", [1.0, 2.0])
def test_silence(stage: Stage, seconds: float) -> None:
    """For one second the robot goes on walking on the spot, so that what waited on the way finds it in WALK."""
    stage.walk()
    stage.cable.silent = True
    begin = time.monotonic()
    time.sleep(seconds)
    stage.cable.silent = False
    back = time.monotonic()
    time.sleep(2.0)  # the sticks are pushed all the while
    stage.walk()
    again = time.monotonic()
    time.sleep(0.5)
    ticks = stage.ticks()
    nothing_but(ticks)
    assert moves(between(ticks, begin - 0.3, begin)).any()
    assert not moves(between(ticks, begin + STOP, back)).any(), "it rests though the last word was forward"
    assert not moves(between(ticks, back, back + 1.9)).any(), "what waited on the way and pushed sticks move nothing"
    assert moves(between(ticks, again - 0.3, np.inf)).any(), "centred, it obeys again"


def nothing_but(ticks: np.ndarray) -> None:
    """Nothing but what the stick said was ever obeyed."""
    wish = ticks["asked_velocity"][moves(ticks)]
    assert (wish == wish[0]).all() and wish[0, 0] > 0.0


def test_a_session_that_is_lost_and_found(stage: Stage) -> None:
    stage.walk()
    stage.cable.silent = True
    gone = time.monotonic()
    stage.until(lambda known: known["deaf"])
    time.sleep(12.0)  # longer than zenoh's lease: both sides give the session up
    stage.cable.silent = False
    back = time.monotonic()
    stage.until(lambda known: not known["deaf"])
    time.sleep(1.0)
    found = time.monotonic()
    stage.walk()
    ticks = stage.ticks()
    away = between(ticks, gone + STOP, found)
    assert not moves(away).any()
    assert (between(ticks, back, found)["mode"] == Mode.STAND).all(), "it stands, and waits to be sent again"
    assert moves(between(ticks, found, np.inf)).any()


def test_the_cable_does_what_it_is_told(stage: Stage) -> None:
    """Otherwise the tests above prove nothing."""
    before = stage.cable.carried
    stage.cable.delay = 0.1
    began = time.monotonic()
    probe = "import socket; socket.create_connection(('10.77.0.1', 7447), 60)"
    subprocess.run(stage.desk.command(sys.executable, "-S", "-c", probe), check=True)
    assert time.monotonic() - began >= 0.2 and stage.cable.carried > before  # there and back
