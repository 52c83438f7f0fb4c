"""The model is the description's robot: geometry, masses and a URDF that another library reads the same way."""

from __future__ import annotations

import msgspec
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from drivers.description import SIDE, RobotDescription, composite_inertia
from runtime.config import ROBOTS, load
from sim import model as model_module
from sim.model import build_model, standing_pose
from sim.rotation import about_axis, from_rpy, from_xyzw, to_quaternion, to_rpy
from sim.sensing import ERRORS, READINGS, disturb

STOCH3 = load(ROBOTS / "stoch3.toml").robot
MODEL = build_model(STOCH3)

poses = arrays(np.float64, (4, 3), elements=st.floats(-2.5, 2.5))
angles = st.floats(-3.1, 3.1)
vectors = arrays(np.float64, 3, elements=st.floats(-1.0, 1.0)).filter(lambda v: np.linalg.norm(v) > 0.1)


def pinocchio_robot(urdf: str) -> tuple[pin.Model, pin.Data]:
    robot = pin.buildModelFromXML(urdf, pin.JointModelFreeFlyer())
    return robot, robot.createData()


def pinocchio_state(robot: pin.Model, joint_position: np.ndarray) -> np.ndarray:
    configuration = pin.neutral(robot)
    for hinge, angle in zip(MODEL.hinges, joint_position.ravel(), strict=True):
        configuration[robot.joints[robot.getJointId(hinge.name)].idx_q] = angle
    return configuration


@given(poses)
def test_feet_follow_the_convention_of_the_description(pose: np.ndarray) -> None:
    l1, l2, l3 = STOCH3.abduction_length, STOCH3.thigh_length, STOCH3.shank_length
    q1, q2, q3 = pose.T
    x = -l2 * np.sin(q2) - l3 * np.sin(q2 + q3)
    c = l2 * np.cos(q2) + l3 * np.cos(q2 + q3)
    y = SIDE * l1 * np.cos(q1) + c * np.sin(q1)
    z = SIDE * l1 * np.sin(q1) - c * np.cos(q1)
    np.testing.assert_allclose(MODEL.foot_positions(pose), STOCH3.hips + np.stack([x, y, z], axis=1), atol=1e-12)


@given(poses)
def test_pinocchio_reads_the_same_kinematics_from_the_urdf(pose: np.ndarray) -> None:
    robot, data = pinocchio_robot(MODEL.urdf())
    pin.forwardKinematics(robot, data, pinocchio_state(robot, pose))
    for leg, foot in enumerate(MODEL.foot_positions(pose)):
        shank = data.oMi[robot.getJointId(MODEL.hinges[3 * leg + 2].name)]
        np.testing.assert_allclose(shank.act(MODEL.feet[leg]), foot, atol=1e-12)


def test_pinocchio_reads_the_same_masses_from_the_urdf() -> None:
    pose = standing_pose(STOCH3, 0.5) + 0.1 * np.arange(12).reshape(4, 3)
    robot, data = pinocchio_robot(build_model(without_rotor(STOCH3)).urdf())
    configuration = pinocchio_state(robot, pose)
    pin.ccrba(robot, data, configuration, np.zeros(robot.nv))
    com, inertia = composite_inertia(STOCH3, pose)
    assert data.Ig.mass == pytest.approx(STOCH3.mass, abs=1e-12)
    np.testing.assert_allclose(pin.centerOfMass(robot, data, configuration), com, atol=1e-12)
    np.testing.assert_allclose(data.Ig.inertia, inertia, atol=1e-10)


def test_the_rotor_is_felt_at_every_joint() -> None:
    rotor = STOCH3.joints.rotor_inertia
    with_rotor, data = pinocchio_robot(MODEL.urdf())
    without, bare_data = pinocchio_robot(build_model(without_rotor(STOCH3)).urdf())
    pose = pinocchio_state(with_rotor, np.zeros((4, 3)))
    added = np.diag(pin.crba(with_rotor, data, pose)) - np.diag(pin.crba(without, bare_data, pose))
    assert (added[6:] >= 0.99 * rotor).all()
    assert (added[6:] <= 3.5 * rotor).all()


@given(arrays(np.float64, 3, elements=st.floats(1e-4, 1.0)), vectors, angles, vectors, st.floats(0.0, 0.1))
def test_an_inertia_with_rotor_is_a_real_bodys(
    moments: np.ndarray, about: np.ndarray, angle: float, axis: np.ndarray, rotor: float
) -> None:
    rotation = about_axis(about / np.linalg.norm(about), angle)
    inertia = rotation @ np.diag(moments) @ rotation.T
    axis = axis / np.linalg.norm(axis)
    real = model_module._with_rotor(inertia, axis, rotor)
    principal = np.linalg.eigvalsh(real)
    assert principal[2] <= (principal[0] + principal[1]) * (1 + 1e-9)
    assert axis @ real @ axis >= axis @ inertia @ axis + rotor - 1e-12
    if moments.max() <= moments.sum() / 2 and rotor == 0.0:
        np.testing.assert_allclose(real, inertia, atol=1e-15)


@given(st.floats(0.1, 0.64))
def test_standing_puts_every_foot_below_its_hip(height: float) -> None:
    feet = MODEL.foot_positions(standing_pose(STOCH3, height))
    hips = STOCH3.hips + np.outer(SIDE, [0.0, STOCH3.abduction_length, 0.0])
    np.testing.assert_allclose(feet[:, :2], hips[:, :2], atol=1e-9)
    np.testing.assert_allclose(feet[:, 2], STOCH3.foot_radius - height, atol=1e-9)
    pose = standing_pose(STOCH3, height)
    assert (pose[:, 1] >= 0).all()
    assert (pose[:, 2] <= 0).all()


@pytest.mark.parametrize("height", [0.7, 0.04, -0.3])
def test_standing_out_of_reach_names_the_bounds(height: float) -> None:
    with pytest.raises(ValueError, match=rf"height = {height}: .* reaches from 0.050 to 0.644 m"):
        standing_pose(STOCH3, height)


@given(vectors, angles)
def test_rotation_forms_agree(axis: np.ndarray, angle: float) -> None:
    rotation = about_axis(axis / np.linalg.norm(axis), angle)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(from_rpy(to_rpy(rotation)), rotation, atol=1e-7)
    w, x, y, z = to_quaternion(rotation)
    np.testing.assert_allclose(from_xyzw((x, y, z, w)), rotation, atol=1e-12)
    assert w >= 0


@given(vectors, angles, vectors, st.floats(0.0, 3.0))
def test_turning_a_quaternion_turns_in_its_own_frame(
    axis: np.ndarray, angle: float, about: np.ndarray, amount: float
) -> None:
    rotation = about_axis(axis / np.linalg.norm(axis), angle)
    about = about / np.linalg.norm(about)
    exact, bias, read = np.zeros(READINGS), np.zeros(ERRORS), np.zeros(READINGS)
    exact[36:40], bias[36:39] = to_quaternion(rotation), amount * about
    disturb(exact, bias, np.zeros(ERRORS), np.zeros(ERRORS), read)
    w, x, y, z = read[36:40]
    np.testing.assert_allclose(from_xyzw((x, y, z, w)), rotation @ about_axis(about, amount), atol=1e-12)


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2])
def test_rpy_survives_the_vertical(pitch: float) -> None:
    rotation = from_rpy((0.3, pitch, -0.7))
    np.testing.assert_allclose(from_rpy(to_rpy(rotation)), rotation, atol=1e-7)


def without_rotor(description: RobotDescription) -> RobotDescription:
    joints = msgspec.structs.replace(description.joints, rotor_inertia=0.0)
    return msgspec.structs.replace(description, joints=joints)
