"""Rotations of the simulator: matrices turn body into world, quaternions are w x y z with w ≥ 0."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from drivers.robot import Array


def about_axis(axis: Array, angle: float) -> Array:
    """Rotation by ``angle`` rad about the unit vector ``axis`` (Rodrigues). Shape (3, 3)."""
    x, y, z = axis
    skew: Array = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    rotation: Array = np.eye(3) + math.sin(angle) * skew + (1 - math.cos(angle)) * (skew @ skew)
    return rotation


def from_rpy(rpy: Sequence[float] | Array) -> Array:
    """Rotation matrix of roll, pitch, yaw in rad, as URDF has it: yaw · pitch · roll. Shape (3, 3)."""
    roll, pitch, yaw = rpy
    x, y, z = np.eye(3)
    return about_axis(z, yaw) @ about_axis(y, pitch) @ about_axis(x, roll)


def to_rpy(rotation: Array) -> Array:
    """Roll, pitch, yaw of a rotation matrix, rad. Shape (3,)."""
    pitch = math.atan2(-rotation[2, 0], math.hypot(rotation[0, 0], rotation[1, 0]))
    if math.cos(pitch) < 1e-9:
        return np.array([math.atan2(-rotation[1, 2], rotation[1, 1]), pitch, 0.0])
    roll = math.atan2(rotation[2, 1], rotation[2, 2])
    return np.array([roll, pitch, math.atan2(rotation[1, 0], rotation[0, 0])])


def from_xyzw(quaternion: Sequence[float]) -> Array:
    """Rotation matrix of a unit quaternion in the physics engine's order x y z w. Shape (3, 3)."""
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def to_quaternion(rotation: Array) -> Array:
    """Unit quaternion w x y z of a rotation matrix, from its largest component. Shape (4,)."""
    (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
    squares = (1 + a + e + i, 1 + a - e - i, 1 - a + e - i, 1 - a - e + i)
    largest = squares.index(max(squares))
    rows = (
        (squares[0], h - f, c - g, d - b),
        (h - f, squares[1], b + d, c + g),
        (c - g, b + d, squares[2], f + h),
        (d - b, c + g, f + h, squares[3]),
    )
    quaternion: Array = np.array(rows[largest]) / (2 * math.sqrt(squares[largest]))
    return quaternion if quaternion[0] >= 0 else -quaternion
