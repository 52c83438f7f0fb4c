"""A daemon at work for a long time, with everybody watching: the process, its clients, and what it costs them."""

from __future__ import annotations

import contextlib
import math
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import psutil

from runtime import config
from runtime.messages.mode import Mode, Request
from runtime.messages.simulation import SimTruth
from runtime.messages.status import Status
from runtime.reasons import Reason
from station.driving import Driving
from station.joystick import Joystick
from station.pad import Sticks
from station.requests import request, set_off
from station.session import Station, StationError, connected, free_endpoint
from trotd.bench.host import stolen_time
from trotd.tour import running_twin

SETTLING = 0.1
"""Share of the time, from the start, in which memory may still grow: buffers fill, the ring's pages are touched."""
LEAST_SPEED = 0.1
"""m/s on the mean; one that only marks time proves little."""
START_TIMEOUT = 300.0
"""s; the first start of all compiles the core."""
STEADY = 5.0
"""s between two looks at the memory."""


class Shift(msgspec.Struct, kw_only=True):
    """What it was like."""

    minutes: float
    rate_hz: float = 0.0
    wires: dict[str, int] = {}
    """What went wrong on them, counted."""
    ticks: int = 0
    missed: int = 0
    """Ticks whose deadline went by."""
    calm: int = 0
    """Ticks between two statuses between which the machine's host took no processor time."""
    calm_missed: int = 0
    """Of them."""
    growth: float = 0.0
    """Of the daemon's resident memory after the settling, MiB."""
    resident: float = 0.0
    """At the end, MiB."""
    falls: int = 0
    distance: float = 0.0
    """m."""
    ends: list[str] = []
    """Every change of mode that was not asked for."""
    halts: list[str] = []
    """Of a walk, because the computer came too late for it; it was asked to walk on."""
    clients: dict[str, str] = {}
    """How each ended."""
    recording: bool = False
    """The daemon ended in order and left one."""

    def problems(self, growth: float) -> list[str]:
        """What of it was not as it must be."""
        problems = [f"ended: {end}" for end in self.ends]
        problems += [f"{name}: {end}" for name, end in self.clients.items() if end]
        if self.distance < LEAST_SPEED * 60.0 * self.minutes:
            problems.append(f"walked {self.distance:.0f} m only, in {self.minutes:g} min")
        if self.growth > growth:
            problems.append(f"memory grew by {self.growth:.1f} MiB, bound {growth:g}")
        if self.falls:
            problems.append(f"fell {self.falls} times")
        if not self.recording:
            problems.append("the daemon did not end in order")
        return problems


class Hands:
    """A driver that never tires: sticks that wander, on a file descriptor that never has anything to read."""

    def __init__(self) -> None:
        self._near, self._far = os.pipe()
        self._start = time.monotonic()

    def fileno(self) -> int:
        return self._near

    def read(self) -> list[str]:
        return []

    @property
    def sticks(self) -> Sticks:
        """Centred for a moment every ten seconds, as after every start and loss, else slowly to and fro."""
        t = time.monotonic() - self._start
        if t % 10.0 < 1.5:
            return Sticks(held=True)
        return Sticks(
            forward=0.3 + 0.3 * math.sin(0.21 * t),
            left=0.3 * math.sin(0.37 * t),
            turn=0.4 * math.sin(0.13 * t),
            held=True,
        )

    def close(self) -> None:
        for fd in (self._near, self._far):
            os.close(fd)


def resident(process: psutil.Process) -> float:
    """MiB of the process alone."""
    return float(process.memory_info().rss) / 2**20


def work(minutes: float, robot: str, body: str, rate_hz: float, watched: bool, show: Callable[[str], None]) -> Shift:
    """One shift on the simulator (``sim``) or on the wires of its twin (``twin``), ``watched`` by everybody or alone.

    Raises:
        StationError: the daemon does not start.
    """
    shift = Shift(minutes=minutes, rate_hz=rate_hz, ends=[], halts=[], clients={})
    with tempfile.TemporaryDirectory(prefix="trotd-soak-") as place, contextlib.ExitStack() as stack:
        folder, endpoint = Path(place), free_endpoint()
        arguments = ["--robot", robot, "--rate-hz", f"{rate_hz:g}", "--state", str(folder)]
        if body == "twin":
            name = config.load(config.find_robot(robot)).robot.name
            arguments = stack.enter_context(running_twin(name, endpoint, arguments))
        command = ["run", "--body", body, "--listen", endpoint, *arguments]
        daemon = stack.enter_context(_process(folder, "daemon", command))
        station = stack.enter_context(_reached(robot, endpoint, daemon))
        set_off(station)
        watchers = (["monitor", "--json", "--hz", "2"], ["view", "--save", os.devnull]) if watched else ()
        clients = {
            words[0]: stack.enter_context(_process(folder, words[0], [*words, "--robot", robot, "--connect", endpoint]))
            for words in watchers
        }
        _drive(station, daemon, shift, show)
        for name, client in clients.items():
            shift.clients[name] = "" if client.poll() is None else f"ended with code {client.returncode}"
        request(station, Request.DAMP)
        daemon.send_signal(signal.SIGTERM)
        shift.recording = daemon.wait(60.0) == 0 and any(folder.rglob("*-stop.trotd"))
    return shift


def _drive(station: Station, daemon: subprocess.Popen[bytes], shift: Shift, show: Callable[[str], None]) -> None:
    process, seconds = psutil.Process(daemon.pid), 60.0 * shift.minutes
    memory: list[tuple[float, float]] = []
    truths: list[SimTruth] = []
    lock = threading.Lock()

    def hear(sample: Any) -> None:
        with lock:
            truths.append(msgspec.json.decode(sample.payload.to_bytes(), type=SimTruth))

    subscriber: Any = station.session.declare_subscriber(station.keys.sim_truth, hear)
    start, before, mode, fallen = time.monotonic(), None, Mode.WALK.name, False
    spoken = looked = 0.0
    base: int | None = None
    heard: Status | None = None
    stolen = stolen_time()

    def more() -> bool:
        return time.monotonic() - start < seconds and daemon.poll() is None

    def look(joystick: Joystick) -> None:
        nonlocal before, mode, fallen, spoken, looked, base, heard, stolen
        now = time.monotonic() - start
        with lock:
            new, truths[:] = list(truths), []
        for truth in new:
            if before is not None:
                shift.distance += math.dist(truth.position[:2], before.position[:2])
            shift.falls += truth.fallen and not fallen
            before, fallen = truth, truth.fallen
        status = joystick.status
        if status is not None:
            base = status.overruns if base is None else base
            shift.ticks, shift.missed, shift.wires = status.ticks, status.overruns - base, status.wires
            if heard is None or status.ticks > heard.ticks:
                taken = stolen_time()
                if heard is not None and taken == stolen:
                    shift.calm += status.ticks - heard.ticks
                    shift.calm_missed += status.overruns - heard.overruns
                heard, stolen = status, taken
            if status.mode != mode:
                mode = status.mode
                if mode == Mode.STAND.name and status.reason == Reason.LATE_LOOP.words:
                    shift.halts.append(f"{now:.0f} s")
                    request(station, Request.WALK)
                elif mode != Mode.WALK.name or not shift.halts:
                    shift.ends.append(f"{now:.0f} s {mode}: {status.fault or status.reason}")
        if now - looked >= STEADY:
            looked = now
            memory.append((now, resident(process)))
        if now - spoken >= 1.0:
            spoken = now
            show(
                f"{now / 60:.1f} of {shift.minutes:g} min · {mode} · {shift.distance:.0f} m · missed {shift.missed} of"
                f" {shift.ticks} ticks · {memory[-1][1] if memory else 0:.1f} MiB · falls {shift.falls}"
            )

    Joystick(station, Driving(0.8, 0.3, 0.8)).run(Hands, look, more)
    subscriber.undeclare()
    settled = [size for at, size in memory if at >= SETTLING * seconds]
    if settled:
        shift.resident, shift.growth = settled[-1], settled[-1] - settled[0]
    if daemon.poll() is not None:
        shift.ends.append(f"the daemon ended with code {daemon.returncode}")


@contextlib.contextmanager
def _process(folder: Path, name: str, words: list[str]) -> Iterator[subprocess.Popen[bytes]]:
    """``trotd`` with ``words``, its output in ``folder``; killed at the end if it is still there."""
    environment = os.environ | {"RUNTIME_DIRECTORY": str(folder / "run")}
    with (folder / f"{name}.log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "trotd.cli", *words],
            stdout=subprocess.DEVNULL,
            stderr=log,
            stdin=subprocess.DEVNULL,
            env=environment,
        )
    try:
        yield process
    finally:
        if process.poll() is None:
            process.kill()
        process.wait()


@contextlib.contextmanager
def _reached(robot: str, endpoint: str, daemon: subprocess.Popen[bytes]) -> Iterator[Station]:
    name = config.load(config.find_robot(robot)).robot.name
    end = time.monotonic() + START_TIMEOUT
    with contextlib.ExitStack() as stack:
        while True:
            try:
                station = stack.enter_context(connected(name, endpoint))
                station.next_status()
                break
            except StationError:
                if daemon.poll() is not None or time.monotonic() > end:
                    raise
                time.sleep(0.2)
        yield station


def share(missed: int, ticks: int) -> float:
    """Of the ticks, how many went by without one of their own."""
    return missed / max(1, ticks)
