"""A long outing through the core again: bit for bit the same, and how fast; a tampered one must be found out."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from runtime.messages.mode import Mode, Request
from runtime.recording import Recording, load
from runtime.replay import Player, replay
from trotd.bench.outing import Outing
from trotd.bench.report import Figure, Finding, shown

MINUTES, QUICK_MINUTES = 10.0, 0.5
ROOM = 30.0
"""The recorder keeps this much more, s: the outing from its first tick on."""
STRETCH = 5.0
"""Simulated seconds under one velocity."""
LEGS_OF_THE_WAY = ((0.6, 0.0, 0.0), (0.4, 0.1, 0.5), (0.3, -0.1, -0.6), (-0.3, 0.0, 0.2), (0.0, 0.2, 0.0))
"""m/s, m/s, rad/s in turn."""


def measure(quick: bool) -> Iterator[Finding]:
    """Walk for minutes as fast as the simulator goes, write the recording, read it back and replay it."""
    minutes = QUICK_MINUTES if quick else MINUTES
    with tempfile.TemporaryDirectory(prefix="trotd-bench-") as folder:
        recording = load(record(Path(folder), 60.0 * minutes))
    next(Player(recording).play(), None)  # compiled code is loaded before the clock runs
    began = time.perf_counter()
    result = replay(recording)
    taken = time.perf_counter() - began
    whole = result.difference is None
    words = f"bit for bit the same, {result.skipped} tick before the keyframe" if whole else str(result.difference)
    name = f"{minutes:g} minutes"
    walked = result.modes.get("WALK", 0)
    yield Figure("replay", f"{name}: ticks replayed", result.ticks, note=f"{walked} of them walking")
    yield Figure("replay", f"{name}: ticks that differ", 0.0 if whole else 1.0, bound=0.0, note=words)
    yield Figure("replay", f"{name}: times real time", result.ticks / recording.header.rate_hz / taken, "x", 10.0, ">=")
    yield _tampered(recording)


def record(folder: Path, seconds: float) -> Path:
    """A recording of ``seconds`` at least: stand up, walk this way and that, be pushed, sit down."""
    outing = Outing(folder, seconds=seconds + ROOM)
    outing.stand()
    outing.ask(Request.WALK)
    stretches = math.ceil((seconds - outing.index / outing.config.control.rate_hz) / STRETCH)
    for stretch in shown(range(stretches), "simulated walk", stretches):
        outing.world.push((0.0, 100.0 * (-1.0) ** stretch, 0.0), 0.1)
        outing.run(STRETCH, LEGS_OF_THE_WAY[stretch % len(LEGS_OF_THE_WAY)])
    outing.ask(Request.STAND)
    outing.run(1.0)
    outing.ask(Request.SIT)
    outing.until(lambda: outing.cycle.state.mode is Mode.DAMP)
    outing.world.close()
    return outing.write("outing")


def _tampered(recording: Recording) -> Figure:
    """One bit of one torque, late in the recording."""
    ticks = recording.ticks.copy()
    place = int(np.flatnonzero(ticks["mode"] == Mode.WALK)[-100])
    ticks["command_torque"].view(np.uint64)[place, 2, 1] ^= 1
    difference = replay(Recording(recording.path, recording.header, ticks)).difference
    found = difference is not None and difference.tick == ticks["index"][place] and difference.stage == "command"
    words = f"tick {ticks['index'][place]}: found as {difference}"
    return Figure("replay", "one changed bit is found in its tick and stage", float(found), "", 1.0, ">=", words)
