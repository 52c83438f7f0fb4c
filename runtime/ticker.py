"""An absolute fixed-rate schedule on the event loop: a timerfd whose expirations the kernel counts.

The deadlines are ``start + k·period`` for ever: a late tick does not move the ones after it. ``wait`` wakes once for
every readable timer; when more than one deadline went by, the difference is the overruns.

A sleeping thread wakes some 30 to 150 µs after its timer. A ticker may therefore be woken ``early`` and wait out the
rest awake: what the kernel takes to wake it then no longer shows, at the cost of that time of one processor.
"""

from __future__ import annotations

import asyncio
import ctypes
import os
import struct
import time

TFD_TIMER_ABSTIME = 1
NANOSECONDS = 1_000_000_000

_libc = ctypes.CDLL(None, use_errno=True)
_count = struct.Struct("=Q")


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


class _Itimerspec(ctypes.Structure):
    _fields_ = (("interval", _Timespec), ("value", _Timespec))


def timerfd(first: int, period: int) -> int:
    """A non-blocking timerfd on CLOCK_MONOTONIC that expires at ``first`` and every ``period`` after, both in ns.

    ``os.timerfd_create`` is this, from Python 3.13 on.

    Raises:
        OSError: the kernel refused.
    """
    fd = _libc.timerfd_create(time.CLOCK_MONOTONIC, os.O_NONBLOCK | os.O_CLOEXEC)
    if fd < 0:
        raise OSError(ctypes.get_errno(), "timerfd_create")
    spec = _Itimerspec(_Timespec(*divmod(period, NANOSECONDS)), _Timespec(*divmod(first, NANOSECONDS)))
    if _libc.timerfd_settime(fd, TFD_TIMER_ABSTIME, ctypes.byref(spec), None) < 0:
        error = ctypes.get_errno()
        os.close(fd)
        raise OSError(error, "timerfd_settime")
    return int(fd)


class Ticker:
    """Wakes its one waiter at a fixed rate. Use as a context manager inside a running loop."""

    def __init__(self, rate_hz: float, early: float = 0.0) -> None:
        """Tick at ``rate_hz``, woken ``early`` s before every deadline and awake until it.

        Raises:
            ValueError: ``early`` is negative or more than half a period.
        """
        if not 0.0 <= early <= 0.5 / rate_hz:
            raise ValueError(f"early = {early:g} s, bound half of the period {1.0 / rate_hz:g} s")
        self.period = 1.0 / rate_hz
        """Between two deadlines, s."""
        self.index = 0
        """Number of the deadline that woke the last ``wait``, counted from 1."""
        self.overruns = 0
        """Deadlines that went by without a tick of their own."""
        self.stamp = 0.0
        """When the last ``wait`` returned, s monotonic."""
        self.elapsed = self.period
        """Between the last two wakes, s."""
        self.lateness = 0.0
        """Between the last deadline and the wake, s."""
        self._period_ns = round(NANOSECONDS / rate_hz)
        self._early_ns = round(NANOSECONDS * early)
        self._start_ns = 0
        self._pending = 0
        self._fd = -1
        self._waiter: asyncio.Future[None] | None = None
        self._loop: asyncio.AbstractEventLoop | None = None

    def __enter__(self) -> Ticker:
        self._loop = asyncio.get_running_loop()
        self._start_ns = time.monotonic_ns()
        self.stamp = self._start_ns / NANOSECONDS
        self._fd = timerfd(self._start_ns + self._period_ns - self._early_ns, self._period_ns)
        self._loop.add_reader(self._fd, self._expired)
        return self

    def __exit__(self, *_: object) -> None:
        assert self._loop is not None
        self._loop.remove_reader(self._fd)
        os.close(self._fd)
        self._fd = -1

    async def wait(self) -> int:
        """Sleep until the next deadline and return its index.

        Deadlines that passed since the last call are made up for by one immediate return; all but one of them are
        overruns.
        """
        assert self._loop is not None
        if self._pending:
            await asyncio.sleep(0)  # late already, but the loop's other callbacks (signals) must have their turn
        else:
            self._waiter = self._loop.create_future()
            await self._waiter
        self.index += self._pending
        self.overruns += self._pending - 1
        self._pending = 0
        deadline = self._start_ns + self.index * self._period_ns
        now = time.monotonic_ns()
        while now < deadline:
            now = time.monotonic_ns()
        stamp = now / NANOSECONDS
        self.elapsed = stamp - self.stamp
        self.stamp = stamp
        self.lateness = (now - deadline) / NANOSECONDS
        return self.index

    def _expired(self) -> None:
        (expirations,) = _count.unpack(os.read(self._fd, 8))
        self._pending += expirations
        if self._waiter is not None and not self._waiter.done():
            self._waiter.set_result(None)
