"""Kinematics of the legs against themselves, finite differences, the simulator's bodies and Pinocchio."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import ROBOTS, gravity_torque, robot

from runtime.control.kinematics import REACH_MARGIN, forward, gravity_of_leg, inverse, jacobians, leg_geometry
from sim.model import build_model

ANGLES = st.tuples(
    st.floats(-1.2, 1.2), st.floats(-0.8, 1.6), st.floats(-2.6, -0.15)
)  # abduction, hip, knee of the stand branch


def random_angles(rng: np.random.Generator) -> np.ndarray:
    return rng.uniform([-0.8, -0.6, -2.5], [0.8, 1.5, -0.2], (4, 3))


def hangs(q: np.ndarray, name: str) -> np.ndarray:
    """Which legs have their foot below the hip's plane: the branch that ``inverse`` answers with."""
    body = robot(name).robot
    return body.thigh_length * np.cos(q[:, 1]) + body.shank_length * np.cos(q[:, 1] + q[:, 2]) > 0.02


def gravity(name: str, q: np.ndarray, up: np.ndarray) -> np.ndarray:
    geometry = leg_geometry(robot(name).robot).view(np.recarray)[0]
    torque = np.empty((4, 3))
    for leg in range(4):
        gravity_of_leg(geometry, leg, q[leg], up, torque[leg])
    return torque


@pytest.mark.parametrize("name", ROBOTS)
def test_forward_agrees_with_the_simulators_rigid_bodies(name: str) -> None:
    geometry, model = leg_geometry(robot(name).robot), build_model(robot(name).robot)
    rng = np.random.default_rng(1)
    for _ in range(50):
        q = rng.uniform(-3, 3, (4, 3))
        np.testing.assert_allclose(forward(geometry, q), model.foot_positions(q), atol=1e-13)


@given(legs=st.tuples(ANGLES, ANGLES, ANGLES, ANGLES), name=st.sampled_from(ROBOTS))
def test_inverse_finds_the_angles_again(legs: tuple[tuple[float, float, float], ...], name: str) -> None:
    geometry, q = leg_geometry(robot(name).robot), np.array(legs)
    found, reached = inverse(geometry, forward(geometry, q))
    below = hangs(q, name)
    assert reached[below].all()
    np.testing.assert_allclose(found[below], q[below], atol=1e-9)


@given(offsets=st.lists(st.tuples(*[st.floats(-1.5, 1.5)] * 3), min_size=4, max_size=4), name=st.sampled_from(ROBOTS))
def test_forward_of_inverse_is_the_target_where_reached(offsets: list[tuple[float, float, float]], name: str) -> None:
    geometry = leg_geometry(robot(name).robot)
    feet = robot(name).robot.hips + np.array(offsets)
    q, reached = inverse(geometry, feet)
    assert np.isfinite(q).all()
    np.testing.assert_allclose(forward(geometry, q)[reached], feet[reached], atol=1e-9)


@pytest.mark.parametrize("name", ROBOTS)
def test_a_foot_drawn_past_its_hip_turns_the_thigh_without_a_jump(name: str) -> None:
    """Where the shank is the longer one, the thigh of a folded leg goes beyond half a turn."""
    known = robot(name).robot
    feet = np.tile(known.hips, (400, 1, 1))
    feet[:, :, 0] += np.linspace(0.1, -0.1, 400)[:, None]
    feet[:, :, 1] += known.abduction_length * np.array([1.0, -1.0, 1.0, -1.0])
    feet[:, :, 2] -= 0.01
    geometry = leg_geometry(known)
    hips = np.array([inverse(geometry, step)[0][:, 1] for step in feet])
    assert np.abs(np.diff(hips, axis=0)).max() < 0.3


@pytest.mark.parametrize("name", ROBOTS)
def test_a_target_out_of_reach_is_answered_in_its_direction_at_full_length(name: str) -> None:
    body = robot(name).robot
    geometry = leg_geometry(body)
    hip_plane = body.hips + np.array([0.0, 1.0, 0.0]) * body.abduction_length * np.array([[1], [-1], [1], [-1]])
    direction = np.array([0.6, 0.0, -0.8])
    q, reached = inverse(geometry, hip_plane + 2.0 * body.reach * direction)
    assert not reached.any()
    np.testing.assert_allclose(forward(geometry, q), hip_plane + REACH_MARGIN * body.reach * direction, atol=1e-9)


@pytest.mark.parametrize("name", ROBOTS)
def test_jacobian_against_finite_differences(name: str) -> None:
    geometry = leg_geometry(robot(name).robot)
    rng = np.random.default_rng(2)
    for _ in range(30):
        q = rng.uniform(-3, 3, (4, 3))
        analytic = jacobians(geometry, q)
        for joint in range(3):
            step = np.zeros(3)
            step[joint] = 1e-6
            numeric = (forward(geometry, q + step) - forward(geometry, q - step)) / 2e-6
            np.testing.assert_allclose(analytic[:, :, joint], numeric, atol=1e-9)


@pytest.mark.parametrize("name", ROBOTS)
def test_gravity_is_the_slope_of_the_links_energy(name: str) -> None:
    rng = np.random.default_rng(3)
    for _ in range(3):
        q, up = random_angles(rng), rng.normal(size=3)
        up /= np.linalg.norm(up)
        np.testing.assert_allclose(gravity(name, q, up), gravity_torque(name, q, up), atol=1e-7)


@pytest.mark.parametrize("name", ROBOTS)
def test_against_pinocchio_on_the_same_urdf(name: str) -> None:
    pin = pytest.importorskip("pinocchio")
    body = robot(name).robot
    model = pin.buildModelFromXML(build_model(body).urdf())
    for leg in ("FL", "FR", "BL", "BR"):
        joint = model.getJointId(f"{leg}_knee")
        below = pin.SE3(np.eye(3), np.array([0.0, 0.0, -body.shank_length]))
        model.addFrame(pin.Frame(f"{leg}_foot", joint, below, pin.FrameType.OP_FRAME))
    columns = [model.joints[model.getJointId(f"{leg}_{joint}")].idx_q for leg in ("FL", "FR", "BL", "BR")
               for joint in ("abduction", "hip", "knee")]  # fmt: skip
    geometry, rng = leg_geometry(body), np.random.default_rng(4)
    for _ in range(20):
        q, up = rng.uniform(-2, 2, (4, 3)), rng.normal(size=3)
        up /= np.linalg.norm(up)
        theirs = np.zeros(model.nq)
        theirs[columns] = q.ravel()
        model.gravity.linear = -9.81 * up
        data = model.createData()
        weight = pin.computeGeneralizedGravity(model, data, theirs)
        pin.computeJointJacobians(model, data, theirs)
        pin.updateFramePlacements(model, data)
        feet, jacobian = forward(geometry, q), jacobians(geometry, q)
        np.testing.assert_allclose(gravity(name, q, up), weight[columns].reshape(4, 3), atol=1e-10)
        for leg, prefix in enumerate(("FL", "FR", "BL", "BR")):
            frame = model.getFrameId(f"{prefix}_foot")
            np.testing.assert_allclose(feet[leg], data.oMf[frame].translation, atol=1e-12)
            whole = pin.getFrameJacobian(model, data, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
            np.testing.assert_allclose(jacobian[leg], whole[:3, columns[3 * leg : 3 * leg + 3]], atol=1e-12)
            others = [c for c in columns if c not in columns[3 * leg : 3 * leg + 3]]
            assert not whole[:3, others].any()
