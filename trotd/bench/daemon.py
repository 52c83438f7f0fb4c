"""A daemon of its own for a bench: on the null body, walking, and what its recording says once it was left."""

from __future__ import annotations

import contextlib
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from runtime import config
from runtime.control.records import Records
from runtime.recording import SUFFIX, load
from station.requests import set_off
from station.session import NoAnswer, Station, StationError, connected, free_endpoint
from trotd.bench.host import Window

ROBOT = "stoch3"
PRIORITY = 80
WALK = 3
"""``runtime.messages.mode.Mode.WALK``."""
PATIENCE = 30.0
"""s that the daemon may take to answer, or to send a status."""
START = 240.0
"""s that a daemon may take to start: compiled code may have to be made anew."""


@dataclass(frozen=True, slots=True)
class Slice:
    """What one slice of the daemon left."""

    lateness: np.ndarray
    """µs, one a tick."""
    compute: np.ndarray
    """µs."""
    stamp: np.ndarray
    """s monotonic."""
    overruns: np.ndarray
    """Deadlines that have gone by without a tick of their own, counted at each tick."""
    records: Records
    """All of the recording, what did not walk too."""

    def within(self, window: Window) -> np.ndarray:
        """Which ticks fell into ``window``. Shape (n,), bool."""
        return (self.stamp >= window.begin) & (self.stamp < window.end)

    def p99(self, windows: Sequence[Window]) -> float:
        """Of the compute time: the median over ``windows`` of each one's 99th percentile, µs."""
        return float(np.median([np.percentile(self.compute[self.within(window)], 99) for window in windows]))


@dataclass(frozen=True, slots=True)
class Walking:
    """A daemon that walks on the null body, in a process of its own."""

    station: Station
    process: int
    """Its number."""
    read: Callable[[], Slice]
    """What it recorded; to be called once it was left."""


class Disturbed(RuntimeError):
    """A slice that says nothing about the loop; the message says what happened in it."""


@contextlib.contextmanager
def walking_daemon(rate: float, fifo: bool, seconds: int, steered: bool = True, extra: str = "") -> Iterator[Walking]:
    """A walking daemon on the null body.

    Args:
        rate: ticks a second.
        fifo: under SCHED_FIFO.
        seconds: how much of it will be looked at.
        steered: somebody keeps a velocity command fresh.
        extra: TOML at the robot's end.

    Raises:
        Disturbed: it damped; when it is left.
    """
    with tempfile.TemporaryDirectory(prefix="trotd-bench-") as folder:
        robot = _robot_file(Path(folder), fifo, seconds, extra)
        endpoint = free_endpoint()
        command = [sys.executable, "-m", "trotd.cli", "run", "--body", "null", "--robot", str(robot)]
        command += ["--rate-hz", f"{rate:g}", "--listen", endpoint, "--state", folder]
        with (Path(folder) / "log").open("wb") as log:
            process = subprocess.Popen(command, stdout=log, stderr=log)
        left: list[Slice] = []
        try:
            with _reached(process, endpoint, Path(folder) / "log") as station, _driven(station, steered):
                yield Walking(station, process.pid, left.pop)
                process.send_signal(signal.SIGTERM)
                process.wait(30)
        finally:
            process.kill()
            process.wait()
        left.append(_read(Path(folder), rate))


def _read(folder: Path, rate: float) -> Slice:
    path = max((folder / "recordings").rglob(f"*{SUFFIX}"))
    recording = load(path)
    faults = [event.text for event in recording.header.events if event.kind == "fault"]
    if faults:
        raise Disturbed(f"the daemon damped: {faults[0]}")
    ticks = recording.ticks
    walking = ticks[ticks["mode"] == WALK]
    walking = walking[round(0.5 * rate) :]  # the first moments load what no tick after them loads
    return Slice(1e6 * walking["lateness"], 1e6 * walking["compute"], walking["stamp"], walking["overruns"], ticks)


def _robot_file(folder: Path, fifo: bool, seconds: int, extra: str) -> Path:
    text = config.find_robot(ROBOT).read_text()
    wishes = {"recorder": f"seconds = {seconds + 30.0}", "realtime": f"priority = {PRIORITY if fifo else 0}"}
    for table, line in wishes.items():
        heading = re.compile(rf"^\[{table}\]\s*(#.*)?$", re.MULTILINE)
        key = line.partition(" ")[0]
        if heading.search(text):
            text = re.sub(rf"(?m)^{key} *=.*\n", "", text)
            text = heading.sub(f"[{table}]\n{line}", text)
        else:
            text += f"\n[{table}]\n{line}\n"
    path = folder / f"{ROBOT}.toml"
    path.write_text(f"{text}\n{extra}")
    config.load(path)
    return path


@contextlib.contextmanager
def _reached(process: subprocess.Popen[bytes], endpoint: str, log: Path) -> Iterator[Station]:
    deadline = time.monotonic() + START
    while True:
        if process.poll() is not None:
            raise StationError(f"the daemon ended: {log.read_text()[-500:]}")
        try:
            with connected(ROBOT, endpoint, PATIENCE) as station:
                station.next_status()
                yield station
                return
        except NoAnswer:
            raise
        except StationError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.2)


@contextlib.contextmanager
def _driven(station: Station, steered: bool) -> Iterator[None]:
    """Armed, stood up and walking; the operator's command is kept fresh from a thread."""
    set_off(station)
    if not steered:
        yield
        return
    done = threading.Event()

    def talk() -> None:
        publisher = station.session.declare_publisher(station.keys.velocity)
        while not done.wait(0.05):
            publisher.put(b'{"linear": [0.3, 0.0], "yaw_rate": 0.1}')

    talker = threading.Thread(target=talk, name="operator")
    talker.start()
    try:
        yield
    finally:
        done.set()
        talker.join()


def may_fifo() -> bool:
    """Whether this user may run under SCHED_FIFO."""
    return subprocess.run(["chrt", "-f", str(PRIORITY), "true"], capture_output=True, check=False).returncode == 0
