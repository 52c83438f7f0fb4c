"""A robot that another tool drew becomes ours, or is refused with the reason."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from drivers.description import RobotDescription, UrdfMap, composite_inertia
from drivers.robot import JOINTS, LEGS
from runtime.config import ROBOTS, load
from sim.errors import UrdfError
from sim.model import build_model, standing_pose
from sim.rotation import about_axis
from sim.urdf import read_model

NAMED = ("mini_cheetah", "a1")
FOOT = """<link name="{leg}_foot"/><joint name="{leg}_ankle" type="fixed">
<parent link="{leg}_shank"/><child link="{leg}_foot"/><origin xyz="0 0 -{length}"/></joint>"""
poses = arrays(np.float64, (4, 3), elements=st.floats(-1.5, 1.5))


def description(name: str) -> RobotDescription:
    return load(ROBOTS / f"{name}.toml").robot


def changed(robot: RobotDescription, **urdf: object) -> RobotDescription:
    assert robot.urdf is not None
    return msgspec.structs.replace(robot, urdf=msgspec.structs.replace(robot.urdf, **urdf))


MODELS = {name: read_model(description(name), ROBOTS) for name in NAMED}


@pytest.mark.parametrize("name", NAMED)
@given(pose=poses)
def test_feet_lie_where_the_tomls_geometry_puts_them(name: str, pose: np.ndarray) -> None:
    expected = build_model(description(name)).foot_positions(pose)
    np.testing.assert_allclose(MODELS[name].foot_positions(pose), expected, atol=1e-6)


@pytest.mark.parametrize("name", NAMED)
def test_the_core_computes_with_the_masses_of_the_urdf(name: str) -> None:
    robot, model = description(name), MODELS[name]
    pose = standing_pose(robot, load(ROBOTS / f"{name}.toml").control.gait.walking_height)
    com, inertia = composite_inertia(robot, pose)
    assert model.mass == pytest.approx(robot.mass, abs=1e-6)
    centres, masses, moments = [], [], []
    for index, body in enumerate(model.bodies):
        position, rotation = np.zeros(3), np.eye(3)
        if index:
            leg, joint = divmod(index - 1, 3)
            for hinge, angle in zip(model.hinges[3 * leg : 3 * leg + joint + 1], pose[leg], strict=False):
                position = position + rotation @ hinge.origin
                rotation = rotation @ hinge.rotation @ about_axis(hinge.axis, angle)
        centres.append(position + rotation @ body.com)
        masses.append(body.mass)
        moments.append(rotation @ body.inertia @ rotation.T)
    true_com = np.average(centres, axis=0, weights=masses)
    offsets = np.array(centres) - true_com
    spread = sum(m * (o @ o * np.eye(3) - np.outer(o, o)) for m, o in zip(masses, offsets, strict=True))
    np.testing.assert_allclose(com, true_com, atol=2e-5)
    np.testing.assert_allclose(np.diag(inertia), np.diag(spread + sum(moments)), rtol=0.04)


@settings(max_examples=25)
@given(
    sign=st.tuples(*[st.sampled_from([1.0, -1.0])] * 3),
    offset=st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    pose=poses,
)
def test_signs_and_offsets_of_theirs_become_our_angles(
    sign: tuple[float, float, float], offset: tuple[float, float, float], pose: np.ndarray, tmp_path_factory: Callable
) -> None:
    stoch3 = description("stoch3")
    ours = build_model(stoch3)
    theirs = [
        replace(hinge, rotation=about_axis(hinge.axis, -sign[j % 3] * offset[j % 3]), axis=sign[j % 3] * hinge.axis)
        for j, hinge in enumerate(ours.hinges)
    ]
    urdf = replace(ours, hinges=tuple(theirs)).urdf()
    for leg in LEGS:
        urdf = urdf.replace("</robot>", FOOT.format(leg=leg, length=stoch3.shank_length) + "</robot>")
    folder: Path = tmp_path_factory.getbasetemp()
    (folder / "theirs.urdf").write_text(urdf)
    mapping = UrdfMap(
        path="theirs.urdf",
        joints=tuple(tuple(f"{leg}_{joint}" for joint in JOINTS) for leg in LEGS),  # type: ignore[arg-type]
        feet=("FL_foot", "FR_foot", "BL_foot", "BR_foot"),
        sign=sign,
        offset=offset,
    )
    read = read_model(msgspec.structs.replace(stoch3, urdf=mapping), folder)
    np.testing.assert_allclose(read.foot_positions(pose), ours.foot_positions(pose), atol=1e-9)


@pytest.mark.parametrize(
    ("robot", "message"),
    [
        (changed(description("mini_cheetah"), sign=(1.0, 1.0, -1.0)), "mm from where the TOML's geometry puts it"),
        (changed(description("mini_cheetah"), offset=(0.0, 0.1, 0.0)), "mm from where the TOML's geometry puts it"),
        (changed(description("mini_cheetah"), sign=(1.0, -0.5, -1.0)), r"sign\[1\] = -0\.5"),
        (changed(description("a1"), feet=("FL_toe", "FR_toe", "RL_toe", "RR_paw")), "has no RR_paw"),
        (
            changed(description("a1"), feet=("FL_toe", "FR_toe", "RR_toe", "RL_toe")),
            "foot RR_toe is not fixed to the BL",
        ),
        (changed(description("a1"), path="a1/a2.urdf"), r"urdf path = 'a1/a2\.urdf': no such file"),
        (changed(description("a1"), path="plane.urdf"), "has no FL_hip_joint"),
        (changed(description("a1"), path="plane.obj"), "not a URDF that can be read"),
        (msgspec.structs.replace(description("a1"), thigh_length=0.205), r"5\.0 mm from where"),
        (msgspec.structs.replace(description("a1"), foot_radius=0.03), "sphere of 0.02 m, the TOML's foot_radius 0.03"),
        (msgspec.structs.replace(description("a1"), urdf=None), "names no URDF"),
    ],
)
def test_a_urdf_that_does_not_fit_is_refused_in_one_line(robot: RobotDescription, message: str) -> None:
    with pytest.raises(UrdfError, match=message) as caught:
        read_model(robot, ROBOTS)
    assert "\n" not in str(caught.value)


def test_a_lighter_toml_is_refused() -> None:
    robot = description("a1")
    body = msgspec.structs.replace(robot.links.body, mass=4.0)
    light = msgspec.structs.replace(robot, links=msgspec.structs.replace(robot.links, body=body))
    with pytest.raises(UrdfError, match=r"weighs 12\.458 kg, the TOML's links 11\.744 kg"):
        read_model(light, ROBOTS)


def test_a_moving_joint_that_nobody_mapped_is_refused() -> None:
    robot = description("a1")
    assert robot.urdf is not None
    joints = list(robot.urdf.joints)
    joints[3] = ("RR_hip_joint", "RR_upper_joint", "RR_toe_fixed")
    with pytest.raises(UrdfError, match="RR_lower_joint moves but is not mapped"):
        read_model(changed(robot, joints=tuple(joints)), ROBOTS)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<robot", "not a URDF that can be read"),
        ("<robot name='x'><link name='a'/><link name='b'/></robot>", "has no"),
        ("<robot name='x'><link/></robot>", "not a URDF that can be read"),
    ],
)
def test_a_broken_file_is_refused(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "broken.urdf").write_text(text)
    with pytest.raises(UrdfError, match=message):
        read_model(changed(description("a1"), path="broken.urdf"), tmp_path)
