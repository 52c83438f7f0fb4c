"""What the robot's sensors read: exact states in, a ``Measurement`` with their errors out. Knows no physics engine."""

from __future__ import annotations

import numpy as np

from drivers.description import JointLimits
from drivers.robot import Array, ImuSample, JointState, Measurement
from sim.rotation import turned
from sim.scenario import Noise

AMBIENT = 25.0
"""°C."""
RISE = 45.0
"""Warming of a motor that carries its continuous torque for ever, °C."""
WARMING_TIME = 200.0
"""Thermal time constant of a motor, s."""
VOLTAGE = 24.0
"""V."""


class Sensors:
    """Noise, biases and motor temperatures of one episode."""

    def __init__(self, limits: JointLimits) -> None:
        self._continuous = np.array(limits.continuous_torque)
        self._no_fault = np.zeros((4, 3), dtype=np.int32)
        self._no_age = np.zeros((4, 3))
        for shared in (self._no_fault, self._no_age):
            shared.setflags(write=False)
        self.reset(Noise(), 0)

    def reset(self, noise: Noise, seed: int) -> None:
        """Start an episode: cold motors, new biases drawn from ``seed``."""
        self._noise = noise
        self._noisy = noise != Noise()
        self._random = np.random.default_rng(seed)
        self._temperature = np.full((4, 3), AMBIENT)
        draw = self._random.standard_normal
        self._position_bias = noise.joint_position_bias * draw((4, 3))
        self._torque_bias = noise.joint_torque_bias * draw((4, 3))
        self._tilt_bias = noise.orientation_bias * draw(3)
        self._rate_bias = noise.angular_velocity_bias * draw(3)
        self._force_bias = noise.linear_acceleration_bias * draw(3)

    def warm(self, mean_square_torque: Array, duration: float) -> None:
        """Carry ``mean_square_torque`` (4, 3) N²·m² for ``duration`` s: I²R heat against a first-order loss."""
        target = AMBIENT + RISE * mean_square_torque / self._continuous**2
        self._temperature = self._temperature + (target - self._temperature) * (duration / WARMING_TIME)

    def read(
        self,
        stamp: float,
        orientation: Array,
        angular_velocity: Array,
        specific_force: Array,
        joints: tuple[Array, Array, Array],
    ) -> Measurement:
        """One sample of everything.

        Args:
            stamp: s.
            orientation: wxyz, body to world. Shape (4,).
            angular_velocity: rad/s in the body frame. Shape (3,).
            specific_force: m/s² in the body frame. Shape (3,).
            joints: position rad, velocity rad/s and torque N·m, each (4, 3).
        """
        position, velocity, torque = joints
        if self._noisy:
            noise, draw = self._noise, self._random.standard_normal
            position = position + self._position_bias + noise.joint_position * draw((4, 3))
            velocity = velocity + noise.joint_velocity * draw((4, 3))
            torque = torque + self._torque_bias + noise.joint_torque * draw((4, 3))
            orientation = turned(orientation, self._tilt_bias + noise.orientation * draw(3))
            angular_velocity = angular_velocity + self._rate_bias + noise.angular_velocity * draw(3)
            specific_force = specific_force + self._force_bias + noise.linear_acceleration * draw(3)
        return Measurement(
            stamp=stamp,
            imu=ImuSample(stamp, orientation, angular_velocity, specific_force),
            joints=JointState(position, velocity, torque, self._temperature, self._no_fault, self._no_age),
            voltage=VOLTAGE,
        )
