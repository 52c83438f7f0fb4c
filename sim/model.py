"""A robot's description → the rigid bodies that the simulator builds, and their URDF.

Every robot becomes the same thirteen links and twelve joints in our convention, with a box for the body and spheres for
the feet and knees: mesh shapes cost three to six times the whole step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np

from drivers.description import END, SIDE, Link, RobotDescription
from drivers.robot import JOINTS, LEGS, Array
from sim.rotation import about_axis, to_rpy

LINKS = ("abduction_link", "thigh", "shank")
PAYLOAD = "payload"
AXES = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
"""Joint axes in our convention. Shape (3, 3), rows abduction hip knee."""


@dataclass(frozen=True, slots=True)
class Body:
    """One rigid link in its own frame."""

    name: str
    mass: float
    """kg."""
    com: Array
    """Centre of mass, m. Shape (3,)."""
    inertia: Array
    """About the centre of mass, link axes, kg·m². Shape (3, 3)."""


@dataclass(frozen=True, slots=True)
class Hinge:
    """One revolute joint: child frame = the parent's moved by ``origin``, turned by ``rotation`` and about ``axis``."""

    name: str
    parent: str
    child: str
    origin: Array
    """m, in the parent's frame. Shape (3,)."""
    rotation: Array
    """Child to parent at zero angle. Shape (3, 3)."""
    axis: Array
    """Unit vector in the child's frame. Shape (3,)."""


@dataclass(frozen=True, slots=True)
class Model:
    """A robot as rigid bodies. Joints in the order FL FR BL BR x abduction hip knee."""

    description: RobotDescription
    bodies: tuple[Body, ...]
    """The body, then abduction link, thigh and shank of each leg. 13 of them."""
    hinges: tuple[Hinge, ...]
    """12 of them."""
    feet: Array
    """Centre of each foot's sphere in its shank's frame, m. Shape (4, 3)."""

    @property
    def mass(self) -> float:
        """Of the whole robot, kg."""
        return sum(body.mass for body in self.bodies)

    def foot_positions(self, joint_position: Array) -> Array:
        """Centres of the feet in the body frame at ``joint_position`` (4, 3) rad, m. Shape (4, 3)."""
        feet = np.empty((4, 3))
        for leg in range(4):
            position, rotation = np.zeros(3), np.eye(3)
            for hinge, angle in zip(self.hinges[3 * leg : 3 * leg + 3], joint_position[leg], strict=True):
                position = position + rotation @ hinge.origin
                rotation = rotation @ hinge.rotation @ about_axis(hinge.axis, angle)
            feet[leg] = position + rotation @ self.feet[leg]
        return feet

    def urdf(self) -> str:
        """The model as URDF text, rotor inertia included, with a massless ``payload`` link on top of the body."""
        robot = ElementTree.Element("robot", name=self.description.name)
        for index, body in enumerate(self.bodies):
            axis = None if index == 0 else self.hinges[index - 1].axis
            link = _link_element(robot, body, _with_rotor(body.inertia, axis, self.description.joints.rotor_inertia))
            for position, shape in self._shapes(index):
                _add_collision(link, position, shape)
        for index, hinge in enumerate(self.hinges):
            self._add_joint(robot, hinge, index)
        _link_element(robot, Body(PAYLOAD, 0.0, np.zeros(3), np.zeros((3, 3))), np.zeros((3, 3)))
        self._add_payload_joint(robot)
        return ElementTree.tostring(robot, encoding="unicode")

    def _add_payload_joint(self, robot: ElementTree.Element) -> None:
        element = ElementTree.SubElement(robot, "joint", name=PAYLOAD, type="fixed")
        ElementTree.SubElement(element, "parent", link="body")
        ElementTree.SubElement(element, "child", link=PAYLOAD)
        top = np.array([0.0, 0.0, self.description.body_size[2] / 2])
        ElementTree.SubElement(element, "origin", xyz=_numbers(top), rpy="0 0 0")

    def _shapes(self, index: int) -> list[tuple[Array, dict[str, dict[str, str]]]]:
        description = self.description
        if index == 0:
            return [(np.zeros(3), {"box": {"size": _numbers(description.body_size)}})]
        leg, part = divmod(index - 1, 3)
        sphere = {"sphere": {"radius": repr(description.foot_radius)}}
        if part == 1:
            return [(self.hinges[3 * leg + 2].origin, sphere)]
        return [(self.feet[leg], sphere)] if part == 2 else []

    def _add_joint(self, robot: ElementTree.Element, hinge: Hinge, index: int) -> None:
        leg, joint = divmod(index, 3)
        limits = self.description.joints
        element = ElementTree.SubElement(robot, "joint", name=hinge.name, type="revolute")
        ElementTree.SubElement(element, "parent", link=hinge.parent)
        ElementTree.SubElement(element, "child", link=hinge.child)
        ElementTree.SubElement(element, "origin", xyz=_numbers(hinge.origin), rpy=_numbers(to_rpy(hinge.rotation)))
        ElementTree.SubElement(element, "axis", xyz=_numbers(hinge.axis))
        ElementTree.SubElement(
            element,
            "limit",
            lower=repr(limits.lower[leg][joint]),
            upper=repr(limits.upper[leg][joint]),
            effort=repr(limits.peak_torque[joint]),
            velocity=repr(limits.max_velocity[joint]),
        )


def build_model(description: RobotDescription) -> Model:
    """Primitives from the numbers of the robot's TOML; right and back legs mirror the front-left one."""
    links = description.links
    bodies = [Body("body", links.body.mass, np.array(links.body.com), np.diag(links.body.inertia))]
    hinges: list[Hinge] = []
    for leg, name in enumerate(LEGS):
        mirrors = (
            np.array([END[leg], SIDE[leg], 1.0]),
            np.array([1.0, SIDE[leg], 1.0]),
            np.array([1.0, SIDE[leg], 1.0]),
        )
        origins = (
            description.hips[leg],
            np.array([0.0, SIDE[leg] * description.abduction_length, 0.0]),
            np.array([0.0, 0.0, -description.thigh_length]),
        )
        parent = "body"
        for joint, link in enumerate((links.abduction, links.thigh, links.shank)):
            child = f"{name}_{LINKS[joint]}"
            bodies.append(_mirrored(child, link, mirrors[joint]))
            hinges.append(Hinge(f"{name}_{JOINTS[joint]}", parent, child, origins[joint], np.eye(3), AXES[joint]))
            parent = child
    feet = np.tile([0.0, 0.0, -description.shank_length], (4, 1))
    return Model(description, tuple(bodies), tuple(hinges), feet)


def standing_pose(description: RobotDescription, height: float) -> Array:
    """Joint angles that put every foot below its hip with the body origin at ``height`` m. Shape (4, 3), rad.

    Raises:
        ValueError: the legs are too short, or cannot fold that far.
    """
    thigh, shank = description.thigh_length, description.shank_length
    drop = height - description.foot_radius + description.hip_position[2]
    if not abs(thigh - shank) < drop < thigh + shank:
        raise ValueError(
            f"height = {height}: a leg of {thigh} + {shank} m reaches from "
            f"{height - drop + abs(thigh - shank):.3f} to {height - drop + thigh + shank:.3f} m"
        )
    knee = -math.acos((drop**2 - thigh**2 - shank**2) / (2 * thigh * shank))
    hip = math.atan2(-shank * math.sin(knee), thigh + shank * math.cos(knee))
    return np.tile([0.0, hip, knee], (4, 1))


def lump(name: str, bodies: tuple[Body, ...]) -> Body:
    """Several rigid bodies given in one frame as a single one."""
    mass = sum(body.mass for body in bodies)
    com: Array = sum((body.mass * body.com for body in bodies), start=np.zeros(3)) / mass
    inertia = np.zeros((3, 3))
    for body in bodies:
        d = body.com - com
        inertia += body.inertia + body.mass * (np.dot(d, d) * np.eye(3) - np.outer(d, d))
    return Body(name, mass, com, inertia)


def _mirrored(name: str, link: Link, mirror: Array) -> Body:
    return Body(name, link.mass, mirror * np.array(link.com), np.diag(link.inertia))


def _with_rotor(inertia: Array, axis: Array | None, rotor: float) -> Array:
    """Link inertia plus the rotor's about the joint axis, made a real body's again.

    PyBullet knows no rotor, and sets an inertia whose largest principal moment passes the sum of the others to zero:
    what is missing is spread over those others. Some published URDFs need that without any rotor.
    """
    total = inertia if axis is None else inertia + rotor * np.outer(axis, axis)
    moments, axes = np.linalg.eigh(total)
    missing = moments[2] - moments[0] - moments[1]
    if missing <= 0.0:
        return total
    spread = np.array([0.505, 0.505, 0.0]) * missing
    real: Array = total + axes @ np.diag(spread) @ axes.T
    return real


def _link_element(robot: ElementTree.Element, body: Body, inertia: Array) -> ElementTree.Element:
    link = ElementTree.SubElement(robot, "link", name=body.name)
    inertial = ElementTree.SubElement(link, "inertial")
    ElementTree.SubElement(inertial, "origin", xyz=_numbers(body.com), rpy="0 0 0")
    ElementTree.SubElement(inertial, "mass", value=repr(float(body.mass)))
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    values = (repr(float(inertia[i, j])) for i in range(3) for j in range(i, 3))
    ElementTree.SubElement(inertial, "inertia", dict(zip(names, values, strict=True)))
    return link


def _add_collision(link: ElementTree.Element, position: Array, shape: dict[str, dict[str, str]]) -> None:
    collision = ElementTree.SubElement(link, "collision")
    ElementTree.SubElement(collision, "origin", xyz=_numbers(position), rpy="0 0 0")
    geometry = ElementTree.SubElement(collision, "geometry")
    for kind, attributes in shape.items():
        ElementTree.SubElement(geometry, kind, attributes)


def _numbers(values: Array | tuple[float, ...]) -> str:
    return " ".join(repr(float(value)) for value in values)
