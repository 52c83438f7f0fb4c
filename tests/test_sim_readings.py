"""What the simulated sensors read: inertial unit, servos, delays, and the truth beside them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from worlds import FLIGHT, LIMP, along, hold, stand, stoch3_world, trot_in_place

from sim.rotation import from_rpy, from_xyzw
from sim.scenario import Noise, Push, Scenario
from sim.sensing import GRAVITY
from sim.terrain import Slope
from sim.world import World


@pytest.fixture(scope="module")
def world() -> Iterator[World]:
    with stoch3_world() as world:
        yield world


def test_an_accelerometer_in_free_fall_reads_nothing(world: World) -> None:
    for rpy in ((0.0, 0.0, 0.0), (1.0, -0.7, 2.0)):
        world.reset(replace(FLIGHT, rpy=rpy))
        for _ in range(60):
            measurement = world.step(LIMP)
        np.testing.assert_allclose(measurement.imu.linear_acceleration, 0.0, atol=1e-6)
        assert world.truth.linear_velocity[2] == pytest.approx(-GRAVITY * world.time, rel=1e-6)


@pytest.mark.parametrize("direction", [0.0, 2.0, -1.2])
def test_an_accelerometer_at_rest_reads_gravity_upwards(world: World, direction: float) -> None:
    slope = Slope(0.2, direction)
    truth = stand(world, Scenario(terrain=slope, rpy=along(slope)), 2.5)
    assert not world.fallen()
    measurement = world.step(LIMP)
    up = truth.rotation_body_to_world.T @ [0.0, 0.0, GRAVITY]
    assert np.linalg.norm(up[:2]) > 1.0
    np.testing.assert_allclose(measurement.imu.linear_acceleration, up, atol=0.15)
    w, x, y, z = measurement.imu.orientation
    np.testing.assert_allclose(from_xyzw((x, y, z, w)), truth.rotation_body_to_world, atol=1e-12)


def test_the_first_reading_is_at_rest_in_the_wanted_attitude(world: World) -> None:
    rpy = (0.3, -0.2, 0.9)
    measurement = world.reset(Scenario(rpy=rpy, position_xy=(1.0, -2.0), velocity=(0.5, 0.0, 0.0)))
    np.testing.assert_allclose(world.truth.rotation_body_to_world, from_rpy(rpy), atol=1e-12)
    np.testing.assert_allclose(world.truth.position[:2], [1.0, -2.0], atol=1e-12)
    np.testing.assert_allclose(world.truth.linear_velocity, [0.5, 0.0, 0.0], atol=1e-12)
    upwards = from_rpy(rpy).T @ [0.0, 0.0, GRAVITY]
    np.testing.assert_allclose(measurement.imu.linear_acceleration, upwards, atol=1e-9)


def test_the_accelerometer_integrates_to_the_velocity_of_the_body_origin(world: World) -> None:
    world.reset(Scenario(rpy=(0.4, 0.3, 0.0), pushes=(Push(0.1, 0.3, (60.0, 90.0, 0.0), (0.3, 0.1, 0.0)),)))
    before = world.truth
    command = hold(np.tile([0.2, 0.9, -1.2], (4, 1)), 150.0, 4.0)
    world.step(command)
    for _ in range(150):
        after = world.truth
        measurement = world.step(command)
        force = after.rotation_body_to_world @ measurement.imu.linear_acceleration - [0.0, 0.0, GRAVITY]
        change = after.linear_velocity - before.linear_velocity
        np.testing.assert_allclose(force * world.period, change, atol=1e-9)
        spin = after.rotation_body_to_world @ measurement.imu.angular_velocity
        np.testing.assert_allclose(spin, after.angular_velocity, atol=1e-12)
        before = after


def test_truth_refers_to_the_body_origin(world: World) -> None:
    """Position and rotation differentiate to the velocities while the robot tumbles; the centre of mass would not."""
    world.reset(replace(FLIGHT, pushes=(Push(0.0, 0.1, (0.0, 0.0, 300.0), (0.3, 0.2, 0.0)),)))
    command = hold(np.tile([0.0, 0.7, -1.4], (4, 1)), 150.0, 4.0)
    states = []
    for _ in range(120):
        world.step(command)
        states.append(world.truth)
    assert np.linalg.norm(states[-1].angular_velocity) > 1.0
    for earlier, here, later in zip(states[40:], states[41:], states[42:], strict=False):
        velocity = (later.position - earlier.position) / (2 * world.period)
        np.testing.assert_allclose(velocity, here.linear_velocity, atol=0.01)
        turn = (later.rotation_body_to_world - earlier.rotation_body_to_world) / (2 * world.period)
        skew = turn @ here.rotation_body_to_world.T
        np.testing.assert_allclose([skew[2, 1], skew[0, 2], skew[1, 0]], here.angular_velocity, atol=0.03)


@pytest.mark.parametrize(("extra_delay", "ticks"), [(0.0, 1), (0.002, 1), (0.005, 2), (0.010, 3)])
@pytest.mark.parametrize("noise", [Noise(), Noise(joint_position=0.01)])
def test_a_command_shows_one_tick_later_and_never_sooner(
    world: World, extra_delay: float, ticks: int, noise: Noise
) -> None:
    scenario = replace(FLIGHT, extra_delay=extra_delay, noise=noise)
    runs = []
    for impulse in (0.0, 20.0):
        world.reset(scenario)
        readings = []
        for tick in range(12):
            torque = np.full((4, 3), impulse if tick == 5 else 0.0)
            readings.append(world.step(replace(LIMP, torque=torque)).joints)
        runs.append(readings)
    first = next(t for t in range(12) if (runs[0][t].position != runs[1][t].position).any())
    assert first == 5 + ticks
    assert next(t for t in range(12) if (runs[0][t].torque != runs[1][t].torque).any()) == 5 + ticks


def test_the_first_step_reads_what_the_reset_read(world: World) -> None:
    at_reset = world.reset(Scenario(noise=Noise(joint_position=0.1, orientation=0.1)))
    first = world.step(LIMP)
    np.testing.assert_array_equal(first.joints.position, at_reset.joints.position)
    assert (at_reset.stamp, first.stamp, world.step(LIMP).stamp) == (0.0, 0.0, 0.005)


def test_noise_changes_with_the_seed_and_leaves_the_truth_alone(world: World) -> None:
    runs, truths = [], []
    for seed in (1, 2):
        runs.append(trot_in_place(world, Scenario(seed=seed, noise=Noise(joint_position=0.01)), 50))
        truths.append(world.truth.position)
    assert (runs[0][:, :12] != runs[1][:, :12]).any()
    np.testing.assert_array_equal(truths[0], truths[1])


def test_a_servo_that_misreads_believes_and_tells_it_and_the_truth_stays(world: World) -> None:
    command = hold(world.reset(Scenario()).joints.position)
    for _ in range(200):
        world.step(command)
    world.motors.encoders[4] = lambda q, v: (q + 0.05, 2.0 * v)
    for _ in range(200):
        measured = world.step(command)
    truth = world.truth
    misread = measured.joints.position - truth.joint_position
    assert misread.flat[4] == pytest.approx(0.05, abs=5e-3)
    assert np.abs(np.delete(misread.ravel(), 4)).max() < 5e-3
    assert abs(truth.joint_position.flat[4] - command.position.flat[4]) > 0.02, "its loop acts on what it reads"


def test_a_reversed_motor_drives_the_wrong_way_and_tells_the_right_one(world: World) -> None:
    world.reset(FLIGHT)
    world.motors.reversed.add(2)
    push = replace(LIMP, torque=np.full((4, 3), 1.0))
    for _ in range(3):
        measured = world.step(push)
    assert measured.joints.torque == pytest.approx(np.ones((4, 3)))
    assert world.truth.joint_torque.flat[2] == pytest.approx(-1.0)
    assert world.truth.joint_velocity.flat[2] < 0 < world.truth.joint_velocity.flat[5]
