"""The world obeys mechanics, its sensors read it, and the same scenario gives the same bits."""

from __future__ import annotations

import ast
import math
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pybullet
import pytest

import sim
from drivers.robot import JointCommand, damp_command
from runtime.config import ROBOTS, load
from sim.errors import PhysicsError, SimulatorMissing
from sim.model import PAYLOAD
from sim.rotation import about_axis, from_rpy, from_xyzw, to_rpy
from sim.scenario import Noise, Push, Scenario
from sim.sensing import GRAVITY
from sim.terrain import HeightField, Plane, Slope, Steps, Terrain
from sim.truth import Truth
from sim.world import World

CONFIG = load(ROBOTS / "stoch3.toml")
STOCH3 = CONFIG.robot
HEIGHT = 0.42
LIMP = damp_command(0.0)
FLIGHT = Scenario(height=30.0)
FIELD = HeightField(amplitude=0.05, spacing=0.1, seed=1, extent=4.0)


@pytest.fixture(scope="module")
def world() -> Iterator[World]:
    world = World(STOCH3, 200.0, HEIGHT)
    yield world
    world.close()


@pytest.fixture(scope="module")
def dynamics(world: World) -> pin.Model:
    """The same bodies in another library: total momentum is then known without PyBullet."""
    return pin.buildModelFromXML(world.model.urdf(), pin.JointModelFreeFlyer())


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


def test_a_joint_pd_holds_the_robot_up(world: World) -> None:
    truth = stand(world, Scenario(), 2.0)
    assert not world.fallen()
    assert truth.position[2] == pytest.approx(HEIGHT, abs=0.02)
    assert np.abs(truth.joint_velocity).max() < 0.1
    assert truth.foot_contacts.all()
    np.testing.assert_allclose(truth.foot_forces.sum(axis=0), [0.0, 0.0, STOCH3.mass * GRAVITY], atol=2.0)


def test_without_torque_it_falls_down(world: World) -> None:
    world.reset(Scenario())
    for _ in range(200):
        world.step(LIMP)
    assert world.fallen()
    assert world.truth.position[2] < 0.2


def test_lying_on_knees_and_feet_is_not_a_fall_but_leaning_is(world: World) -> None:
    world.reset(Scenario(rpy=(0.0, 0.9, 0.0), height=2.0))
    assert not world.fallen()
    assert world.fallen(tilt=0.8)
    world.reset(Scenario(rpy=(0.0, 1.1, 0.0), height=2.0))
    assert world.fallen()


def test_it_starts_with_the_lowest_foot_just_on_the_ground(world: World) -> None:
    for scenario in (Scenario(), Scenario(rpy=(0.3, -0.2, 1.0)), Scenario(terrain=Slope(0.3)), Scenario(terrain=FIELD)):
        command = hold(world.reset(scenario).joints.position)
        for _ in range(4):
            world.step(command)
            assert world.truth.foot_forces[:, 2].max() < 6 * STOCH3.mass * GRAVITY
        assert world.truth.foot_contacts.any()


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


@pytest.mark.parametrize("point", [(0.0, 0.0, 0.0), (0.25, 0.1, 0.05)])
def test_a_push_gives_its_impulse_and_its_moment(world: World, dynamics: pin.Model, point: tuple) -> None:
    force, duration = np.array([12.0, -40.0, 9.0]), 0.1
    world.reset(replace(FLIGHT, rpy=(0.2, 0.4, -1.0), pushes=(Push(0.05, duration, tuple(force), point),)))
    moment, seen = np.zeros(3), 0.0
    for _ in range(60):
        before = world.truth
        _, _, com = momentum(dynamics, before)
        if 0.05 - 1e-9 <= world.time < 0.15 - 1e-9:
            arm = before.position + before.rotation_body_to_world @ np.array(point) - com
            moment += np.cross(arm, force) * world.period
            seen += world.period
        world.step(LIMP)
    assert seen == pytest.approx(duration)
    linear, angular, _ = momentum(dynamics, world.truth)
    expected = force * duration - [0.0, 0.0, STOCH3.mass * GRAVITY * world.time]
    np.testing.assert_allclose(linear, expected, atol=1e-2)
    np.testing.assert_allclose(angular, moment, rtol=0.02, atol=1e-3)


def test_a_push_at_once_is_one_in_the_scenario(world: World, dynamics: pin.Model) -> None:
    world.reset(FLIGHT)
    world.step(LIMP)
    world.push((0.0, 50.0, 0.0), 0.04)
    for _ in range(20):
        world.step(LIMP)
    assert momentum(dynamics, world.truth)[0][1] == pytest.approx(2.0, abs=1e-2)


def test_the_ground_answers_a_steady_push(world: World) -> None:
    truth = stand(world, Scenario(pushes=(Push(0.5, 9.0, (15.0, 40.0, 0.0)),)), 2.0)
    expected = [-15.0, -40.0, STOCH3.mass * GRAVITY]
    np.testing.assert_allclose(truth.foot_forces.sum(axis=0), expected, atol=2.0)


def test_a_payload_weighs_on_the_feet_and_on_nothing_later(world: World) -> None:
    for payload in (4.0, 0.0, 8.0, 0.0):
        truth = stand(world, Scenario(payload=payload))
        weight = (STOCH3.mass + payload) * GRAVITY
        assert truth.foot_forces[:, 2].sum() == pytest.approx(weight, abs=2.0)


def test_a_payload_sits_on_the_bodys_top(world: World) -> None:
    """Leaning sideways, its weight moves towards the lower feet."""
    shares = []
    for payload in (0.0, 10.0):
        slope = Slope(0.2, math.pi / 2)
        forces = stand(world, Scenario(payload=payload, terrain=slope, rpy=along(slope))).foot_forces
        vertical = forces[:, 2]
        shares.append(vertical[[1, 3]].sum() / vertical.sum())
    assert shares[1] > shares[0] > 0.5


@pytest.mark.parametrize("friction", [0.1, 0.3])
def test_a_sliding_foot_feels_the_coefficient_of_friction(world: World, friction: float) -> None:
    slope = Slope(0.45)
    scenario = Scenario(terrain=slope, rpy=along(slope), friction=friction)
    normal = np.array(slope.normal)
    for foot in stand(world, scenario, 0.4).foot_forces:
        load = foot @ normal
        assert np.linalg.norm(foot - load * normal) == pytest.approx(friction * load, rel=1e-3)


def test_enough_friction_holds_on_a_slope(world: World) -> None:
    slope = Slope(0.2)
    scenario = Scenario(terrain=slope, rpy=along(slope), friction=0.6)
    start, end = stand(world, scenario, 1.5), stand(world, scenario, 2.5)
    assert np.linalg.norm(end.position - start.position) < 0.01


@pytest.mark.parametrize("motor_strength", [1.0, 0.3])
def test_no_sample_of_torque_passes_the_peak(world: World, motor_strength: float) -> None:
    world.reset(replace(FLIGHT, motor_strength=motor_strength))
    peak = motor_strength * np.array(STOCH3.joints.peak_torque)
    reached = np.zeros((4, 3))
    for tick in range(100):
        world.step(hold(np.tile([0.5, 1.0, -2.0], (4, 1)) * (-1) ** (tick // 20), 200.0, 1.0))
        reached = np.maximum(reached, np.abs(world.truth.joint_torque))
    assert (reached <= peak).all()
    np.testing.assert_allclose(reached, np.broadcast_to(peak, (4, 3)))


def test_joints_stop_at_their_limits(world: World) -> None:
    lower, upper = np.array(STOCH3.joints.lower), np.array(STOCH3.joints.upper)
    for target, sign in ((upper + 1.0, 1.0), (lower - 1.0, -1.0)):
        world.reset(FLIGHT)
        for _ in range(150):
            world.step(hold(target, 30.0, 2.0))
        reached = world.truth.joint_position
        assert (reached <= upper + 0.03).all()
        assert (reached >= lower - 0.03).all()
        assert (np.abs(reached - (upper if sign > 0 else lower)) < 0.05).all()


@pytest.mark.parametrize("terrain", [Plane(), Slope(0.2, 0.5), Steps(0.06, start=0.1), FIELD])
def test_feet_rest_on_the_height_that_the_terrain_names(world: World, terrain: Terrain) -> None:
    touching = 0
    rpy = along(terrain) if isinstance(terrain, Slope) else (0.0, 0.0, 0.0)
    for x, y in ((0.0, 0.0), (0.33, -0.21)):
        truth = stand(world, Scenario(terrain=terrain, rpy=rpy, position_xy=(x, y), friction=1.2), 2.0)
        rotation = truth.rotation_body_to_world
        feet = truth.position + world.model.foot_positions(truth.joint_position) @ rotation.T
        for foot, contact, force in zip(feet, truth.foot_contacts, truth.foot_forces, strict=True):
            below = foot - STOCH3.foot_radius * force / max(np.linalg.norm(force), 1e-9)
            gap = foot[2] - terrain.height_at(foot[0], foot[1]) - STOCH3.foot_radius
            assert gap > -0.02, "a foot sank into the ground"
            if contact and isinstance(terrain, Plane):
                assert below[2] == pytest.approx(0.0, abs=2e-3)
            if contact and isinstance(terrain, Slope):
                distance = np.dot(foot, terrain.normal) - STOCH3.foot_radius
                assert distance == pytest.approx(0.0, abs=2e-3)
            touching += contact
        assert truth.foot_forces[:, 2].sum() == pytest.approx(STOCH3.mass * GRAVITY, rel=0.1)
    assert touching >= 5


@pytest.mark.parametrize("terrain", [Slope(-0.2, 0.5), Steps(0.06, start=0.1), FIELD])
def test_rays_meet_the_ground_at_the_height_that_the_terrain_names(world: World, terrain: Terrain) -> None:
    world.reset(Scenario(terrain=terrain, height=50.0))
    drawn = np.random.default_rng(0).uniform(-1.9, 1.9, (300, 2))
    places = [(x, y) for x, y in drawn if abs(terrain.height_at(x + 1e-3, y) - terrain.height_at(x - 1e-3, y)) < 0.01]
    assert len(places) > 250
    hits = pybullet.rayTestBatch(
        [[x, y, 3.0] for x, y in places], [[x, y, -3.0] for x, y in places], physicsClientId=world._engine.client
    )
    heights = [hit[3][2] for hit in hits]
    np.testing.assert_allclose(heights, [terrain.height_at(x, y) for x, y in places], atol=1e-6)


SCENARIOS = (
    Scenario(rpy=(0.1, 0.0, 0.2)),
    Scenario(terrain=Slope(0.15), friction=0.6),
    Scenario(
        payload=3.0, friction=0.4, motor_strength=0.8, extra_delay=0.007, seed=5, noise=Noise(0.01, 0.1, 0.2, 0.01)
    ),
    Scenario(terrain=FIELD),
    Scenario(terrain=Steps(0.05, start=0.2)),
    Scenario(rpy=(3.1, 0.0, 0.0), height=1.0, pushes=(Push(0.1, 0.1, (0.0, 300.0, 0.0)),)),
)


def test_the_same_scenario_gives_the_same_bits_whatever_came_before(world: World) -> None:
    fresh = []
    for scenario in SCENARIOS:
        other = World(STOCH3, 200.0, HEIGHT)
        fresh.append(trot_in_place(other, scenario, 120))
        other.close()
    order = [0, 1, 0, 2, 2, 5, 0, 3, 1, 5, 4, 3, 3, 0, 2, 1]
    for length, index in enumerate(order):
        run = trot_in_place(world, SCENARIOS[index], 120)
        np.testing.assert_array_equal(run, fresh[index], err_msg=f"scenario {index} after {order[:length]}")
    assert len({run.tobytes() for run in fresh}) == len(SCENARIOS)


def test_noise_changes_with_the_seed_and_leaves_the_truth_alone(world: World) -> None:
    runs, truths = [], []
    for seed in (1, 2):
        runs.append(trot_in_place(world, Scenario(seed=seed, noise=Noise(joint_position=0.01)), 50))
        truths.append(world.truth.position)
    assert (runs[0][:, :12] != runs[1][:, :12]).any()
    np.testing.assert_array_equal(truths[0], truths[1])


@pytest.mark.parametrize("rate_hz", [50.0, 250.0, 300.0, 500.0, 1000.0])
def test_any_control_rate_has_at_least_the_physics_rate(rate_hz: float) -> None:
    world = World(STOCH3, rate_hz, HEIGHT)
    assert world.substeps * rate_hz >= 1000.0 - 1e-9
    assert (world.substeps - 1) * rate_hz < 1000.0
    world.reset(FLIGHT)
    for _ in range(round(0.2 * rate_hz)):
        world.step(LIMP)
    assert world.time == pytest.approx(0.2)
    assert world.truth.linear_velocity[2] == pytest.approx(-GRAVITY * 0.2, rel=1e-6)
    world.close()


@pytest.mark.parametrize("name", ["mini_cheetah", "a1"])
def test_a_robot_that_others_drew_stands(name: str) -> None:
    config = load(ROBOTS / f"{name}.toml")
    world = World(config.robot, 200.0, config.control.gait.walking_height, urdf_search=ROBOTS)
    command = hold(
        world.reset(Scenario()).joints.position, 2 * config.control.gains.kp[0], 1.5 * config.control.gains.kd[0]
    )
    for _ in range(300):
        world.step(command)
    truth = world.truth
    assert not world.fallen()
    assert truth.foot_contacts.all()
    assert truth.foot_forces[:, 2].sum() == pytest.approx(config.robot.mass * GRAVITY, rel=0.01)
    assert truth.position[2] == pytest.approx(config.control.gait.walking_height, abs=0.02)
    world.close()


def test_a_robot_that_others_drew_falls_with_its_whole_momentum() -> None:
    """Off-diagonal inertias turn PyBullet's base frame: the origin must still be found."""
    config = load(ROBOTS / "a1.toml")
    world = World(config.robot, 200.0, config.control.gait.walking_height, urdf_search=ROBOTS)
    dynamics = pin.buildModelFromXML(world.model.urdf(), pin.JointModelFreeFlyer())
    rpy = (0.3, -0.5, 1.0)
    world.reset(replace(FLIGHT, rpy=rpy, pushes=(Push(0.0, 0.1, (0.0, 20.0, 0.0), (0.1, 0.0, 0.0)),)))
    np.testing.assert_allclose(world.truth.rotation_body_to_world, from_rpy(rpy), atol=1e-9)
    for _ in range(60):
        world.step(LIMP)
    expected = [0.0, 2.0, -config.robot.mass * GRAVITY * world.time]
    np.testing.assert_allclose(momentum(dynamics, world.truth)[0], expected, atol=1e-2)
    world.close()


def test_a_command_that_is_not_finite_is_refused_and_nothing_happens(world: World) -> None:
    world.reset(Scenario())
    with pytest.raises(ValueError, match="joint command torque: not finite"):
        world.step(replace(LIMP, torque=np.full((4, 3), np.nan)))
    assert world.time == 0.0
    world.step(LIMP)
    assert np.isfinite(world.truth.position).all()


def test_close_releases_the_physics_client() -> None:
    world = World(STOCH3, 200.0, HEIGHT)
    client = world._engine.client
    assert pybullet.isConnected(client)
    world.close()
    assert not pybullet.isConnected(client)
    world.close()


def test_a_world_that_cannot_be_built_leaves_no_client(monkeypatch: pytest.MonkeyPatch) -> None:
    before = [client for client in range(20) if pybullet.isConnected(client)]
    monkeypatch.setattr("sim.model._with_rotor", lambda inertia, axis, rotor: np.diag([0.1, 0.1, 1.0]))
    with pytest.raises(PhysicsError, match=r"link body: .* triangle"):
        World(STOCH3, 200.0, HEIGHT)
    assert [client for client in range(20) if pybullet.isConnected(client)] == before


def test_without_pybullet_one_line_names_the_python_to_use(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with pytest.raises(SimulatorMissing, match=r"no PyBullet for Python .* Python 3\.11 on x86_64") as caught:
        World(STOCH3, 200.0, HEIGHT)
    assert "\n" not in str(caught.value)


def test_nothing_is_printed() -> None:
    program = (
        "from runtime.config import ROBOTS, load\nfrom sim.world import World\nfrom sim.scenario import Scenario\n"
        "from sim.terrain import HeightField\n"
        "world = World(load(ROBOTS / 'a1.toml').robot, 200.0, 0.33)\n"
        "world.reset(Scenario(payload=2.0, terrain=HeightField(0.05, extent=2.0)))\nworld.close()\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, timeout=60, check=True)
    assert (done.stdout, done.stderr) == (b"", b"")


def test_only_one_file_imports_pybullet() -> None:
    root = Path(sim.__file__).parent
    speakers = [
        path.relative_to(root).as_posix()
        for path in root.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Import | ast.ImportFrom)
        and any(
            name.startswith("pybullet") for name in [getattr(node, "module", "") or "", *(a.name for a in node.names)]
        )
    ]
    assert speakers == ["bullet/engine.py"]


@pytest.mark.parametrize(
    ("force", "duration", "message"),
    [
        ((math.nan, 0.0, 0.0), 0.1, "push force"),
        ((1.0, 0.0, 0.0), 0.0, "push duration = 0.0"),
        ((1.0, 0.0, 0.0), math.inf, "push duration = inf"),
    ],
)
def test_an_impossible_push_is_refused_by_name(
    world: World, force: tuple[float, float, float], duration: float, message: str
) -> None:
    world.reset(FLIGHT)
    with pytest.raises(ValueError, match=re.escape(message)):
        world.push(force, duration)


def test_the_payload_is_a_link_of_its_own(world: World) -> None:
    assert f'link name="{PAYLOAD}"' in world.model.urdf()


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


def test_a_jammed_joint_holds_up_to_its_torque_until_the_reset(world: World) -> None:
    push = replace(LIMP, torque=np.full((4, 3), 10.0))
    for jam, moved in ((100.0, False), (1.0, True)):
        start = world.reset(FLIGHT).joints.position.flat[2]
        world.jam(2, jam)
        for _ in range(6):
            world.step(push)
        assert bool(abs(world.truth.joint_position.flat[2] - start) > 0.01) is moved
    world.reset(FLIGHT)
    for _ in range(6):
        world.step(push)
    free = world.truth.joint_position
    assert free.flat[2] == pytest.approx(free.flat[5], abs=0.05)
