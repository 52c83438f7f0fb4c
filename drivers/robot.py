"""The body behind one verb: the types of an exchange, the motors' law and the ``Robot`` protocol.

SI units, float64. Arrays of legs have rows ``FL FR BL BR`` and columns ``abduction hip knee`` (joints) or ``x y z``
(points and forces). Body frame: x forward, y left, z up.

Treat the records as frozen. They are not, because they are made every tick and freezing took 8 % of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LEGS = ("FL", "FR", "BL", "BR")
JOINTS = ("abduction", "hip", "knee")


@dataclass(slots=True)
class ImuSample:
    """What the inertial unit said last, in the body frame."""

    stamp: float
    """Time of the sample, s, monotonic clock."""
    orientation: Array
    """Unit quaternion w x y z that turns body into world. Shape (4,)."""
    angular_velocity: Array
    """Rate of turn in the body frame, rad/s. Shape (3,)."""
    linear_acceleration: Array
    """Specific force in the body frame, m/s²: +9.81 along z at rest. Shape (3,)."""


@dataclass(slots=True)
class JointState:
    """Twelve joints as their motors report them, at the joint (after gear, sign and offset)."""

    position: Array
    """Joint angle, rad. Shape (4, 3)."""
    velocity: Array
    """Joint speed, rad/s. Shape (4, 3)."""
    torque: Array
    """Torque that the motor exerts on the joint, N·m. Shape (4, 3)."""
    temperature: Array
    """Motor temperature, °C. Shape (4, 3)."""
    fault: NDArray[np.int32]
    """Fault code of each motor, 0 for none. Shape (4, 3)."""
    age: Array
    """Time since each motor's last reply, s. Shape (4, 3)."""


@dataclass(slots=True)
class Measurement:
    """All that one exchange brings back."""

    stamp: float
    """Time of the exchange, s, monotonic clock."""
    imu: ImuSample
    joints: JointState
    voltage: float
    """Supply voltage, V."""


@dataclass(slots=True)
class JointCommand:
    """What one exchange takes out: the inner loop of each motor runs it until the next one."""

    position: Array
    """Wanted joint angle, rad. Shape (4, 3)."""
    velocity: Array
    """Wanted joint speed, rad/s. Shape (4, 3)."""
    kp: Array
    """Stiffness, N·m/rad. Shape (4, 3)."""
    kd: Array
    """Damping, N·m·s/rad. Shape (4, 3)."""
    torque: Array
    """Feed-forward torque, N·m. Shape (4, 3)."""


def motor_torque(command: JointCommand, joints: JointState) -> Array:
    """Torque of every motor under ``command``, before its limits, N·m. Shape (4, 3). Paper Eq. 5-6.

    The one law: servos run it at tens of kHz, the simulator at every physics step, the guard to foresee saturation.
    """
    return (
        command.torque
        + command.kp * (command.position - joints.position)
        + command.kd * (command.velocity - joints.velocity)
    )


def damp_command(kd: float) -> JointCommand:
    """The safe command: no stiffness, no feed-forward, only damping ``kd`` in N·m·s/rad."""
    zero = np.zeros((4, 3))
    return JointCommand(position=zero, velocity=zero, kp=zero, kd=np.full((4, 3), kd), torque=zero)


class Robot(Protocol):
    """A body: hardware, wire twin and simulator alike."""

    async def connect(self) -> None:
        """Open everything, energise nothing.

        Raises:
            DriverError: one report that names every part that could not be reached.
        """

    async def exchange(self, command: JointCommand) -> Measurement:
        """Send ``command`` and bring back what the sensors read at that moment: one bus round trip, once a tick.

        The command acts from now until the next exchange, so a command computed from this measurement acts one period
        later, on every body.

        Raises:
            NotConnected: before ``connect`` or after ``close``.
            DriverError: nothing at all could be read.
        """

    async def close(self) -> None:
        """Leave the motors without torque and release the wires. Never raises."""

    @property
    def troubles(self) -> Mapping[str, int]:
        """What went wrong on the wires since ``connect``, counted, by its name; only what happened."""
