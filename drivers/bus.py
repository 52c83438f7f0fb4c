"""What carries frames between this computer and the motors: the interface, its counters, one in-process.

A back-end carries frames ``(bus, arbitration id, data)``, buses counted from 0. Each tick is one ``cycle``: all frames
out, then replies handed to ``receive`` as they come, until it says that it has all or the time is up. The wires are in
``drivers.can_bus`` (python-can's, each in ``drivers.can_channels``) and ``drivers.pi3hat``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

Frame = tuple[int, int, bytes]
"""Bus (from 0), arbitration id, data."""
Receive = Callable[[int, int, bytes], bool]
"""Takes one frame; true when no more are awaited."""


@dataclass(slots=True)
class BusCounters:
    """What the wires did since the start."""

    sent: int = 0
    received: int = 0
    send_failures: int = 0
    """Frames that the kernel did not take: full queue, interface down."""
    error_frames: int = 0
    bus_off: int = 0
    reopened: int = 0

    def troubles(self) -> dict[str, int]:
        """What of it should not be, by its name."""
        return {
            "frames not sent": self.send_failures, "error frames": self.error_frames, "bus-off": self.bus_off,
            "bus reopened": self.reopened,
        }  # fmt: skip


class Bus(Protocol):
    """A back-end."""

    counters: BusCounters

    async def open(self, receive: Receive) -> None:
        """Open every channel.

        Raises:
            DriverError: names each channel that could not be opened, and why.
        """

    async def cycle(self, frames: Sequence[Frame], reply_time: float) -> None:
        """Send ``frames``; hand what comes in to ``receive`` until it returns true or ``reply_time`` s
        are over.

        What waited from before is handed over first. Never raises because of the wires: it counts.
        """

    async def close(self) -> None:
        """Release the wires. Never raises."""


class InProcessBus:
    """Motors that are objects of this process: ``answer`` is called with each frame and returns the replies.

    No time passes on this bus, so a missing reply is known at once.
    """

    def __init__(self, answer: Callable[[Frame], Sequence[Frame]]) -> None:
        self.counters = BusCounters()
        self._answer = answer
        self._receive: Receive = nobody

    async def open(self, receive: Receive) -> None:
        """See ``Bus.open``."""
        self._receive = receive

    async def cycle(self, frames: Sequence[Frame], reply_time: float) -> None:
        """See ``Bus.cycle``."""
        self.counters.sent += len(frames)
        for frame in frames:
            for bus, identifier, data in self._answer(frame):
                self.counters.received += 1
                self._receive(bus, identifier, data)

    async def close(self) -> None:
        """See ``Bus.close``."""
        self._receive = nobody


def nobody(bus: int, identifier: int, data: bytes) -> bool:
    """Receives for a bus that is not open."""
    return True
