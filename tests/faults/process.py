"""Faults of the process around the loop, again and again: signals, stopped and busy processors, disks, clients, clocks.

Each is a test of ``tests/test_process_faults.py`` in an interpreter of its own; what differs from one time to the next
is what the machine makes of it.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from faults.watch import Outcome

FILE = Path(__file__).parents[1] / "test_process_faults.py"
PATIENCE = 300.0
"""s that one may take before it is called hung."""


def find(rows: list[str] | None = None) -> list[str]:
    """The tests' names, such as ``test_a_disk_that_refuses…[28]``; only those that contain one of ``rows``.

    Raises:
        RuntimeError: they cannot be collected.
    """
    listed = _pytest("--collect-only", str(FILE), patience=PATIENCE)
    names = [line.partition("::")[2] for line in listed.stdout.splitlines() if "::" in line]
    if not names:
        raise RuntimeError(f"{FILE.name} cannot be collected:\n{listed.stdout[-2000:]}{listed.stderr[-2000:]}")
    return [name for name in names if not rows or any(row in name for row in rows)]


def suffer(names: list[str], times: int) -> Iterator[Outcome]:
    """Every one of ``names``, ``times`` times, one after the other."""
    for again in range(times):
        for name in names:
            yield _run(name, again)


def command(row: str) -> str:
    """What shows one again."""
    return f"python -m pytest 'tests/{FILE.name}::{row}'"


def _run(name: str, again: int) -> Outcome:
    outcome = Outcome(row=name, gait="process", seed=again, body="process", fault="", violations=[])
    began = time.monotonic()
    try:
        result = _pytest(f"{FILE}::{name}", patience=PATIENCE)
    except subprocess.TimeoutExpired:
        outcome.violations.append(f"hung: not over after {PATIENCE:.0f} s")
    else:
        if result.returncode:
            told = [line for line in result.stdout.splitlines() if line.startswith("E ")]
            outcome.violations.append(told[0][1:].strip() if told else f"exit code {result.returncode}")
    outcome.ends = "as it must" if not outcome.violations else "otherwise"
    outcome.fault = f"{time.monotonic() - began:.1f} s"
    return outcome


def _pytest(*arguments: str, patience: float) -> subprocess.CompletedProcess[str]:
    words = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--no-header", *arguments]
    return subprocess.run(words, capture_output=True, text=True, check=False, timeout=patience, cwd=FILE.parents[1])
