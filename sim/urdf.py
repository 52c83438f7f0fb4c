"""A named URDF → the same ``Model`` that a TOML's primitives give: joints in our convention, everything fixed lumped.

Its meshes are left aside; only inertias, axes and foot spheres matter to the physics.
"""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from drivers.description import RobotDescription, UrdfMap
from drivers.robot import JOINTS, LEGS, Array
from sim.errors import UrdfError
from sim.model import LINKS, Body, Hinge, Model, build_model, lump
from sim.rotation import about_axis, from_rpy

TOLERANCE = 2e-3
"""How far a foot of the URDF may lie from where the TOML's geometry puts it, m."""
MASS_TOLERANCE = 0.02
"""Share by which the URDF's whole mass may differ from the TOML's."""


@dataclass(frozen=True, slots=True)
class _Joint:
    name: str
    parent: str
    child: str
    fixed: bool
    origin: Array
    rotation: Array
    axis: Array


@dataclass(slots=True)
class _Group:
    """A link and all that is fixed to it, in the link's frame."""

    bodies: list[Body] = field(default_factory=list)
    frames: dict[str, Array] = field(default_factory=dict)
    hinges: list[tuple[_Joint, Array, Array]] = field(default_factory=list)


def read_model(description: RobotDescription, search: Path | None) -> Model:
    """The model of the URDF that ``description.urdf`` names, checked against the description's own geometry.

    Args:
        description: the robot; its ``urdf`` is set.
        search: folder of the robot's TOML.

    Raises:
        UrdfError: no such file, not a URDF, a joint or foot it does not have, or a body that is not the TOML's.
    """
    mapping = description.urdf
    if mapping is None:
        raise UrdfError(f"robot {description.name} names no URDF")
    path = find_urdf(mapping.path, search)
    try:
        root = ElementTree.parse(path).getroot()
        model = _Reader(root, mapping).model(description)
    except UrdfError as error:
        raise UrdfError(f"{path}: {error}") from error
    except (OSError, ElementTree.ParseError, KeyError, ValueError) as error:
        raise UrdfError(f"{path}: not a URDF that can be read: {error!r}") from error
    check_model(model, path)
    return model


def find_urdf(name: str, search: Path | None) -> Path:
    """Where the URDF lies: absolute, beside the TOML, or in PyBullet's data package.

    Raises:
        UrdfError: nowhere.
    """
    folders = [search] if search is not None else []
    data = importlib.util.find_spec("pybullet_data")
    if data is not None and data.origin is not None:
        folders.append(Path(data.origin).parent)
    for path in [Path(name)] if Path(name).is_absolute() else [folder / name for folder in folders]:
        if path.is_file():
            return path
    raise UrdfError(f"urdf path = {name!r}: no such file in {', '.join(map(str, folders)) or 'any known folder'}")


def check_model(model: Model, path: Path) -> None:
    """Compare a read model with the primitives of its own description.

    Raises:
        UrdfError: a foot lies elsewhere in some pose, or the mass differs.
    """
    description = model.description
    primitives = build_model(description)
    lower, upper = np.array(description.joints.lower), np.array(description.joints.upper)
    poses = [np.tile([0.0, 0.7, -1.4], (4, 1)), lower, upper, 0.7 * lower + 0.3 * upper]
    for pose in poses:
        difference = np.linalg.norm(model.foot_positions(pose) - primitives.foot_positions(pose), axis=1)
        leg = int(np.argmax(difference))
        if difference[leg] > TOLERANCE:
            angles = ", ".join(f"{angle:.2f}" for angle in pose[leg])
            raise UrdfError(
                f"{path}: foot {LEGS[leg]} lies {1e3 * difference[leg]:.1f} mm from where the TOML's geometry puts it "
                f"at ({angles}) rad, bound {1e3 * TOLERANCE:.0f} mm: check lengths, hip_position, sign and offset"
            )
    if abs(model.mass - description.mass) > MASS_TOLERANCE * model.mass:
        raise UrdfError(f"{path}: weighs {model.mass:.3f} kg, the TOML's links {description.mass:.3f} kg, bound 2 %")


class _Reader:
    """Walks the tree of a URDF."""

    def __init__(self, root: ElementTree.Element, mapping: UrdfMap) -> None:
        self._links = {link.attrib["name"]: link for link in root.iter("link")}
        joints = [_read_joint(joint) for joint in root.findall("joint")]
        self._below: dict[str, list[_Joint]] = {}
        for joint in joints:
            self._below.setdefault(joint.parent, []).append(joint)
        self._mapping = mapping
        self._mapped = {name for leg in mapping.joints for name in leg}
        missing = sorted(self._mapped - {joint.name for joint in joints}) + sorted(set(mapping.feet) - set(self._links))
        if missing:
            raise UrdfError(f"has no {', '.join(missing)}")
        tops = sorted(set(self._links) - {joint.child for joint in joints})
        if len(tops) != 1:
            raise UrdfError(f"must have one root link, has {', '.join(tops) or 'none'}")
        self._top = tops[0]

    def model(self, description: RobotDescription) -> Model:
        group = self._group(self._top)
        bodies, hinges, feet = [lump("body", tuple(group.bodies))], [], np.zeros((4, 3))
        for leg, name in enumerate(LEGS):
            parent, above = "body", group
            for joint, kind in enumerate(JOINTS):
                wanted = self._mapping.joints[leg][joint]
                found = next((item for item in above.hinges if item[0].name == wanted), None)
                if found is None:
                    raise UrdfError(f"joint {wanted} is not carried by the {parent} as {name} {kind} should be")
                child = f"{name}_{LINKS[joint]}"
                hinges.append(self._hinge(f"{name}_{kind}", parent, child, joint, found))
                above = self._group(found[0].child)
                bodies.append(lump(child, tuple(above.bodies)))
                parent = child
            if self._mapping.feet[leg] not in above.frames:
                raise UrdfError(f"foot {self._mapping.feet[leg]} is not fixed to the {parent}")
            feet[leg] = above.frames[self._mapping.feet[leg]]
            self._check_radius(self._mapping.feet[leg], description.foot_radius)
        return Model(description, tuple(bodies), tuple(hinges), feet)

    def _hinge(self, name: str, parent: str, child: str, joint: int, found: tuple[_Joint, Array, Array]) -> Hinge:
        """Theirs = offset + sign x ours, put into the geometry: the physics then speaks our angles."""
        raw, origin, rotation = found
        sign, offset = self._mapping.sign[joint], self._mapping.offset[joint]
        if abs(sign) != 1.0:
            raise UrdfError(f"urdf sign[{joint}] = {sign}: must be 1 or -1")
        return Hinge(name, parent, child, origin, rotation @ about_axis(raw.axis, offset), sign * raw.axis)

    def _group(self, top: str) -> _Group:
        group = _Group()
        self._gather(group, top, np.zeros(3), np.eye(3))
        if not group.bodies:
            raise UrdfError(f"link {top} has no mass")
        return group

    def _gather(self, group: _Group, link: str, position: Array, rotation: Array) -> None:
        body = _read_body(self._links[link])
        if body is not None:
            inertia = rotation @ body.inertia @ rotation.T
            group.bodies.append(Body(link, body.mass, position + rotation @ body.com, inertia))
        group.frames[link] = position
        for joint in self._below.get(link, []):
            origin, turned = position + rotation @ joint.origin, rotation @ joint.rotation
            if joint.name in self._mapped:
                group.hinges.append((joint, origin, turned))
            elif joint.fixed:
                self._gather(group, joint.child, origin, turned)
            else:
                raise UrdfError(f"joint {joint.name} moves but is not mapped")

    def _check_radius(self, foot: str, radius: float) -> None:
        sphere = self._links[foot].find("collision/geometry/sphere")
        if sphere is not None and abs(float(sphere.attrib["radius"]) - radius) > TOLERANCE:
            raise UrdfError(
                f"foot {foot} is a sphere of {sphere.attrib['radius']} m, the TOML's foot_radius {radius} m"
            )


def _read_joint(element: ElementTree.Element) -> _Joint:
    parent, child = element.find("parent"), element.find("child")
    if parent is None or child is None:
        raise UrdfError(f"joint {element.attrib['name']} has no parent or child")
    axis_element = element.find("axis")
    axis = np.array([1.0, 0.0, 0.0]) if axis_element is None else _vector(axis_element.attrib["xyz"])
    origin, rotation = _read_origin(element)
    return _Joint(
        element.attrib["name"],
        parent.attrib["link"],
        child.attrib["link"],
        element.attrib["type"] == "fixed",
        origin,
        rotation,
        axis / np.linalg.norm(axis),
    )


def _read_body(element: ElementTree.Element) -> Body | None:
    inertial = element.find("inertial")
    if inertial is None:
        return None
    mass, moments = inertial.find("mass"), inertial.find("inertia")
    if mass is None or moments is None:
        raise UrdfError(f"link {element.attrib['name']}: its inertial has no mass or no inertia")
    xx, xy, xz, yy, yz, zz = (float(moments.get(f"i{name}", "0")) for name in ("xx", "xy", "xz", "yy", "yz", "zz"))
    com, rotation = _read_origin(inertial)
    inertia = rotation @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ rotation.T
    return Body(element.attrib["name"], float(mass.attrib["value"]), com, inertia)


def _read_origin(element: ElementTree.Element) -> tuple[Array, Array]:
    origin = element.find("origin")
    if origin is None:
        return np.zeros(3), np.eye(3)
    return _vector(origin.get("xyz", "0 0 0")), from_rpy(_vector(origin.get("rpy", "0 0 0")))


def _vector(text: str) -> Array:
    values = np.array([float(word) for word in text.split()])
    if values.shape != (3,) or not np.isfinite(values).all():
        raise UrdfError(f"{text!r} is not three finite numbers")
    return values
