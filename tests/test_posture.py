"""Standing up and sitting down, from any pose: no jumps, no more than the joints allow, ending where it should."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from daemons import make_config
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.robot import Array, ImuSample, JointCommand, JointState, Measurement
from runtime.config import ROBOTS, load
from runtime.control.kinematics import forward, jacobians
from runtime.control.posture import Posture, blend, minimum_jerk

CONFIG = load(ROBOTS / "stoch3.toml")
LOWER, UPPER = np.array(CONFIG.robot.joints.lower), np.array(CONFIG.robot.joints.upper)
poses = st.lists(st.floats(0.05, 0.95), min_size=12, max_size=12).map(
    lambda shares: LOWER + np.reshape(shares, (4, 3)) * (UPPER - LOWER)
)


def make_posture() -> Posture:
    return Posture(CONFIG.robot, CONFIG.control, CONFIG.posture)


def measured(q: Array) -> Measurement:
    zero = np.zeros((4, 3))
    joints = JointState(q, zero, zero, zero, np.zeros((4, 3), np.int32), zero)
    return Measurement(0.0, ImuSample(0.0, np.array([1.0, 0, 0, 0]), np.zeros(3), np.array([0, 0, 9.81])), joints, 48.0)


def play(posture: Posture) -> list[JointCommand]:
    commands = []
    while not posture.finished:
        commands.append(posture.step())
        assert len(commands) < 5000
    return commands


@settings(max_examples=30, deadline=None)
@given(poses)
def test_standing_up_from_any_pose_is_soft_and_ends_standing(q: Array) -> None:
    posture = make_posture()
    posture.stand_up(measured(q))
    commands = play(posture)
    first, last = commands[0], commands[-1]
    np.testing.assert_allclose(first.position, q, atol=1e-6)
    assert first.kp.max() < 0.01 * posture.kp.max(), "it grips softly"
    np.testing.assert_allclose(forward(posture.geometry, last.position), posture.standing, atol=1e-6)
    np.testing.assert_allclose(last.kp, posture.kp)
    _no_jumps(commands, posture)


@settings(max_examples=30, deadline=None)
@given(poses)
def test_sitting_down_ends_folded_and_limp(q: Array) -> None:
    posture = make_posture()
    posture.sit_down(measured(q), bearing=True)
    commands = play(posture)
    assert not commands[-1].kp.any() and not commands[-1].torque.any()
    np.testing.assert_allclose(commands[-1].position, posture.folded_joints, atol=1e-6)
    for command in commands:
        assert (command.kp >= 0).all() and (command.kd >= 0).all()


def _no_jumps(commands: list[JointCommand], posture: Posture) -> None:
    for before, after in pairwise(commands):
        assert np.abs(after.position - before.position).max() <= 15.0 * posture.dt
        assert np.abs(after.kp - before.kp).max() <= 0.02 * posture.kp.max()
        assert np.abs(after.torque - before.torque).max() <= 2.0
        np.testing.assert_allclose(after.velocity, (after.position - before.position) / posture.dt, atol=1e-9)


def test_the_weight_is_borne_by_the_feet_once_it_stands() -> None:
    posture = make_posture()
    posture.stand_up(measured(posture.folded_joints))
    last = play(posture)[-1]
    force = np.linalg.solve(jacobians(posture.geometry, last.position).transpose(0, 2, 1), -last.torque[..., None])
    np.testing.assert_allclose(force[..., 0].sum(axis=0), [0.0, 0.0, CONFIG.robot.mass * 9.81], atol=1e-6)


def test_the_body_rises_vertically() -> None:
    posture = make_posture()
    posture.stand_up(measured(posture.folded_joints))
    heights = []
    for command in play(posture):
        feet = forward(posture.geometry, command.position)
        np.testing.assert_allclose(feet[:, :2], posture.standing[:, :2], atol=1e-6)
        assert np.ptp(feet[:, 2]) < 1e-6
        heights.append(-feet[0, 2])
    assert (np.diff(heights) >= -1e-9).all()


def test_turning_round_half_way_keeps_bearing_the_weight() -> None:
    posture = make_posture()
    posture.stand_up(measured(posture.folded_joints))
    for _ in range(round(2.6 / posture.dt)):
        middle = posture.step()
    load, gain = posture.load, posture.gain
    assert load > 0.9
    posture.sit_down(measured(middle.position), bearing=False)
    first = posture.step()
    assert posture.load == pytest.approx(load, abs=1e-3) and posture.gain == pytest.approx(gain, abs=1e-3)
    np.testing.assert_allclose(first.position, middle.position, atol=1e-3)
    for _ in range(20):
        down = posture.step()
    posture.stand_up(measured(down.position))
    commands = play(posture)
    assert min(command.kp.min() for command in commands) > 0.9 * posture.kp.min(), "it never lets go"
    np.testing.assert_allclose(forward(posture.geometry, commands[-1].position), posture.standing, atol=1e-6)


@given(st.floats(-1, 2), st.floats(-1, 2))
def test_minimum_jerk_rises_from_0_to_1(a: float, b: float) -> None:
    low, high = sorted((a, b))
    assert 0.0 <= minimum_jerk(low) <= minimum_jerk(high) + 1e-12 <= 1.0 + 1e-12
    assert minimum_jerk(0.0) == 0.0 and minimum_jerk(1.0) == 1.0


def test_a_blend_begins_with_the_old_and_ends_with_the_new() -> None:
    one, two = (JointCommand(*(np.full((4, 3), value + i) for i in range(5))) for value in (1.0, 7.0))
    for share, wanted in ((0.0, one), (1.0, two)):
        mixed = blend(one, two, share)
        for name in ("position", "velocity", "kp", "kd", "torque"):
            np.testing.assert_array_equal(getattr(mixed, name), getattr(wanted, name))


@pytest.mark.parametrize("path", sorted(ROBOTS.glob("*.toml")), ids=lambda path: path.stem)
def test_every_shipped_robot_can_fold_and_stand(path: object) -> None:
    config = load(path)  # type: ignore[arg-type]
    posture = Posture(config.robot, config.control, config.posture)
    posture.stand_up(measured(posture.folded_joints))
    last = play(posture)[-1]
    lower, upper = np.array(config.robot.joints.lower), np.array(config.robot.joints.upper)
    assert ((lower <= last.position) & (last.position <= upper)).all()
    assert (last.kp > 0.0).all() and np.isfinite(last.torque).all()
    assert not np.allclose(last.position, posture.folded_joints)


def test_a_fold_that_the_joints_do_not_reach_is_refused() -> None:
    config = make_config(posture__fold_height=0.02)
    with pytest.raises(ValueError, match=r"posture\.fold_height"):
        Posture(config.robot, config.control, config.posture)
