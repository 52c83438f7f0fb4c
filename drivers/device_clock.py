"""A device's own time on this computer's monotonic clock."""

from __future__ import annotations

DRIFT = 100e-6
"""How fast the two clocks may part, s/s: what a cheap quartz does."""


class DeviceClock:
    """Maps ticks of a device to monotonic time by the fastest deliveries seen.

    A sample arrives later than it was taken, never earlier; the smallest difference of the two clocks is the best
    estimate of their offset. It may grow only as fast as clocks drift, so one slow delivery moves nothing.
    """

    def __init__(self, ticks_per_second: float, bits: int) -> None:
        """Ticks are counted modulo 2^``bits``."""
        self._period, self._mask = 1.0 / ticks_per_second, (1 << bits) - 1
        self.reset()

    def reset(self) -> None:
        """The device started over."""
        self._ticks: int | None = None
        self._time = 0.0
        self._offset = 0.0
        self._arrival = 0.0

    def stamp(self, ticks: int, arrival: float) -> float:
        """When the sample with ``ticks`` was taken, s on the clock of ``arrival``; never later than ``arrival``."""
        if self._ticks is None:
            self._offset, self._time = arrival, 0.0
        else:
            self._time += (ticks - self._ticks & self._mask) * self._period
            allowed = self._offset + DRIFT * (arrival - self._arrival)
            self._offset = min(allowed, arrival - self._time)
        self._ticks, self._arrival = ticks, arrival
        return self._time + self._offset
