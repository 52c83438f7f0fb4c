"""Simulated worlds for tests: commands to stand and to swing, and the momentum by another library."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pinocchio as pin

from drivers.robot import JointCommand, damp_command
from runtime.config import ROBOTS, load
from sim.rotation import about_axis, to_rpy
from sim.scenario import Noise, Scenario
from sim.terrain import HeightField, Slope
from sim.truth import Truth
from sim.world import World

CONFIG = load(ROBOTS / "stoch3.toml")
STOCH3 = CONFIG.robot
HEIGHT = 0.42
LIMP = damp_command(0.0)
FLIGHT = Scenario(height=30.0)
FIELD = HeightField(amplitude=0.05, spacing=0.1, seed=1, extent=4.0)


@contextmanager
def stoch3_world() -> Iterator[World]:
    """One for many tests: every ``reset`` begins anew."""
    world = World(STOCH3, 200.0, HEIGHT)
    yield world
    world.close()


def hold(position: np.ndarray, kp: float = 400.0, kd: float = 8.0) -> JointCommand:
    zero = np.zeros((4, 3))
    return JointCommand(position, zero, np.full((4, 3), kp), np.full((4, 3), kd), zero)


def stand(world: World, scenario: Scenario, duration: float = 1.5) -> Truth:
    command = hold(world.reset(replace(scenario, noise=Noise())).joints.position)
    for _ in range(round(duration / world.period)):
        world.step(command)
    return world.truth


def along(slope: Slope) -> tuple[float, float, float]:
    """Attitude of a body parallel to the slope."""
    rpy = to_rpy(about_axis(np.array([math.sin(slope.direction), -math.cos(slope.direction), 0.0]), slope.angle))
    return float(rpy[0]), float(rpy[1]), float(rpy[2])


def trot_in_place(world: World, scenario: Scenario, ticks: int) -> np.ndarray:
    """Everything the sensors say while the legs swing violently. Shape (ticks, 46)."""
    world.reset(scenario)
    rows = []
    for tick in range(ticks):
        swing = 0.3 * math.sin(0.09 * tick) * np.outer([1, -1, -1, 1], [0.3, 1.0, -1.5])
        m = world.step(hold(np.array([0.0, 0.7, -1.4]) + swing, 150.0, 4.0))
        parts = (m.joints.position, m.joints.velocity, m.joints.torque, m.imu.orientation, m.imu.angular_velocity)
        rows.append(np.concatenate([np.ravel(part) for part in (*parts, m.imu.linear_acceleration)]))
    return np.array(rows)


def momentum(dynamics: pin.Model, truth: Truth) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Linear and angular momentum about the centre of mass, and that centre, all in the world."""
    configuration, velocity = pin.neutral(dynamics), np.zeros(dynamics.nv)
    rotation = truth.rotation_body_to_world
    configuration[:7] = pin.SE3ToXYZQUAT(pin.SE3(rotation, truth.position))
    velocity[:6] = np.concatenate([rotation.T @ truth.linear_velocity, rotation.T @ truth.angular_velocity])
    for leg, name in enumerate(("FL", "FR", "BL", "BR")):
        for column, joint in enumerate(("abduction", "hip", "knee")):
            index = dynamics.joints[dynamics.getJointId(f"{name}_{joint}")]
            configuration[index.idx_q] = truth.joint_position[leg, column]
            velocity[index.idx_v] = truth.joint_velocity[leg, column]
    data = dynamics.createData()
    total = pin.computeCentroidalMomentum(dynamics, data, configuration, velocity)
    return total.linear, total.angular, pin.centerOfMass(dynamics, dynamics.createData(), configuration)
