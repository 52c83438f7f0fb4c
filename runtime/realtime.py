"""What is asked of the kernel and of the interpreter so that the tick is on time: each tried, each reported.

SCHED_FIFO and the affinity hold for the calling thread only; RESET_ON_FORK keeps the threads it starts normal.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from runtime.parameters import RealtimeConfig

MCL_CURRENT, MCL_FUTURE = 1, 2
SWITCH = 0.0002
"""s; Python's own is 5 ms, a whole tick: the writer of a recording would make the loop miss one."""


class RealtimeError(RuntimeError):
    """The configuration requires what the kernel refused."""


@dataclass(frozen=True, slots=True)
class Granted:
    """The answer to one wish."""

    wish: str
    granted: bool
    detail: str

    def __str__(self) -> str:
        return f"{self.wish}: {'granted' if self.granted else 'refused'} ({self.detail})"


def apply(config: RealtimeConfig) -> list[Granted]:
    """Ask for everything that ``config`` wishes for the calling thread.

    Raises:
        RealtimeError: something was refused and the configuration requires it.
    """
    answers = [answer for wish in (_fifo, _affinity, _lock) if (answer := wish(config)) is not None]
    refused = [str(answer) for answer in answers if not answer.granted]
    if refused and config.required:
        raise RealtimeError(f"realtime.required = true, but {'; '.join(refused)}")
    return answers


def _fifo(config: RealtimeConfig) -> Granted | None:
    if not config.priority:
        return None
    policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
    return _try(
        f"SCHED_FIFO {config.priority}", lambda: os.sched_setscheduler(0, policy, os.sched_param(config.priority))
    )


def _affinity(config: RealtimeConfig) -> Granted | None:
    if not config.cpus:
        return None
    return _try(f"processors {sorted(config.cpus)}", lambda: os.sched_setaffinity(0, config.cpus))


def _lock(config: RealtimeConfig) -> Granted | None:
    return _try("mlockall", _mlockall) if config.lock_memory else None


def _try(wish: str, act: Callable[[], None]) -> Granted:
    try:
        act()
    except OSError as error:
        return Granted(wish, False, os.strerror(error.errno or 0))
    return Granted(wish, True, "in force")


def _mlockall() -> None:
    if ctypes.CDLL(None, use_errno=True).mlockall(MCL_CURRENT | MCL_FUTURE) < 0:
        raise OSError(ctypes.get_errno(), "mlockall")


@contextlib.contextmanager
def shared_interpreter() -> Iterator[None]:
    """A thread that computes in Python holds the interpreter for ``SWITCH`` at most while another wants it."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH)
    try:
        yield
    finally:
        sys.setswitchinterval(before)


def settle_garbage() -> None:
    """Collect once and set everything that lives aside, so that no later collection looks at it: before the loop."""
    gc.collect()
    gc.freeze()


def hold_garbage(hold: bool) -> None:
    """Collect no more, while armed; or let the collector work again."""
    (gc.disable if hold else gc.enable)()
