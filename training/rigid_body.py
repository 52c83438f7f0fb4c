"""The robot as one rigid body on massless legs: what the teacher believes (paper Section IV.A).

State x = [p, ṗ, θ, ω] (12): centre of mass and its velocity in the world, orientation as roll, pitch, yaw, and angular
velocity in the world. Input: the ground reaction forces of four feet.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from drivers.description import RobotDescription, composite_inertia
from drivers.robot import Array
from runtime.control.compilation import compiled

GRAVITY = 9.81
STATES = 12
P, V, R, W = 0, 3, 6, 9
"""Where position, velocity, orientation and angular velocity start in the state."""


@dataclass(frozen=True, slots=True)
class RigidBody:
    """One robot's mass properties, all links taken together in the stand pose."""

    mass: float
    """kg."""
    inertia: Array
    """About the centre of mass, body frame, kg·m². Shape (3, 3)."""
    com: Array
    """Centre of mass from the body origin, body frame, m. Shape (3,)."""


def rigid_body(description: RobotDescription, joint_position: Array) -> RigidBody:
    """Freeze the robot at ``joint_position`` (4, 3) rad, its stand pose."""
    com, inertia = composite_inertia(description, joint_position)
    return RigidBody(mass=description.mass, inertia=inertia, com=com)


@compiled
def rotation_from_rpy(rpy, rotation):  # type: ignore[no-untyped-def]
    """Rotation body to world, Rz(yaw) Ry(pitch) Rx(roll), written into ``rotation`` (3, 3)."""
    sr, cr = math.sin(rpy[0]), math.cos(rpy[0])
    sp, cp = math.sin(rpy[1]), math.cos(rpy[1])
    sy, cy = math.sin(rpy[2]), math.cos(rpy[2])
    rotation[0, 0], rotation[0, 1], rotation[0, 2] = cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr
    rotation[1, 0], rotation[1, 1], rotation[1, 2] = sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr
    rotation[2, 0], rotation[2, 1], rotation[2, 2] = -sp, cp * sr, cp * cr


@compiled
def rpy_rates(rpy, angular_velocity, rates):  # type: ignore[no-untyped-def]
    """Derivative of roll, pitch, yaw from the angular velocity in the world, exact, into ``rates`` (3,)."""
    sy, cy = math.sin(rpy[2]), math.cos(rpy[2])
    cp, tp = math.cos(rpy[1]), math.tan(rpy[1])
    forward = cy * angular_velocity[0] + sy * angular_velocity[1]
    rates[0] = forward / cp
    rates[1] = -sy * angular_velocity[0] + cy * angular_velocity[1]
    rates[2] = angular_velocity[2] + forward * tp


@compiled
def advance(state, forces, feet, mass, inertia, dt):  # type: ignore[no-untyped-def]
    """Integrate the non-linear rigid body by ``dt`` in place; ``forces``, ``feet`` (4, 3) in the world."""
    rotation = np.empty((3, 3))
    rotation_from_rpy(state[R:W], rotation)
    inertia_in_world = rotation @ inertia @ rotation.T
    force, moment = np.zeros(3), np.zeros(3)
    for leg in range(4):
        arm = feet[leg] - state[P:V]
        force += forces[leg]
        moment += np.cross(arm, forces[leg])
    omega = state[W:].copy()
    angular = np.linalg.solve(inertia_in_world, moment - np.cross(omega, inertia_in_world @ omega))
    linear = force / mass
    linear[2] -= GRAVITY
    rates = np.empty(3)
    rpy_rates(state[R:W], omega + 0.5 * dt * angular, rates)
    state[P:V] += dt * state[V:R] + 0.5 * dt * dt * linear
    state[V:R] += dt * linear
    state[R:W] += dt * rates
    state[W:] += dt * angular
