"""Faults on the wire twin: knobs of its servos, wires and IMU, behind the real drivers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from drivers.bus import Frame
from faults.imu import product, turn
from faults.rig import Fault, Rig


def servo(rig: Rig, joint: int) -> Any:
    return rig.walk.twin.servos[joint]


@dataclass
class Servos(Fault):
    """``turn`` is done to each of the servos ``joints``."""

    joints: tuple[int, ...]
    turn: Callable[[Any], None]
    words: str

    def start(self, rig: Rig) -> None:
        for joint in self.joints:
            self.turn(servo(rig, joint))

    def __repr__(self) -> str:
        return f"{self.words}{list(self.joints)}"


@dataclass
class Overheating(Fault):
    joint: int
    rise: float

    def start(self, rig: Rig) -> None:
        rig.walk.twin.overheating[self.joint] = self.rise


@dataclass
class BusOff(Fault):
    """Buses that carry nothing."""

    buses: tuple[int, ...]

    def start(self, rig: Rig) -> None:
        rig.walk.twin.wire.faults.unplugged.update(self.buses)


class Wires:
    """What lies between the driver and ``answer``: both ways may lose frames, replies may be late or spoilt."""

    def __init__(self, rig: Rig, seed: int) -> None:
        self.bus = rig.walk.motors.bus
        self.answer = self.bus._answer  # type: ignore[attr-defined]
        self.random = np.random.default_rng(seed)
        self.bus._answer = self.carry  # type: ignore[attr-defined]
        self.loss = self.spoilt = 0.0
        self.late = 0
        self._ways: list[list[Frame]] = []

    def carry(self, frame: Frame) -> Sequence[Frame]:
        if self._happens(self.loss):
            return []
        replies = [self._spoil(reply) for reply in self.answer(frame) if not self._happens(self.loss)]
        if not self.late:
            return replies
        self._ways[-1] += replies
        return []

    def tick(self) -> None:
        """A tick begins: what is late enough has arrived since the last one."""
        if self.late:
            self._ways.append([])
            if len(self._ways) > self.late:
                for reply in self._ways.pop(0):
                    self.bus._receive(*reply)  # type: ignore[attr-defined]

    def _spoil(self, frame: Frame) -> Frame:
        bus, identifier, data = frame
        if not self._happens(self.spoilt):
            return frame
        place = int(self.random.integers(len(data)))
        return (
            bus,
            identifier,
            data[:place] + bytes([data[place] ^ 1 << int(self.random.integers(8))]) + data[place + 1 :],
        )

    def _happens(self, share: float) -> bool:
        return share > 0.0 and self.random.random() < share


@dataclass
class BadWires(Fault):
    """All buses lose and spoil a share of the frames; replies arrive some ticks late."""

    loss: float = 0.0
    spoilt: float = 0.0
    late: int = 0
    seed: int = 0

    def start(self, rig: Rig) -> None:
        self._wires = Wires(rig, self.seed)
        self._wires.loss, self._wires.spoilt, self._wires.late = self.loss, self.spoilt, self.late

    def stall(self, rig: Rig) -> int:
        self._wires.tick()
        return 0


@dataclass
class SameId(Fault):
    """The servo at ``gone`` has the id of the one at ``kept``, on one bus: both hear it, both answer."""

    kept: int
    gone: int

    def start(self, rig: Rig) -> None:
        wire, kept = rig.walk.twin.wire, servo(rig, self.kept)
        for key in [key for key, member in wire._by_id.items() if member is kept]:
            del wire._by_id[key]
        servo(rig, self.gone).id = kept.id


Felt = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Orientation, rate of turn and acceleration in the IMU's own frame."""


class Freeze:
    """The first sample for ever."""

    first: Felt | None = None

    def __call__(self, felt: Felt, count: int) -> Felt:
        self.first = self.first or felt
        return self.first


def mute(felt: Felt, count: int) -> None:
    """Nothing."""


@dataclass
class Spoil:
    """One of the ten numbers is ``value``."""

    place: int
    value: float

    def __call__(self, felt: Felt, count: int) -> Felt:
        parts = [part.copy() for part in felt]
        part, place = next(
            (part, place)
            for part, place in zip(parts, (self.place, self.place - 4, self.place - 7), strict=True)
            if place < len(part)
        )
        part[place] = self.value
        return parts[0], parts[1], parts[2]


@dataclass
class Flip:
    """Half a turn about x or y."""

    axis: int

    def __call__(self, felt: Felt, count: int) -> Felt:
        sign = -np.ones(3)
        sign[self.axis] = 1.0
        return product(felt[0], turn(self.axis, np.pi)), sign * felt[1], sign * felt[2]


@dataclass
class Gap:
    """So many samples are missing."""

    samples: int

    def __call__(self, felt: Felt, count: int) -> Felt | None:
        return None if count <= self.samples else felt


@dataclass
class Every:
    """Only every ``divisor``-th sample comes."""

    divisor: int

    def __call__(self, felt: Felt, count: int) -> Felt | None:
        return None if count % self.divisor else felt


@dataclass
class ImuBytes(Fault):
    """What the IMU feels is altered on its way into the device, or the device falls silent."""

    alter: Callable[[Felt, int], Felt | None]
    words: str

    def start(self, rig: Rig) -> None:
        imu = rig.walk.lockstep_imu
        take, count = imu.take, 0

        def altered(now: float, felt: Felt) -> None:
            nonlocal count
            count += 1
            other = self.alter(felt, count)
            if other is not None:
                take(now, other)

        imu.take = altered  # type: ignore[method-assign]

    def __repr__(self) -> str:
        return f"{self.words} {self.alter}"
