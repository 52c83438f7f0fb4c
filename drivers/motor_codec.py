"""What every motors' protocol can do, sans-I/O, and the choice of one."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from typing import Protocol

import numpy as np

from drivers.mit import MitCodec
from drivers.moteus import MoteusCodec, Reading
from drivers.robot import Array
from drivers.wiring import MotorsConfig

MODE, POSITION, VELOCITY, TORQUE, VOLTAGE, TEMPERATURE, FAULT = range(7)
"""Columns of a reading."""


class MotorCodec(Protocol):
    """A motors' protocol; ``MoteusCodec`` and ``MitCodec`` are such."""

    fd: bool
    running: int
    starting: tuple[int, ...]
    latches: frozenset[int]
    """Fault codes that only say that the motor stopped listening: a stop clears them for good."""
    command_ids: list[int]
    reply_ids: list[int]
    query: list[bytes]
    stop: list[bytes]
    enable: list[bytes] | None
    capacity: Array
    """The most that a frame can carry of position rad, velocity rad/s, torque N·m, stiffness N·m/rad and damping
    N·m·s/rad at the motor; what is more is clipped. Shape (5,)."""

    def encode(self, commands: Array) -> list[bytes]:
        """Frames for position, velocity, torque, kp, kd at the motors (n, 5)."""
        ...

    def motor_of(self, data: bytes) -> int | None:
        """The motor that a reply names in its data; None where its arbitration id does."""
        ...

    def decode(self, data: bytes) -> Reading:
        """One reply in wire units: mode, position, velocity, torque, voltage, temperature, fault."""
        ...

    def to_si(self, readings: Array) -> Array:
        """Rows of ``decode`` in SI units."""
        ...

    def fault(self, mode: int, fault: int) -> int:
        """The fault code of a motor that is not running."""
        ...

    def describe_fault(self, code: int) -> str:
        """A fault code in words."""
        ...


def build_codec(config: MotorsConfig) -> MotorCodec:
    """The codec that ``config`` asks for.

    Raises:
        ValueError: an id, model or bound that the protocol does not have.
    """
    ids = [motor for leg in config.id for motor in leg]
    if config.protocol == "mit":
        return MitCodec(ids, model=config.model)
    return MoteusCodec(
        ids,
        max_torque=np.tile(np.array(config.max_torque) / config.gear, 4),
        servo_kp=config.servo_kp,
        servo_kd=config.servo_kd,
        watchdog=config.watchdog,
        form=config.format,
    )


def as_array(readings: Sequence[Reading]) -> Array:
    """What ``decode`` gave, as ``to_si`` wants it. Shape (n, 7)."""
    return np.fromiter(chain.from_iterable(readings), np.float64, 7 * len(readings)).reshape(-1, 7)
