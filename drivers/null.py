"""The null body: twelve ideal joints in an upright trunk that touches nothing. For the loop without any physics."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from drivers.errors import NotConnected
from drivers.robot import Array, ImuSample, JointCommand, JointState, Measurement, motor_torque

GRAVITY = 9.81
COMPLIANCE = 1e-6
"""How far a joint gives under torque, rad/(N·m): no encoder stands still to the last bit under a changing one."""


class NullRobot:
    """Answers every exchange with plausible readings: stiff commands are reached at once, limp ones move nothing."""

    def __init__(self, joint_position: Array, clock: Callable[[], float] = time.monotonic) -> None:
        """Start at ``joint_position`` (4, 3), rad."""
        self.position = joint_position.copy()
        self._clock = clock
        self._connected = False

    async def connect(self) -> None:
        """Nothing to open."""
        self._connected = True

    async def exchange(self, command: JointCommand) -> Measurement:
        """What the sensors read now; the command shows at the next one.

        Raises:
            NotConnected: before ``connect`` or after ``close``.
        """
        if not self._connected:
            raise NotConnected("the null body is not connected")
        stamp = self._clock()
        zero = np.zeros((4, 3))
        joints = JointState(self.position.copy(), zero, zero, np.full((4, 3), 25.0), np.zeros((4, 3), np.int32), zero)
        stiff = command.kp > 0.0
        self.position = np.where(stiff, command.position + COMPLIANCE * command.torque, self.position)
        torque = np.where(stiff, motor_torque(command, joints), 0.0)
        joints = JointState(joints.position, zero, torque, joints.temperature, joints.fault, joints.age)
        imu = ImuSample(stamp, np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3), np.array([0.0, 0.0, GRAVITY]))
        return Measurement(stamp, imu, joints, 48.0)

    @property
    def troubles(self) -> dict[str, int]:
        """None: there are no wires."""
        return {}

    async def close(self) -> None:
        """Nothing to close."""
        self._connected = False
