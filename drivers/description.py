"""One robot's description: what the simulator builds from and the control core computes with.

Every length in m, mass in kg, inertia in kg·m², angle in rad, torque in N·m. Given for the front-left leg; the other
legs are its mirror images. Kinematic convention (all legs alike): abduction about +x, hip and knee about +y, zero =
leg straight down, stand branch with hip > 0 and knee < 0.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from drivers.robot import Array

Positive = Annotated[float, Meta(gt=0)]
NonNegative = Annotated[float, Meta(ge=0)]
Vector3 = tuple[float, float, float]
Positive3 = tuple[Positive, Positive, Positive]
Name = Annotated[str, Meta(pattern=r"^[a-z0-9][a-z0-9_-]{0,31}$")]
PerLeg = tuple[Vector3, Vector3, Vector3, Vector3]

SIDE = np.array([1.0, -1.0, 1.0, -1.0])
"""+1 for left legs, -1 for right ones. Shape (4,)."""
END = np.array([1.0, 1.0, -1.0, -1.0])
"""+1 for front legs, -1 for back ones. Shape (4,)."""


UNDECODABLE = (msgspec.MsgspecError, UnicodeDecodeError, RecursionError)
"""What msgspec raises on bytes that it cannot make a record of: wrong, not UTF-8, nested too deeply."""


class Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Base of every configuration record: frozen, keyword-only, unknown keys are errors."""


class Link(Record, frozen=True, kw_only=True):
    """A rigid link, in its own frame: origin at the joint that carries it, axes as the body's at zero angles."""

    mass: Positive
    com: Vector3
    """Centre of mass, m; the body's is given from the centre between the four hips."""
    inertia: Positive3
    """Diagonal about the centre of mass, kg·m²."""


class Links(Record, frozen=True, kw_only=True):
    """The four kinds of link."""

    body: Link
    abduction: Link
    thigh: Link
    shank: Link
    """Shank and foot together."""


class JointLimits(Record, frozen=True, kw_only=True):
    """Bounds at the joint. Rows FL FR BL BR, columns abduction hip knee, where not said otherwise."""

    lower: PerLeg
    upper: PerLeg
    peak_torque: Positive3
    """N·m for abduction, hip, knee: never passed in any sample."""
    continuous_torque: Positive3
    """N·m rms for abduction, hip, knee: what the motors carry for ever."""
    max_velocity: Positive3
    """rad/s for abduction, hip, knee: beyond this a reading is a fault."""
    rotor_inertia: NonNegative
    """Reflected to the joint, kg·m² (rotor x gear²)."""
    friction_torque: NonNegative = 0.0
    """Dry friction at the joint, N·m."""


class UrdfMap(Record, frozen=True, kw_only=True):
    """A body that is named by an existing URDF: its joints and feet mapped onto ours."""

    path: str
    """Absolute, or beside the robot's TOML, or inside PyBullet's data package."""
    joints: tuple[tuple[str, str, str], tuple[str, str, str], tuple[str, str, str], tuple[str, str, str]]
    """Joint names, rows FL FR BL BR, columns abduction hip knee."""
    feet: tuple[str, str, str, str]
    """Names of the links that touch the ground, FL FR BL BR."""
    sign: Vector3 = (1.0, 1.0, 1.0)
    """ours = sign x (theirs - offset), for abduction, hip, knee."""
    offset: Vector3 = (0.0, 0.0, 0.0)


class RobotDescription(Record, frozen=True, kw_only=True):
    """Geometry, masses and limits of one robot."""

    name: Name
    hip_position: tuple[Positive, Positive, float]
    """Where the front-left abduction axis starts, from the body's origin, m."""
    abduction_length: NonNegative
    """l1: along y from abduction axis to the leg's plane, m."""
    thigh_length: Positive
    """l2, m."""
    shank_length: Positive
    """l3: knee to the centre of the foot's sphere, m."""
    foot_radius: NonNegative
    body_size: Positive3
    """Box that stands for the body, m."""
    links: Links
    joints: JointLimits
    urdf: UrdfMap | None = None

    @property
    def hips(self) -> Array:
        """Abduction axes in the body frame, m. Shape (4, 3)."""
        x, y, z = self.hip_position
        return np.stack([END * x, SIDE * y, np.full(4, z)], axis=1)

    @property
    def mass(self) -> float:
        """Of the whole robot, kg."""
        links = self.links
        return links.body.mass + 4 * (links.abduction.mass + links.thigh.mass + links.shank.mass)

    @property
    def reach(self) -> float:
        """Largest distance from the leg's plane origin (end of l1) to the foot, m."""
        return self.thigh_length + self.shank_length


def composite_inertia(description: RobotDescription, joint_position: Array) -> tuple[Array, Array]:
    """Whole robot frozen at ``joint_position`` (4, 3): centre of mass (3,) from the body origin, and inertia about it.

    Returns the centre of mass, m, and the inertia tensor (3, 3), kg·m², both in the body frame. The single-rigid-body
    inertia of the method is this, never the body link's own.
    """
    links = description.links
    parts: list[tuple[float, Array, Array]] = [
        (links.body.mass, np.array(links.body.com), np.diag(links.body.inertia)),
    ]
    for leg, (hip, side, angles) in enumerate(zip(description.hips, SIDE, joint_position, strict=True)):
        parts += _leg_parts(description, hip, side, END[leg], angles)
    mass = sum(part[0] for part in parts)
    com = sum((part[0] * part[1] for part in parts), start=np.zeros(3)) / mass
    inertia = np.zeros((3, 3))
    for part_mass, position, part_inertia in parts:
        d = position - com
        inertia += part_inertia + part_mass * (np.dot(d, d) * np.eye(3) - np.outer(d, d))
    return com, inertia


def _leg_parts(
    description: RobotDescription, hip: Array, side: float, end: float, angles: Array
) -> list[tuple[float, Array, Array]]:
    links = description.links
    rotation_abduction = _rotation_x(angles[0])
    rotation_thigh = rotation_abduction @ _rotation_y(angles[1])
    rotation_shank = rotation_abduction @ _rotation_y(angles[1] + angles[2])
    hip_joint = hip + rotation_abduction @ np.array([0.0, side * description.abduction_length, 0.0])
    knee_joint = hip_joint + rotation_thigh @ np.array([0.0, 0.0, -description.thigh_length])
    mirror = np.array([1.0, side, 1.0])
    ends = np.array([end, 1.0, 1.0])
    return [
        (link.mass, origin + rotation @ (mirror * extra * link.com), rotation @ np.diag(link.inertia) @ rotation.T)
        for link, origin, rotation, extra in (
            (links.abduction, hip, rotation_abduction, ends),
            (links.thigh, hip_joint, rotation_thigh, np.ones(3)),
            (links.shank, knee_joint, rotation_shank, np.ones(3)),
        )
    ]


def _rotation_x(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def _rotation_y(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
