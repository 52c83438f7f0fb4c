"""Where everything is for the eye: legs, frames and turns of many ticks at once."""

from __future__ import annotations

import numpy as np

from drivers.description import SIDE, RobotDescription
from drivers.robot import Array
from runtime.control.records import Records


def leg_points(description: RobotDescription, joint_position: Array) -> Array:
    """Abduction axis, end of the abduction link, knee and foot of every leg, body frame, m.

    Args:
        description: the robot.
        joint_position: rad. Shape (n, 4, 3).

    Returns:
        Shape (n, 4, 4, 3): tick, leg, point, x y z. Method: Frames and signs.
    """
    q1, q2, q3 = np.moveaxis(joint_position, -1, 0)
    hips = np.broadcast_to(description.hips, (*q1.shape, 3))
    offset = SIDE * description.abduction_length
    sideways = np.stack([np.zeros_like(q1), np.cos(q1), np.sin(q1)], axis=-1)
    down = np.stack([np.zeros_like(q1), np.sin(q1), -np.cos(q1)], axis=-1)
    forward = np.zeros_like(down)
    forward[..., 0] = 1.0
    thigh = _link(description.thigh_length, q2, forward, down)
    shank = _link(description.shank_length, q2 + q3, forward, down)
    shoulder = hips + offset[:, None] * sideways
    return np.stack([hips, shoulder, shoulder + thigh, shoulder + thigh + shank], axis=-2)


def _link(length: float, angle: Array, forward: Array, down: Array) -> Array:
    return length * (np.cos(angle)[..., None] * down - np.sin(angle)[..., None] * forward)


def yaw_quaternion(yaw: Array) -> Array:
    """Turn about z, x y z w. Shape (n, 4)."""
    zero = np.zeros_like(yaw)
    return np.stack([zero, zero, np.sin(yaw / 2), np.cos(yaw / 2)], axis=-1)


def orientation_xyzw(ticks: Records) -> Array:
    """Body to world, x y z w; level where the IMU said nothing. Shape (n, 4)."""
    turned = np.roll(ticks["orientation"], -1, axis=-1)
    silent = np.abs(turned).sum(axis=-1) == 0.0
    turned[silent] = (0.0, 0.0, 0.0, 1.0)
    return turned


def body_position(ticks: Records) -> Array:
    """Body origin for the eye: dead-reckoned in the plane, above the ground as estimated, m. Shape (n, 3)."""
    position = ticks["position"].copy()
    position[:, 2] = ticks["height"]
    return position


def heading_to_world(ticks: Records, points: Array) -> Array:
    """Points (n, k, 3) of the heading frame in the world, m."""
    yaw = ticks["rpy"][:, 2, None]
    x, y, z = np.moveaxis(points, -1, 0)
    turned = np.stack([np.cos(yaw) * x - np.sin(yaw) * y, np.sin(yaw) * x + np.cos(yaw) * y, z], axis=-1)
    return turned + body_position(ticks)[:, None, :]
