"""Commissioning's arithmetic: a robot put together at random is understood, and doubtful readings are refused."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.commissioning import (
    CommissionError,
    FoundJoint,
    assign,
    contact_baseline,
    find_moved,
    joint_name,
    mount_from_gravity,
    quaternion_of,
    zeros_from_pose,
    zeros_from_stops,
)
from drivers.mounting import Mounting
from runtime import config
from sim.build import Build, lab_build, scrambled

DESCRIPTION = config.load(config.find_robot("stoch3")).robot
LOWER, UPPER = np.array(DESCRIPTION.joints.lower), np.array(DESCRIPTION.joints.upper)
PLUS = np.ones((4, 3))


def readings(build: Build, joints: np.ndarray) -> dict[tuple[int, int], float]:
    motor = build.to_motor(joints)
    return {
        (int(bus), int(motor_id)): float(angle)
        for bus, motor_id, angle in zip(build.bus.ravel(), build.id.ravel(), motor.ravel(), strict=True)
    }


def in_motor_order(build: Build, table: dict[tuple[int, int], float], ids: np.ndarray, buses: np.ndarray) -> np.ndarray:
    places = zip(buses.ravel(), ids.ravel(), strict=True)
    return np.array([table[int(bus), int(motor)] for bus, motor in places]).reshape(4, 3)


def accelerometer(mount: np.ndarray, roll: float, pitch: float, noise: np.ndarray) -> np.ndarray:
    """What a sensor mounted by ``mount`` (sensor → body) feels in a body with this roll and pitch."""
    up_in_body = np.array([-math.sin(pitch), math.cos(pitch) * math.sin(roll), math.cos(pitch) * math.cos(roll)])
    return Mounting(tuple(mount)).rotation_sensor_to_body.T @ up_in_body * 9.81 + noise


@given(st.integers(0, 10_000))
@settings(max_examples=30)
def test_a_scrambled_robot_is_put_right(seed):
    build, random = scrambled(lab_build(), seed), np.random.default_rng(seed)
    rest = random.uniform(LOWER, UPPER)
    found = []
    for leg in range(4):
        row = []
        for joint in range(3):
            turned = rest + 0.01 * random.standard_normal((4, 3))  # the others are not quite still
            turned[leg, joint] = rest[leg, joint] + 0.3
            row.append(find_moved(readings(build, rest), readings(build, turned), joint_name(leg, joint)))
        found.append(row)
    ids, buses, directions = assign(found)
    assert (ids == build.id).all()
    assert (buses == build.bus).all()
    assert (directions == build.direction).all()
    stops = [in_motor_order(build, readings(build, ends), ids, buses) for ends in (LOWER, UPPER)]
    offsets = zeros_from_stops(DESCRIPTION, *stops, directions, PLUS)
    assert offsets == pytest.approx(build.offset, abs=1e-9)
    pose = in_motor_order(build, readings(build, rest), ids, buses)
    assert zeros_from_pose(pose, rest, directions, PLUS) == pytest.approx(build.offset, abs=1e-9)
    poses = [accelerometer(build.mount, *angles, random.normal(0, 0.02, 3)) for angles in ((0, 0), (0, 0.4), (-0.4, 0))]
    mount = mount_from_gravity(*poses)
    assert abs(float(mount @ build.mount)) == pytest.approx(1.0, abs=1e-4)


@given(st.tuples(*[st.floats(-1, 1)] * 4).map(np.array).filter(lambda q: np.linalg.norm(q) > 0.2))
def test_quaternion_of_is_the_inverse_of_the_rotation(quaternion):
    quaternion = quaternion / np.linalg.norm(quaternion)
    again = quaternion_of(Mounting(tuple(quaternion)).rotation_sensor_to_body)
    assert abs(float(again @ quaternion)) == pytest.approx(1.0, abs=1e-9)


def test_a_wiggle_that_tells_nothing_is_refused():
    before = {(1, 11): 0.0, (1, 12): 0.0}
    with pytest.raises(CommissionError, match=r"FL hip: no motor turned.*Move it further"):
        find_moved(before, {(1, 11): 0.01, (1, 12): 0.0}, "FL hip")
    with pytest.raises(CommissionError, match="two motors turned"):
        find_moved(before, {(1, 11): 0.3, (1, 12): -0.2}, "FL hip")
    with pytest.raises(CommissionError, match="no motor answered"):
        find_moved(before, {}, "FL hip")
    assert find_moved(before, {(1, 11): -0.3, (1, 12): 0.02}, "FL hip") == FoundJoint((1, 11), -1)


def test_one_motor_at_two_joints_is_refused():
    found = [[FoundJoint((leg + 1, joint + 1), 1) for joint in range(3)] for leg in range(4)]
    found[2][1] = found[0][0]
    with pytest.raises(CommissionError, match="bus 1 id 1 was found at FL abduction and at BL hip"):
        assign(found)


def test_a_range_that_is_not_the_models_is_refused_by_joint():
    short = UPPER.copy()
    short[3, 2] -= 0.5
    with pytest.raises(CommissionError, match=r"BR knee: turned 2\.41 rad from stop to stop, the model says 2\.91"):
        zeros_from_stops(DESCRIPTION, LOWER, short, PLUS, PLUS)


@pytest.mark.parametrize(
    ("angles", "message"),
    [
        (((0, 0), (0, 0.05), (-0.4, 0)), "nose down: the body is tilted by 0.05"),
        (((0, 0), (0, 0.4), (0.01, 0)), "left down"),
        (((0, 0), (0, -0.4), (-0.4, 0)), "right angles, or are exchanged"),
        (((0, 0), (-0.4, 0), (0, 0.4)), "right angles, or are exchanged"),
    ],
)
def test_poses_that_contradict_each_other_are_refused(angles, message):
    mount = np.array([1.0, 0.0, 0.0, 0.0])
    with pytest.raises(CommissionError, match=message):
        mount_from_gravity(*[accelerometer(mount, *pose, np.zeros(3)) for pose in angles])


def test_a_body_that_is_moved_is_not_at_rest():
    with pytest.raises(CommissionError, match=r"level: the accelerometer reads 11\.00"):
        mount_from_gravity(np.array([0.0, 0.0, 11.0]), np.zeros(3), np.zeros(3))


FEET = np.array([[0.27, 0.22], [0.27, -0.22], [-0.27, 0.22], [-0.27, -0.22]])
DIAGONAL = np.array([1.0, -1.0, -1.0, 1.0])
WEIGHT = 245.0


def standing(com: np.ndarray) -> np.ndarray:
    """Forces of four feet that carry ``WEIGHT`` at ``com``, without any load exchanged diagonally."""
    balance = np.vstack([np.ones(4), FEET.T])
    return np.linalg.pinv(balance) @ (WEIGHT * np.array([1.0, *com]))


@given(
    st.tuples(*[st.floats(-8, 8)] * 4).map(np.array),
    st.tuples(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05)).map(np.array),
    st.floats(-20, 20),
)
def test_what_the_legs_feign_is_found_but_for_what_they_exchange_diagonally(feigned, com, exchanged):
    forces = np.tile(standing(com) + feigned + exchanged * DIAGONAL, (101, 1))
    forces[:30, 0] += 80.0  # somebody touched it for a moment
    found = np.array(contact_baseline(forces, FEET, WEIGHT, com))
    hidden = feigned @ DIAGONAL / 4 * DIAGONAL
    assert found == pytest.approx(feigned - hidden, abs=1e-6)
    balance = np.vstack([np.ones(4), FEET.T])
    assert balance @ (forces[-1] - found) == pytest.approx(WEIGHT * np.array([1.0, *com]), abs=1e-6)


@pytest.mark.parametrize("load", [80.0, np.nan])
def test_a_load_is_no_baseline(load):
    com = np.zeros(2)
    with pytest.raises(CommissionError, match="does the robot carry a load"):
        contact_baseline(np.tile(standing(com) + load / 4, (10, 1)), FEET, WEIGHT, com)
