"""What the robot's sensors read: exact states in, a ``Measurement`` with their errors out. Knows no physics engine."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from drivers.description import JointLimits
from drivers.robot import Array, ImuSample, JointState, Measurement
from sim.scenario import Noise
from sim.sensing import ERRORS, READINGS, disturb, warm_motors

AMBIENT = 25.0
"""°C."""
RISE = 45.0
"""Warming of a motor that carries its continuous torque for ever, °C."""
WARMING_TIME = 200.0
"""Thermal time constant of a motor, s."""
VOLTAGE = 24.0
"""V."""
DRAWN = 100
"""Samples whose noise is drawn at once."""


class Sensors:
    """Noise, biases and motor temperatures of one episode."""

    def __init__(self, limits: JointLimits) -> None:
        self._square = np.tile(np.array(limits.continuous_torque) ** 2, (4, 1))
        self._no_fault = np.zeros((4, 3), dtype=np.int32)
        self._no_age = np.zeros((4, 3))
        for shared in (self._no_fault, self._no_age):
            shared.setflags(write=False)
        self.reset(Noise(), 0)

    def reset(self, noise: Noise, seed: int) -> None:
        """Start an episode: cold motors, new biases drawn from ``seed``."""
        self._noisy = noise != Noise()
        self._random = np.random.default_rng(seed)
        self._draws: Iterator[Array] = iter(())
        self._temperature = np.full((4, 3), AMBIENT)
        draw = self._random.standard_normal
        self._bias = np.concatenate([
            noise.joint_position_bias * draw(12), np.zeros(12), noise.joint_torque_bias * draw(12),
            noise.orientation_bias * draw(3), noise.angular_velocity_bias * draw(3),
            noise.linear_acceleration_bias * draw(3),
        ])  # fmt: skip
        white = (noise.joint_position, noise.joint_velocity, noise.joint_torque)
        self._sigma = np.repeat(
            [*white, noise.orientation, noise.angular_velocity, noise.linear_acceleration], [12, 12, 12, 3, 3, 3]
        )

    def warm(self, torque: Array, duration: float) -> None:
        """Carry ``torque`` (n, 12) N·m in n equal parts of ``duration`` s: I²R heat against a first-order loss."""
        share = duration / WARMING_TIME
        self._temperature = warm_motors(torque, self._temperature, self._square, AMBIENT, RISE, share)

    def read(self, stamp: float, exact: Array) -> Measurement:
        """One sample of everything.

        Args:
            stamp: s.
            exact: what sensors without error would read, as ``sensing.READINGS`` says. Shape (46,). Kept, not copied.
        """
        read = exact
        if self._noisy:
            read = np.empty(READINGS)
            disturb(exact, self._bias, self._sigma, self._draw(), read)
        position, velocity, torque = read[:36].reshape(3, 4, 3)
        return Measurement(
            stamp=stamp,
            imu=ImuSample(stamp, read[36:40], read[40:43], read[43:46]),
            joints=JointState(position, velocity, torque, self._temperature, self._no_fault, self._no_age),
            voltage=VOLTAGE,
        )

    def _draw(self) -> Array:
        """The next errors, of deviation one; drawn many at a time, which are the same numbers. Shape (45,)."""
        row = next(self._draws, None)
        if row is None:
            self._draws = iter(self._random.standard_normal((DRAWN, ERRORS)))
            row = next(self._draws)
        return row
