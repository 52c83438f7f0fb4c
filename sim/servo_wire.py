"""The motors' end of the buses: servo emulators that answer frames, with all that can go wrong on a wire."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from drivers.bus import BusCounters, Frame
from drivers.can_channels import Channel, open_channel
from drivers.wiring import BusConfig
from sim.servo import ServoEmulator


@dataclass(slots=True)
class WireFaults:
    """Knobs, per reply: probabilities, and a delay for all."""

    drop: float = 0.0
    duplicate: float = 0.0
    corrupt: float = 0.0
    delay: float = 0.0
    """s."""
    unplugged: set[int] = field(default_factory=set)
    """Buses (from 0) that carry nothing."""


class ServoWire:
    """Servos by their bus (from 0). ``answer`` is the whole wire without time; ``open`` puts it on real channels."""

    def __init__(
        self,
        servos: Mapping[int, Iterable[ServoEmulator]],
        clock: Callable[[], float],
        seed: int = 0,
    ) -> None:
        self.servos = {bus: list(members) for bus, members in servos.items()}
        self._by_id = {(bus, servo.id): servo for bus, members in self.servos.items() for servo in members}
        self.faults = WireFaults()
        self.counters = BusCounters()
        self.asked: set[tuple[int, int]] = set()
        """(bus, arbitration id) of the frames since somebody last looked: all servos' means a tick is complete."""
        self.ticked = asyncio.Event()
        """Set when every servo was addressed once more."""
        self._clock = clock
        self._random = np.random.default_rng(seed)
        self._channels: dict[int, Channel] = {}

    def answer(self, frame: Frame) -> list[Frame]:
        """All replies to one frame, after the wire's faults other than delay."""
        bus, identifier, data = frame
        faults = self.faults
        if bus in faults.unplugged:
            return []
        replies: list[Frame] = []
        for servo in self._addressed(bus, identifier & 0x7F):
            reply = servo.answer(identifier, data, self._clock())
            if reply is None or self._happens(faults.drop):
                continue
            if self._happens(faults.corrupt):
                reply = reply[0], self._damaged(reply[1])
            replies += [(bus, *reply)] * (2 if self._happens(faults.duplicate) else 1)
        return replies

    def open(self, config: BusConfig, fd: bool) -> None:
        """Listen on every channel.

        Raises:
            DriverError: one cannot be opened.
        """
        loop = asyncio.get_running_loop()
        for bus in range(len(config.channels)):
            channel = open_channel(config, bus, self.counters, fd)
            self._channels[bus] = channel
            if channel.fileno() < 0:
                raise ValueError(f"{config.backend} has nothing to wait on: the twin needs udp_multicast or socketcan")
            loop.add_reader(channel.fileno(), self._readable, bus)

    def close(self) -> None:
        """Leave the channels. Harmless when repeated."""
        for channel in self._channels.values():
            asyncio.get_running_loop().remove_reader(channel.fileno())
            channel.close()
        self._channels.clear()

    def _addressed(self, bus: int, motor: int) -> Sequence[ServoEmulator]:
        servo = self._by_id.get((bus, motor))
        return self.servos.get(bus, ()) if servo is None else (servo,)

    def _readable(self, bus: int) -> None:
        for identifier, data in self._channels[bus].read():
            if (bus, identifier & 0x7F) in self._by_id:
                self.asked.add((bus, identifier))
            for reply in self.answer((bus, identifier, data)):
                if self.faults.delay:
                    asyncio.get_running_loop().call_later(self.faults.delay, self._send, reply)
                else:
                    self._send(reply)
        if len(self.asked) >= len(self._by_id):
            self.asked.clear()
            self.ticked.set()

    def _send(self, reply: Frame) -> None:
        bus, identifier, data = reply
        channel = self._channels.get(bus)
        if channel is None:
            return
        try:
            channel.send(identifier, data)
            self.counters.sent += 1
        except OSError:
            self.counters.send_failures += 1

    def _happens(self, probability: float) -> bool:
        return probability > 0.0 and self._random.random() < probability

    def _damaged(self, data: bytes) -> bytes:
        place = int(self._random.integers(len(data)))
        return data[:place] + bytes([data[place] ^ 1 << int(self._random.integers(8))]) + data[place + 1 :]
