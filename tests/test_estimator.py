"""The estimate from a measurement alone: exact where the case has a known answer, and against the simulator's truth."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import bearing_torque, control, controller, measurement, robot, rotation, standing

from drivers.robot import Measurement
from runtime.control.controller import Controller
from runtime.control.kinematics import inverse, jacobians, leg_geometry
from runtime.control.records import VelocityCommand

TABLE = leg_geometry(robot().robot)
RADIUS = robot().robot.foot_radius
WEIGHT = np.array([0.0, 0.0, robot().robot.mass * 9.81 / 4])
FEET = np.array([[0.25, 0.22, 0.0], [0.25, -0.22, 0.0], [-0.29, 0.22, 0.0], [-0.29, -0.22, 0.0]])
"""Soles on the ground below a body that looks along x, m."""


def on_the_ground(
    position: Any, rpy: Any, velocity: Any = (0, 0, 0), rate: Any = (0, 0, 0), soles: np.ndarray = FEET
) -> Measurement:
    """A rigid body at ``position`` (world) whose four feet roll without slipping while it moves.

    Joint speeds follow from the no-slip condition by differences: the core's Jacobian is not used.
    """
    turn, dt = rotation(rpy), 1e-6
    ground = soles @ rotation((0, 0, rpy[2])).T + np.array([0, 0, RADIUS])

    def angles(at: np.ndarray, turned: np.ndarray, feet: np.ndarray) -> np.ndarray:
        q, reached = inverse(TABLE, (feet - at) @ turned)
        assert reached.all()
        return q

    at, linear, spin = np.array(position, float), np.array(velocity, float), np.array(rate, float)
    q = angles(at, turn, ground)
    x, y, z = spin * dt
    moved = turn @ np.array([[1, -z, y], [z, 1, -x], [-y, x, 1]])
    speed = np.zeros((4, 3))
    for _ in range(6):  # the centre of a rolling sphere moves with its shank's turn, which the speeds tell
        rolled = ground.copy()
        for leg in range(4):
            axis = np.array([0.0, np.cos(q[leg, 0]), np.sin(q[leg, 0])])
            shank = turn @ (spin + [speed[leg, 0], 0, 0] + (speed[leg, 1] + speed[leg, 2]) * axis)
            rolled[leg] += dt * np.cross(shank, [0, 0, RADIUS])
        speed = (angles(at + linear * dt, moved, rolled) - q) / dt
    up = turn[2]
    return measurement(q, speed, bearing_torque("stoch3", q, turn.T @ WEIGHT, up), rpy, rate)


def settled(measured: Measurement, ticks: int = 400) -> Controller:
    known = controller()
    known.reset(measured)
    for _ in range(ticks):
        known.estimate(measured)
    return known


@given(roll=st.floats(-0.5, 0.5), pitch=st.floats(-0.5, 0.5), yaw=st.floats(-3.1, 3.1))
def test_roll_pitch_yaw_and_the_heading_frame(roll: float, pitch: float, yaw: float) -> None:
    known = controller()
    rate = np.array([0.1, -0.2, 0.3])
    measured = standing(rpy=(roll, pitch, yaw), rate=rate)
    known.reset(measured)
    np.testing.assert_allclose(known.record["rpy"][0], [roll, pitch, yaw], atol=1e-12)
    level = rotation((roll, pitch, 0.0))
    np.testing.assert_allclose(known.record["twist"][0, 3:], level @ rate, atol=1e-12)
    from runtime.control.kinematics import forward

    np.testing.assert_allclose(known.record["feet"][0], forward(TABLE, measured.joints.position) @ level.T, atol=1e-12)


def test_a_quaternion_need_not_be_of_unit_length() -> None:
    from dataclasses import replace

    measured = standing(rpy=(0.1, 0.2, 0.3))
    known = controller()
    known.reset(replace(measured, imu=replace(measured.imu, orientation=-1.7 * measured.imu.orientation)))
    np.testing.assert_allclose(known.record["rpy"][0], [0.1, 0.2, 0.3], atol=1e-12)


@pytest.mark.parametrize("rpy", [(0, 0, 0), (0.08, -0.1, 0.7)])
@pytest.mark.parametrize("height", [0.48, 0.57])
def test_height_of_a_body_at_rest(rpy: tuple[float, float, float], height: float) -> None:
    known = settled(on_the_ground((0.0, 0.0, height), rpy))
    assert known.record["height"][0] == pytest.approx(height, abs=1e-6)
    assert known.record["contacts"].all()
    np.testing.assert_allclose(known.record["twist"][0], 0.0, atol=1e-6)


@pytest.mark.parametrize(
    ("velocity", "rate"),
    [
        ((0.5, 0.0, 0.0), (0, 0, 0)),
        ((0.0, 0.3, 0.0), (0, 0, 0)),
        ((0.0, 0.0, -0.2), (0, 0, 0)),
        ((0.0, 0.0, 0.0), (0.3, 0.0, 0.0)),
        ((0.0, 0.0, 0.0), (0.0, 0.4, 0.0)),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.5)),
        ((0.4, -0.2, 0.1), (0.2, -0.3, 0.4)),
    ],
)
@pytest.mark.parametrize("rpy", [(0.0, 0.0, 0.0), (0.05, -0.08, 1.0)])
def test_leg_odometry_tells_the_bodys_velocity(velocity: Any, rate: Any, rpy: Any) -> None:
    """At rest in the filter's eyes, moving in the legs': each foot alone says how fast the body moves."""
    measured = on_the_ground((0.0, 0.0, 0.53), rpy, velocity, rate)
    known = controller()
    known.reset(measured)
    known.estimate(measured)
    odometry = work(known)["odometry"]
    np.testing.assert_allclose(odometry, np.tile(velocity, (4, 1)), atol=2e-5)


def work(known: Controller) -> Any:
    from runtime.control.controller import CORE_DTYPE, CORE_SIZE

    return known._memory[0][:CORE_SIZE].view(CORE_DTYPE)["work"][0]


def test_a_body_in_the_air_moves_as_its_accelerometer_says() -> None:
    rest = standing()
    known = settled(rest, 50)
    air = measurement(rest.joints.position, acceleration=np.array([1.0, -0.5, 0.0]))
    ticks, dt = 40, float(known.parameters["dt"][0])
    before = known.state["velocity"][0].copy()
    for _ in range(ticks):
        known.estimate(air)
    assert not known.record["contacts"].any()
    expected = before + ticks * dt * np.array([1.0, -0.5, -9.81])
    np.testing.assert_allclose(known.state["velocity"][0], expected, atol=1e-9)
    assert known.record["height"][0] < robot().control.gait.walking_height - 0.1, "falls"


def test_velocity_in_the_heading_frame_turns_with_the_body() -> None:
    known = settled(standing(rpy=(0, 0, 0)), 20)
    known.state["velocity"] = (0.3, 0.0, 0.0)
    rest = standing(rpy=(0, 0, np.pi / 2))
    air = measurement(rest.joints.position, rpy=(0, 0, np.pi / 2))
    known.estimate(air)
    np.testing.assert_allclose(known.record["twist"][0, :2], [0.0, -0.3], atol=1e-9)


@pytest.mark.parametrize("grade", [(0.15, 0.0), (0.0, -0.12), (0.1, 0.1)])
def test_slope_of_the_plane_through_the_footholds(grade: tuple[float, float]) -> None:
    soles = FEET + np.column_stack([np.zeros((4, 2)), FEET[:, :2] @ grade])
    known = settled(on_the_ground((0.0, 0.0, 0.53), (0.0, 0.0, 0.0), soles=soles), 600)
    np.testing.assert_allclose(known.record["slope"][0], grade, atol=2e-3)


def test_four_feet_in_the_air_under_a_tilted_body_span_no_slope() -> None:
    tilted = standing(rpy=(0.15, -0.2, 0.0))
    air = measurement(tilted.joints.position, rpy=(0.15, -0.2, 0.0))
    known = settled(air, 100)
    np.testing.assert_array_equal(known.record["slope"][0], 0.0)
    for _ in range(200):
        known.estimate(on_the_ground((0.0, 0.0, 0.53), (0.0, 0.0, 0.0)))
    np.testing.assert_allclose(known.record["slope"][0], 0.0, atol=2e-3)


def test_covariance_stays_symmetric_and_positive() -> None:
    rng = np.random.default_rng(0)
    known = settled(standing(), 5)
    rest = standing()
    for _ in range(2000):
        torque = rest.joints.torque * rng.integers(0, 2, (4, 1))
        known.estimate(measurement(rest.joints.position, rng.normal(0, 0.1, (4, 3)), torque))
        covariance = known.state["covariance"][0]
        np.testing.assert_allclose(covariance, covariance.T, atol=1e-12)
    assert np.linalg.eigvalsh(covariance)[0] > 0


def test_jacobian_left_for_the_later_rooms_is_the_kinematics_own() -> None:
    measured = standing()
    known = settled(measured, 1)
    np.testing.assert_allclose(work(known)["jacobian"], jacobians(TABLE, measured.joints.position), atol=1e-12)


@pytest.mark.parametrize(
    ("asked", "bound"), [((0.5, 0.0, 0.0), 0.05), ((0.0, 0.3, 0.0), 0.05), ((0.4, 0.1, 0.5), 0.06)]
)
@pytest.mark.parametrize("noisy", [False, True], ids=["clean", "noisy"])
def test_error_against_the_simulators_truth(asked: tuple[float, float, float], bound: float, noisy: bool) -> None:
    """Walking on its own estimate; the truth is only compared, never used."""
    pytest.importorskip("pybullet")
    from sim.scenario import Noise, Scenario
    from sim.world import World

    noise = Noise(1e-3, 0.1, 0.5, 3e-3, 0.02, 0.3) if noisy else Noise()
    config = control()
    world = World(robot().robot, config.rate_hz, config.gait.walking_height)
    known = controller()
    measured = world.reset(Scenario(seed=3, noise=noise))
    known.reset(measured)
    command = VelocityCommand(0.0, np.array(asked[:2]), asked[2])
    errors, heights = [], []
    for tick in range(500):
        truth = world.truth  # of the instant that the next exchange reads
        measured = world.step(known.step(measured, command))
        known_twist = known.record["twist"][0].copy()
        if tick >= 100:
            yaw = np.arctan2(truth.rotation_body_to_world[1, 0], truth.rotation_body_to_world[0, 0])
            in_heading = rotation((0, 0, yaw)).T @ truth.linear_velocity
            errors.append(in_heading - known_twist[:3])
            heights.append(truth.position[2] - known.record["height"][0])
    world.close()
    rmse = np.sqrt(np.mean(np.square(errors), axis=0))
    assert (rmse <= bound).all(), f"velocity {rmse} m/s"
    assert np.abs(np.mean(errors, axis=0)).max() <= 0.03
    assert np.sqrt(np.mean(np.square(heights))) <= 0.01
