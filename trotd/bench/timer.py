"""The loop on time: the daemon on the null body beside cyclictest, in slices that take turns.

The daemon walks, so every tick is a whole one. Its own recording tells lateness and compute time of each tick;
cyclictest (Debian's rt-tests) is the measure of what this kernel can do at all.
"""

from __future__ import annotations

import contextlib
import re
import shutil
import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from station.session import StationError
from trotd.bench.daemon import PRIORITY, Disturbed, Slice, Walking, may_fifo, walking_daemon
from trotd.bench.host import Window, calm_or_all, stolen_time, watched, watched_in_windows
from trotd.bench.report import Figure, Finding, Missing, shown

RATES = (200.0, 500.0, 1000.0)
CYCLICTEST = 2
"""s of cyclictest between two slices of the daemon."""
TURN, SETTLE = 2.0, 0.3
"""s with a subscriber or without, and s that it may take to come or go."""


def measure(quick: bool) -> Iterator[Finding]:
    """Every rate under normal scheduling and SCHED_FIFO, then with and without somebody listening."""
    slices, seconds = (2, 5) if quick else (12, 5)
    if shutil.which("cyclictest") is None:
        yield Missing("timer", "beside cyclictest", "not installed: apt install rt-tests")
    rates = (1000.0,) if quick else RATES
    for fifo in (False, True):
        if fifo and not may_fifo():
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

    Of both, only windows in which the host of a virtual machine took no processor time count (``trotd.bench.host``):
    what it takes stops everybody, in bursts of seconds, and says nothing about the loop. A kernel that holds a
    processor for longer than a period makes cyclictest miss its wake too, so ticks are counted against what it missed.
    """
    ours: list[Calm] = []
    theirs: list[np.ndarray] = []
    name = f"{rate:g} Hz, {'FIFO' if fifo else 'normal'}"
    windows = 0
    for _ in shown(range(slices), name, slices):
        try:
            calm, watched_windows = run_daemon(rate, fifo, seconds)
        except (Disturbed, StationError) as error:
            yield Missing("timer", name, f"a slice is left out: {error}")
            continue
        windows += watched_windows
        ours += [calm] if calm.windows else []
        if shutil.which("cyclictest"):
            theirs += run_cyclictest(rate, fifo, CYCLICTEST)
    if not ours:
        yield Missing("timer", name, f"the machine's host took time in each of {windows} windows")
        return
    p50, p99 = _percentiles([one.lateness for one in ours])
    note = f"{sum(one.windows for one in ours)} of {windows} s were undisturbed by the host"
    yield Figure("timer", f"{name}: lateness p50", p50, "µs", note=note)
    yield Figure("timer", f"{name}: lateness p99", p99, "µs")
    missed = 100.0 * sum(one.missed for one in ours) / sum(len(one.lateness) for one in ours)
    if not theirs:
        yield Figure("timer", f"{name}: missed ticks", missed, "%", 0.3)
        return
    floor50, floor99 = _percentiles(theirs)
    note = f"cyclictest {floor50:.0f} and {floor99:.0f} µs"
    yield Figure("timer", f"{name}: p50 over cyclictest's", p50 / floor50, "x", None if fifo else 1.0)
    yield Figure("timer", f"{name}: p99 over cyclictest's", p99 / floor99, "x", 4.0 if fifo else 2.0, note=note)
    floor = 100.0 * sum(_wakes_missed(wakes, rate) for wakes in theirs) / sum(len(wakes) for wakes in theirs)
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
    """Compute time of a tick with a subscriber of all ticks and without, in turns of ``TURN`` s in one daemon.

    Turns in which the machine's host took processor time do not count, unless it did in all of one kind.
    """
    name = f"{rate:g} Hz: a subscriber on or off"
    every: dict[bool, list[Window]] = {False: [], True: []}
    with walking_daemon(rate, False, round(2 * turns * TURN)) as walking:
        for turn in shown(range(2 * turns), name, 2 * turns):
            on = turn % 4 in (1, 2)  # off on on off: a drift of the machine cancels
            with _subscribed(walking) if on else contextlib.nullcontext():
                time.sleep(SETTLE)
                every[on].append(watched(TURN))
    whole = walking.read()
    used, word = calm_or_all(every)
    off, on_ = whole.p99(used[False]), whole.p99(used[True])
    note = f"{off:.0f} and {on_:.0f} µs, {len(used[False])} and {len(used[True])} {word} turns"
    yield Figure("timer", f"{name}, tick p99", 100.0 * (on_ / off - 1.0), "%", 5.0, note=note)


@contextlib.contextmanager
def _subscribed(walking: Walking) -> Iterator[None]:
    subscriber: Any = walking.station.session.declare_subscriber(walking.station.keys.tick, lambda _sample: None)
    try:
        yield
    finally:
        subscriber.undeclare()


@dataclass(frozen=True, slots=True)
class Calm:
    """What a slice's undisturbed windows hold."""

    windows: int
    lateness: np.ndarray
    """µs, one a tick."""
    missed: int
    """Deadlines without a tick of their own."""


def run_daemon(rate: float, fifo: bool, seconds: int) -> tuple[Calm, int]:
    """A daemon of its own, walking on the null body for ``seconds``: its undisturbed part, and windows in all."""
    with walking_daemon(rate, fifo, seconds) as walking:
        windows = watched_in_windows(seconds)
    return undisturbed(walking.read(), windows), len(windows)


def undisturbed(whole: Slice, windows: list[Window]) -> Calm:
    """The ticks of those windows that are calm."""
    lateness, missed, calm = [np.empty(0)], 0, [window for window in windows if window.calm]
    for window in calm:
        inside = whole.within(window)
        lateness.append(whole.lateness[inside])
        overruns = whole.overruns[inside]
        missed += int(overruns[-1] - overruns[0]) if len(overruns) else 0
    return Calm(len(calm), np.concatenate(lateness), missed)


def run_cyclictest(rate: float, fifo: bool, seconds: int) -> list[np.ndarray]:
    """Latencies of cyclictest's one thread at the same rate, µs, one a wake: of each undisturbed second."""
    command = ["cyclictest", "-q", "-t1", "-i", f"{1e6 / rate:.0f}", "-D", "1", "-h", "5000"]
    command += ["-m", "-p", str(PRIORITY)] if fifo else ["--policy=other"]
    answers = []
    for _ in range(seconds):
        before = stolen_time()
        answer = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        if stolen_time() == before:
            rows = re.findall(r"^(\d{6}) (\d+)$", answer, re.MULTILINE)
            answers.append(np.repeat([float(row[0]) for row in rows], [int(row[1]) for row in rows]))
    return answers
