"""The loop on time: the daemon on the null body beside cyclictest, in slices that take turns.

The daemon walks, so every tick is a whole one. Its own recording tells lateness and compute time of each tick;
cyclictest (Debian's rt-tests) is the measure of what this kernel can do at all.
"""

from __future__ import annotations

import contextlib
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from runtime import config
from runtime.recording import SUFFIX, load
from station.session import NoAnswer, Station, StationError, connected
from trotd.bench.report import Figure, Finding, Missing, shown

ROBOT = "stoch3"
PRIORITY = 80
RATES = (200.0, 500.0, 1000.0)
WALK = 3
"""``runtime.messages.Mode.WALK``."""
CYCLICTEST = 2
"""s of cyclictest between two slices of the daemon."""
TURN, SETTLE = 2.0, 0.3
"""s with a subscriber or without, and s that it may take to come or go."""
START = 90.0
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
    missed: int
    ticks: int


class Disturbed(RuntimeError):
    """A slice that says nothing about the loop; the message says what happened in it."""


def measure(quick: bool) -> Iterator[Finding]:
    """Every rate under normal scheduling and SCHED_FIFO, then with and without somebody listening."""
    slices, seconds = (2, 5) if quick else (12, 5)
    if shutil.which("cyclictest") is None:
        yield Missing("timer", "beside cyclictest", "not installed: apt install rt-tests")
    rates = (1000.0,) if quick else RATES
    for fifo in (False, True):
        if fifo and not _may_fifo():
            yield Missing("timer", "SCHED_FIFO", "not permitted: run as root, or raise RLIMIT_RTPRIO")
            return
        for rate in rates:
            yield from beside_cyclictest(rate, fifo, slices, seconds)
    try:
        yield from listened_to(1000.0, 2 * slices)
    except Disturbed as error:
        yield Missing("timer", "a subscriber on or off", str(error))


def beside_cyclictest(rate: float, fifo: bool, slices: int, seconds: int) -> Iterator[Finding]:
    """Slices of both in turns: the median over the slices of each slice's percentile, and all that was missed.

    A kernel (or the host of a virtual machine) that holds a processor for longer than a period makes cyclictest miss
    its wake too, so ticks are counted against what it missed in its own slices.
    """
    ours: list[Slice] = []
    theirs: list[np.ndarray] = []
    name = f"{rate:g} Hz, {'FIFO' if fifo else 'normal'}"
    for _ in shown(range(slices), name, slices):
        try:
            ours.append(run_daemon(rate, fifo, seconds))
        except Disturbed as error:
            yield Missing("timer", name, f"a slice is left out: {error}")
            continue
        if shutil.which("cyclictest"):
            theirs.append(run_cyclictest(rate, fifo, CYCLICTEST))
    if not ours:
        return
    p50, p99 = _percentiles([one.lateness for one in ours])
    yield Figure("timer", f"{name}: lateness p50", p50, "µs")
    yield Figure("timer", f"{name}: lateness p99", p99, "µs")
    missed = 100.0 * sum(one.missed for one in ours) / sum(one.ticks for one in ours)
    if not theirs:
        yield Figure("timer", f"{name}: missed ticks", missed, "%", 0.3)
        return
    floor50, floor99 = _percentiles(theirs)
    note = f"cyclictest {floor50:.0f} and {floor99:.0f} µs"
    yield Figure("timer", f"{name}: p50 over cyclictest's", p50 / floor50, "x", None if fifo else 1.0)
    yield Figure("timer", f"{name}: p99 over cyclictest's", p99 / floor99, "x", 4.0 if fifo else 2.0, note=note)
    floor = 100.0 * sum(_wakes_missed(wakes, rate) for wakes in theirs) / (rate * CYCLICTEST * len(theirs))
    note = f"ours {missed:.3f} %, cyclictest's {floor:.3f} %"
    yield Figure("timer", f"{name}: ticks missed beyond cyclictest's", max(0.0, missed - floor), "%", 0.3, note=note)


def _percentiles(slices: list[np.ndarray]) -> tuple[float, float]:
    """Medians over the slices of their p50 and p99: one disturbed slice does not decide."""
    p50, p99 = np.median([np.percentile(one, [50, 99]) for one in slices], axis=0)
    return float(p50), float(p99)


def _wakes_missed(lateness: np.ndarray, rate: float) -> int:
    """Deadlines that went by asleep: a wake that is late by k periods let k of them pass."""
    return int((lateness * 1e-6 * rate).astype(int).sum())


def listened_to(rate: float, turns: int) -> Iterator[Finding]:
    """Compute time of a tick with a subscriber of all ticks and without, in turns of ``TURN`` s in one daemon."""
    name = f"{rate:g} Hz: a subscriber on or off"
    stretches: list[tuple[float, bool]] = []
    with _daemon(rate, False, round(2 * turns * TURN)) as (station, read):
        for turn in shown(range(2 * turns), name, 2 * turns):
            on = turn % 4 in (1, 2)  # off on on off: a drift of the machine cancels
            subscriber = station.session.declare_subscriber(station.keys.tick, lambda _sample: None) if on else None
            time.sleep(SETTLE)
            stretches.append((time.monotonic(), on))
            time.sleep(TURN)
            if subscriber is not None:
                subscriber.undeclare()  # type: ignore[no-untyped-call]
    whole = read()
    off, on_ = (
        float(
            np.median(
                [
                    np.percentile(whole.compute[(whole.stamp > begin) & (whole.stamp < begin + TURN)], 99)
                    for begin, heard in stretches
                    if heard is state
                ]
            )
        )
        for state in (False, True)
    )
    yield Figure("timer", f"{name}, tick p99", 100.0 * (on_ / off - 1.0), "%", 5.0, note=f"{off:.0f} and {on_:.0f} µs")


def run_daemon(rate: float, fifo: bool, seconds: int) -> Slice:
    """A daemon of its own, walking on the null body for ``seconds``; what its recording says."""
    with _daemon(rate, fifo, seconds) as (_, read):
        time.sleep(seconds)
    return read()


@contextlib.contextmanager
def _daemon(rate: float, fifo: bool, seconds: int) -> Iterator[tuple[Station, Callable[[], Slice]]]:
    """A walking daemon on the null body, and what reads its recording once it was left."""
    with tempfile.TemporaryDirectory(prefix="trotd-bench-") as folder:
        robot = _robot_file(Path(folder), fifo, seconds)
        endpoint = _free_endpoint()
        command = [sys.executable, "-m", "trotd.cli", "run", "--body", "null", "--robot", str(robot)]
        command += ["--rate-hz", f"{rate:g}", "--listen", endpoint, "--state", folder]
        with (Path(folder) / "log").open("wb") as log:
            process = subprocess.Popen(command, stdout=log, stderr=log)
        left: list[Slice] = []
        try:
            with _reached(process, endpoint, Path(folder) / "log") as station, _driven(station):
                yield station, left.pop
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
    missed = int(walking["overruns"][-1]) - int(walking["overruns"][0])
    return Slice(1e6 * walking["lateness"], 1e6 * walking["compute"], walking["stamp"], missed, len(walking))


def _robot_file(folder: Path, fifo: bool, seconds: int) -> Path:
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
    path.write_text(text)
    config.load(path)
    return path


@contextlib.contextmanager
def _reached(process: subprocess.Popen[bytes], endpoint: str, log: Path) -> Iterator[Station]:
    deadline = time.monotonic() + START
    while True:
        if process.poll() is not None:
            raise StationError(f"the daemon ended: {log.read_text()[-500:]}")
        try:
            with connected(ROBOT, endpoint) as station:
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
def _driven(station: Station) -> Iterator[None]:
    """Armed, stood up and walking; the operator's command is kept fresh from a thread."""
    for word, mode in (("arm", "DAMP"), ("stand", "STAND"), ("walk", "WALK")):
        station.ask(station.keys.mode, word.encode())
        while station.next_status().mode != mode:
            pass
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


def run_cyclictest(rate: float, fifo: bool, seconds: int) -> np.ndarray:
    """Latencies of cyclictest's one thread at the same rate, µs; one a wake."""
    command = ["cyclictest", "-q", "-t1", "-i", f"{1e6 / rate:.0f}", "-D", str(seconds), "-h", "5000"]
    command += ["-m", "-p", str(PRIORITY)] if fifo else ["--policy=other"]
    answer = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    rows = re.findall(r"^(\d{6}) (\d+)$", answer, re.MULTILINE)
    return np.repeat([float(row[0]) for row in rows], [int(row[1]) for row in rows])


def _free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def _may_fifo() -> bool:
    return subprocess.run(["chrt", "-f", str(PRIORITY), "true"], capture_output=True, check=False).returncode == 0
