"""The machine under a bench: whether its host ran something else on the processors that it lends us."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

Kind = TypeVar("Kind")
WINDOW = 1.0
"""s in which the host took time or took none."""
STEAL = 8
"""Column of /proc/stat (proc(5)): time that the host of a virtual machine gave to others; 0 on a machine of its own."""


@dataclass(frozen=True, slots=True)
class Window:
    """A stretch of time and what the host took from it."""

    begin: float
    """s monotonic."""
    end: float
    """s monotonic."""
    stolen: float
    """s, of all processors together, in steps of the kernel's clock (10 ms as a rule)."""

    @property
    def calm(self) -> bool:
        """Whether all of it was ours."""
        return self.stolen == 0.0


def stolen_time() -> float:
    """Time that the host has given to others since the machine started, s of all processors together."""
    total = Path("/proc/stat").read_text().partition("\n")[0].split()
    return int(total[STEAL]) / os.sysconf("SC_CLK_TCK")


def watched(seconds: float) -> Window:
    """Sleep for ``seconds``; what the host took meanwhile."""
    begin, before = time.monotonic(), stolen_time()
    time.sleep(seconds)
    return Window(begin, time.monotonic(), stolen_time() - before)


def watched_in_windows(seconds: float) -> list[Window]:
    """The same in windows of ``WINDOW`` s."""
    windows, end = [], time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0.0:
        windows.append(watched(min(WINDOW, left)))
    return windows


def calm_or_all(kinds: Mapping[Kind, list[Window]]) -> tuple[dict[Kind, list[Window]], str]:
    """The calm windows of each kind, or all of them where a kind has none that is calm; and in a word, which."""
    calm = {kind: [window for window in windows if window.calm] for kind, windows in kinds.items()}
    return (calm, "undisturbed") if all(calm.values()) else (dict(kinds), "disturbed")
