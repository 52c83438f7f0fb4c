"""The machine under a bench: whether its host ran something else on the processors that it lends us."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path

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


def watched(seconds: float) -> list[Window]:
    """Sleep for ``seconds``; what the host took meanwhile, in windows of ``WINDOW`` s."""
    windows, end = [], time.monotonic() + seconds
    while (begin := time.monotonic()) < end:
        before = stolen_time()
        time.sleep(min(WINDOW, end - begin))
        windows.append(Window(begin, time.monotonic(), stolen_time() - before))
    return windows
