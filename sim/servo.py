"""What every servo emulator shows to the wire twin: frames in and out, a shaft driven and sensed."""

from __future__ import annotations

from typing import NamedTuple, Protocol


class Drive(NamedTuple):
    """What a servo does to its output shaft from now on: the law of ``drivers.robot.motor_torque``, at the motor."""

    position: float = 0.0
    """rad."""
    velocity: float = 0.0
    """rad/s."""
    torque: float = 0.0
    """N·m."""
    kp: float = 0.0
    """N·m/rad."""
    kd: float = 0.0
    """N·m·s/rad."""


LIMP = Drive()


class ServoEmulator(Protocol):
    """One servo. Angles and torques at its output shaft, SI units."""

    id: int

    @property
    def energised(self) -> bool:
        """Whether it drives its shaft, or brakes it."""
        ...

    def answer(self, identifier: int, data: bytes, now: float) -> tuple[int, bytes] | None:
        """Obey one frame; the reply's arbitration id and data, or None where it gives none."""

    def step(self, now: float) -> Drive:
        """Let its clocks run to ``now``, s, and say what it does to the shaft."""
        ...

    def sense(self, position: float, velocity: float, torque: float, temperature: float) -> None:
        """What its sensors now read: rad, rad/s, N·m, °C."""
