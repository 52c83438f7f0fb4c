"""The world obeys mechanics: weight, momentum, joints, pushes, loads, other people's robots."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from worlds import FLIGHT, HEIGHT, LIMP, STOCH3, along, hold, momentum, stand, stoch3_world

from runtime.config import ROBOTS, load
from sim.model import PAYLOAD
from sim.rotation import from_rpy
from sim.scenario import Push, Scenario
from sim.sensing import GRAVITY
from sim.terrain import Slope
from sim.world import World


@pytest.fixture(scope="module")
def world() -> Iterator[World]:
    with stoch3_world() as world:
        yield world


@pytest.fixture(scope="module")
def dynamics(world: World) -> pin.Model:
    """The same bodies in another library: total momentum is then known without PyBullet."""
    return pin.buildModelFromXML(world.model.urdf(), pin.JointModelFreeFlyer())


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
