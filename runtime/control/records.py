"""The data that flows through the core: one command in, one numpy record out.

Every room of the core writes its results into one record of ``CONTROL_DTYPE``. The record is at once the core's
working memory, the telemetry on the wire and the row of the flight log, so nothing is copied or converted twice.

Frames: *body* (x forward, y left, z up); *heading* = body with roll and pitch removed, so its z is gravity's z.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum, IntFlag

import numpy as np
from numpy.typing import NDArray

from drivers.robot import Array

Fields = list[tuple[str, str] | tuple[str, str, tuple[int, ...]]]
Records = NDArray[np.void]
"""Array of numpy records; the core's are of shape (1,)."""


@dataclass(frozen=True, slots=True)
class VelocityCommand:
    """What the operator wants of the body, in the heading frame."""

    stamp: float = 0.0
    """When it arrived, s, monotonic clock of the daemon."""
    linear: Array = field(default_factory=lambda: np.zeros(2))
    """Forward and left, m/s. Shape (2,)."""
    yaw_rate: float = 0.0
    """Turn to the left, rad/s."""


class SolverStatus(IntEnum):
    """How the ground reaction forces of a tick were found."""

    IDLE = 0
    """No leg in stance: nothing to solve, zero force."""
    SOLVED = 1
    """The first solver's result was accepted."""
    SECOND = 2
    """The second solver's result was accepted."""
    LEAST_SQUARES = 3
    """Both solvers failed: clipped least squares."""
    FAILED = 4
    """Nothing finite: the daemon damps."""


class Clamp(IntFlag):
    """Why the motors get something else than was asked, or why a measurement was not taken as it came: ``clamps``."""

    SHIFT = 1
    """A foot shift beyond its bound."""
    WRENCH = 2
    """A wanted force or moment beyond its bound."""
    REACH = 4
    """A foot target outside the leg's workspace."""
    FRICTION = 8
    """A force on the edge of the friction pyramid or at a bound."""
    JOINT_LIMIT = 16
    """A joint target beyond the joint's range."""
    JOINT_SPEED = 32
    """A joint speed target beyond its bound."""
    TORQUE = 64
    """A foreseen motor torque beyond the peak."""
    COMMAND = 128
    """A velocity command beyond the robot's bounds."""
    EXPIRED = 256
    """The velocity command is too old: ramped to zero."""
    OBSERVATION = 512
    """A velocity error beyond the observation's bound."""
    THERMAL = 1024
    """A foreseen torque beyond what a motor so warm is given."""
    CURRENT = 2048
    """A foreseen torque beyond what a motor near its continuous rating is given."""
    SOFT_START = 4096
    """A foreseen torque beyond the bound that grows after the robot left DAMP."""
    FALLBACK = 8192
    """No solver's forces were accepted: clipped least squares instead."""
    SPEED = 16384
    """A velocity command beyond what heat and battery allow."""
    DEADMAN = 32768
    """The operator is gone: standing instead of what was asked last."""
    BLEND = 65536
    """Hand-over from one source of commands to the next."""
    COASTED = 131072
    """A motor's reading is older than a tick: its last one stands in."""
    EXTRAPOLATED = 262144
    """No new believable sample of the IMU: the last one carried on by its own rate of turn."""
    STOPPING = 524288
    """The robot is on its way to standing: at rest instead of what was asked."""
    CONTACT = 1048576
    """What a foot feels contradicts what its leg does: the gait's schedule says instead whether it is down."""


ESTIMATE_FIELDS: Fields = [
    ("height", "f8"),  # body origin above the supporting feet's ground, m
    ("rpy", "f8", (3,)),  # roll, pitch, yaw of the body in the world, rad
    ("twist", "f8", (6,)),  # linear then angular velocity of the body, heading frame, m/s and rad/s
    ("contacts", "u1", (4,)),  # 1 where the foot feels the ground
    ("contact_force", "f8", (4, 3)),  # ground on foot from joint torque, heading frame, N
    ("feet", "f8", (4, 3)),  # foot centres from the body origin, heading frame, m
    ("slope", "f8", (2,)),  # rise of the ground forward and to the left, heading frame
    ("position", "f8", (3,)),  # dead-reckoned body position in the world, m (drifts; for the eye only)
]
POLICY_FIELDS: Fields = [
    ("velocity_command", "f8", (3,)),  # vx, vy, yaw rate that the pipeline follows, heading frame
    ("observation", "f8", (28,)),  # scaled, as the policy sees it
    ("asked", "f8", (18,)),  # action before bounds: shifts (4, 3) m row by row, force N, moment N·m
    ("action", "f8", (18,)),  # action after bounds and the shift low-pass
]
FEET_FIELDS: Fields = [
    ("phase", "f8", (4,)),  # swing progress in [0, pi]
    ("stance", "u1", (4,)),  # 1 where the leg should carry
    ("touchdown", "f8", (4, 2)),  # where the foot is to land, heading frame from the body origin, m
    ("foot_targets", "f8", (4, 3)),  # where the foot is to be now, heading frame from the body origin, m
    ("target_wrench", "f8", (6,)),  # force and moment wanted about the centre of mass, gravity included
    ("grf", "f8", (4, 3)),  # ground reaction forces distributed to the feet, heading frame, N
    ("solver_status", "u1"),  # SolverStatus
    ("clamps", "u4"),  # Clamp bits of this tick
]
COMMAND_FIELDS: Fields = [
    ("command_position", "f8", (4, 3)),
    ("command_velocity", "f8", (4, 3)),
    ("command_kp", "f8", (4, 3)),
    ("command_kd", "f8", (4, 3)),
    ("command_torque", "f8", (4, 3)),
]
CONTROL_DTYPE = np.dtype(ESTIMATE_FIELDS + POLICY_FIELDS + FEET_FIELDS + COMMAND_FIELDS, align=True)
"""What one ``Controller.step`` computed."""
