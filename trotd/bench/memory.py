"""What a million ticks leave behind."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from pathlib import Path

from trotd.bench.report import Figure, Finding, shown
from trotd.bench.walk import record_walk


def resident() -> float:
    """Resident memory of this process, MiB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def measure(quick: bool) -> Iterator[Finding]:
    """Growth of the resident memory, after a twentieth to settle."""
    ticks = 100_000 if quick else 1_000_000
    walked = record_walk()
    controller = walked.controller()
    measurements, command = walked.measurements, walked.command
    rounds = ticks // len(measurements)
    before = resident()
    for turn in shown(range(rounds + rounds // 20), f"{ticks} ticks", rounds + rounds // 20):
        if turn == rounds // 20:
            gc.collect()
            before = resident()
        for measured in measurements:
            controller.step(measured, command)
    gc.collect()
    yield Figure("memory", f"growth over {rounds * len(measurements)} ticks", resident() - before, "MiB", 2.0)
