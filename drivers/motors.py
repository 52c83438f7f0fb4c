"""Twelve motors on their buses: one cycle a tick, at the joints' side of gear, sign and offset.

A joint's angle is ``direction · motor / gear − offset``; the gear is what the motor's own report does not yet contain
(1 where it speaks of its output shaft). A silent motor keeps its last reading, whose age tells.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from drivers.bus import Bus, Frame
from drivers.errors import CorruptFrame
from drivers.moteus import Reading
from drivers.motor_codec import (
    MODE,
    POSITION,
    TEMPERATURE,
    TORQUE,
    VELOCITY,
    VOLTAGE,
    MotorCodec,
    as_array,
    build_codec,
)
from drivers.motor_faults import MotorFaults
from drivers.robot import JOINTS, LEGS, Array, JointCommand, JointState
from drivers.wiring import MotorsConfig

_EXTRA_REPLIES = 2
"""One more than asked for may be the wire's doing."""


@dataclass(slots=True)
class MotorCounters:
    """Replies that were not the one awaited; the bus counts the rest."""

    missed: int = 0
    """Replies that did not come in their tick."""
    late: int = 0
    """Replies to an older tick; used, with their true age."""
    duplicate: int = 0
    foreign: int = 0
    """Frames that are not from a motor of ours: echoes, other devices."""
    corrupt: int = 0

    def troubles(self) -> dict[str, int]:
        """What of it should not be, by its name; echoes and other devices may well be there."""
        return {
            "replies missed": self.missed, "replies late": self.late, "replies twice": self.duplicate,
            "replies corrupt": self.corrupt,
        }  # fmt: skip


Purpose = Literal["command", "query", "stop"]


class Motors:
    """The motors of one robot on an open bus."""

    def __init__(
        self,
        config: MotorsConfig,
        bus: Bus,
        reply_time: float,
        *,
        codec: MotorCodec | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.config, self.bus = config, bus
        self.codec = codec or build_codec(config)
        self._faults = MotorFaults(self.codec, config.coasted_ticks)
        self.counters = MotorCounters()
        self._reply_time, self._clock = reply_time, clock
        self._bus_of = [number - 1 for leg in config.bus for number in leg]
        self._ids = [motor for leg in config.id for motor in leg]
        self._index = _index(self._bus_of, self._ids, self.codec)
        direction = np.array(config.direction, dtype=np.float64).ravel()
        gear = np.tile(np.array(config.gear), 4)
        self._to_joint, self._offset = direction / gear, np.array(config.offset).ravel()
        self._torque_to_joint = direction * gear
        self._scale = _command_scale(direction, gear)
        self._command = np.zeros((12, 5))
        self._frames: dict[Purpose, list[Frame]] = {
            "query": self._addressed(self.codec.query),
            "stop": self._addressed(self.codec.stop),
        }
        self.reset()

    def reset(self) -> None:
        """Forget every reading and fault."""
        self._readings: list[Reading] = [_NOTHING] * 12
        self._si = np.full((12, 7), np.nan)
        self._stamps = [-np.inf] * 12
        self._answered: set[int] = set()
        self._waiting, self._last_sent = False, -np.inf
        self._replies, self._cycles = [0] * 12, 0
        self._faults.reset()

    async def open(self) -> None:
        """Open the buses.

        Raises:
            DriverError: names each bus that could not be opened.
        """
        await self.bus.open(self._receive)

    async def close(self) -> None:
        """Release the buses. Never raises."""
        await self.bus.close()

    async def query(self) -> None:
        """Ask all motors how they are; energises nothing."""
        await self._cycle(self._frames["query"])

    async def stop(self) -> None:
        """Take the torque from all motors, which also clears the faults that they hold; ours stay until ``reset``."""
        self._faults.end_commands()
        await self._cycle(self._frames["stop"])

    async def command(self, command: JointCommand) -> None:
        """Send one tick's commands and gather the replies.

        Raises:
            ValueError: a number is not finite; nothing was sent.
        """
        if not self._faults.commanded:
            self._faults.begin_commands(self._clock())
            if self.codec.enable is not None:
                await self._cycle(self._addressed(self.codec.enable))
                return
        await self._cycle(self._addressed(self.codec.encode(self._at_motors(command))))

    def joint_state(self) -> JointState:
        """All motors' newest readings, at the joints."""
        now, si = self._clock(), self._si
        return JointState(
            position=(si[:, POSITION] * self._to_joint - self._offset).reshape(4, 3),
            velocity=(si[:, VELOCITY] * self._to_joint).reshape(4, 3),
            torque=(si[:, TORQUE] * self._torque_to_joint).reshape(4, 3),
            temperature=si[:, TEMPERATURE].reshape(4, 3),
            fault=self._faults.judge(self._readings, now).reshape(4, 3),
            age=(now - np.array(self._stamps)).reshape(4, 3),
        )

    @property
    def voltage(self) -> float:
        """Lowest supply voltage that a motor reports, V; NaN where none reports one."""
        volts = self._si[:, VOLTAGE]
        known = volts[np.isfinite(volts)]
        return float(known.min()) if len(known) else float("nan")

    @property
    def modes(self) -> list[int]:
        """What mode each motor says it is in."""
        return [int(reading[MODE]) for reading in self._readings]

    def silent(self, longer_than: float) -> list[int]:
        """Indices of the motors whose last reply is older than that, s."""
        now = self._clock()
        return [index for index, stamp in enumerate(self._stamps) if now - stamp > longer_than]

    def doubled(self) -> list[int]:
        """Indices of the motors that answered more often than they were asked: two share an id."""
        return [index for index, count in enumerate(self._replies) if count >= self._cycles + _EXTRA_REPLIES]

    @property
    def all_silent(self) -> bool:
        """Whether every motor missed more replies in a row than are coasted over."""
        return self._faults.all_silent

    def name(self, index: int) -> str:
        """``FL knee (id 13, bus 1)`` for 2."""
        return f"{LEGS[index // 3]} {JOINTS[index % 3]} (id {self._ids[index]}, bus {self._bus_of[index] + 1})"

    def describe_fault(self, code: int) -> str:
        """A fault code of ``joint_state`` in words."""
        return self._faults.describe(code)

    async def _cycle(self, frames: Sequence[Frame]) -> None:
        self._answered.clear()
        self._cycles += 1
        self._waiting = True
        self._last_sent = self._clock()
        await self.bus.cycle(frames, self._reply_time)
        self._waiting = False
        self._si = self.codec.to_si(as_array(self._readings))
        self.counters.missed += 12 - len(self._answered)
        self._faults.note_answers(self._answered)

    def _receive(self, bus: int, identifier: int, data: bytes) -> bool:
        counters = self.counters
        try:
            motor = self.codec.motor_of(data)
            index = self._index.get((bus, identifier, motor))
            if index is None:
                counters.foreign += 1
                return False
            reading = self.codec.decode(data)
        except CorruptFrame:
            counters.corrupt += 1
            return False
        self._readings[index] = reading
        self._replies[index] += 1
        if not self._waiting:
            counters.late += 1
            self._stamps[index] = self._last_sent
            self._faults.note_late_answer(index)
            return False
        counters.duplicate += index in self._answered
        self._answered.add(index)
        self._stamps[index] = self._clock()
        return len(self._answered) == 12

    def _at_motors(self, command: JointCommand) -> Array:
        matrix = self._command
        matrix[:, 0] = command.position.ravel()
        matrix[:, 0] += self._offset
        matrix[:, 1] = command.velocity.ravel()
        matrix[:, 2] = command.torque.ravel()
        matrix[:, 3] = command.kp.ravel()
        matrix[:, 4] = command.kd.ravel()
        scaled: Array = matrix * self._scale
        return scaled

    def _addressed(self, data: Sequence[bytes]) -> list[Frame]:
        return list(zip(self._bus_of, self.codec.command_ids, data, strict=True))


_NOTHING: Reading = (0, float("nan"), float("nan"), float("nan"), float("nan"), float("nan"), 0)


def _index(buses: Sequence[int], ids: Sequence[int], codec: MotorCodec) -> dict[tuple[int, int, int | None], int]:
    named = codec.motor_of(bytes([ids[0], *bytes(7)])) is not None
    keys = [
        (bus, identifier, motor if named else None)
        for bus, identifier, motor in zip(buses, codec.reply_ids, ids, strict=True)
    ]
    index = {key: place for place, key in enumerate(keys)}
    for place, key in enumerate(keys):
        if index[key] != place:
            first, second = (f"{LEGS[i // 3]} {JOINTS[i % 3]}" for i in (place, index[key]))
            raise ValueError(f"motors: {first} and {second} both have id {ids[place]} on bus {key[0] + 1}")
    return index


def _command_scale(direction: Array, gear: Array) -> Array:
    """Joint to motor, for position, velocity, torque, kp, kd. Shape (12, 5)."""
    angle = direction * gear
    return np.stack([angle, angle, direction / gear, 1.0 / gear**2, 1.0 / gear**2], axis=1)
