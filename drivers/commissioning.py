"""The pure part of commissioning: readings in, wiring out. Nothing here moves anything.

Each step solves for one unknown from what the motors and the IMU say before and after somebody moves one joint, brings
the legs to their end stops, or tilts the body.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drivers.description import RobotDescription
from drivers.errors import DriverError
from drivers.robot import JOINTS, LEGS, Array

MotorPlace = tuple[int, int]
"""(bus from 1, id)."""
GRAVITY, GRAVITY_TOLERANCE = 9.81, 0.3
"""m/s²."""
LEAST_MOTION = 0.05
"""rad that a motor must turn to count as moved."""
LEAST_RATIO = 3.0
"""How many times further the moved motor must turn than any other."""
RANGE_TOLERANCE = 0.15
"""rad by which a measured range may differ from the model's."""
LEAST_TILT = 0.15
"""rad by which the body must be tilted between two poses of the IMU."""
LARGEST_BASELINE = 0.3
"""Share of a leg's part of the weight that its torque may feign."""


class CommissionError(DriverError):
    """A step that did not give an answer to trust: the message says what was seen and what to do again."""


@dataclass(frozen=True, slots=True)
class FoundJoint:
    """One motor, told apart."""

    place: MotorPlace
    direction: int
    """+1 where it turns as the joint does."""


def joint_name(leg: int, joint: int) -> str:
    """``FL knee``."""
    return f"{LEGS[leg]} {JOINTS[joint]}"


def find_moved(before: dict[MotorPlace, float], after: dict[MotorPlace, float], name: str) -> FoundJoint:
    """Which motor moved when joint ``name`` was turned the positive way, and which way it turns.

    Args:
        before: output angle of every motor, rad.
        after: the same when the joint was turned.
        name: for messages.

    Raises:
        CommissionError: nothing moved enough, or more than one did.
    """
    moved = {place: after[place] - angle for place, angle in before.items() if place in after}
    if not moved:
        raise CommissionError(f"{name}: no motor answered both times")
    ranked = sorted(moved, key=lambda place: -abs(moved[place]))
    first = ranked[0]
    if abs(moved[first]) < LEAST_MOTION:
        raise CommissionError(
            f"{name}: no motor turned; the most was bus {first[0]} id {first[1]} by {abs(moved[first]):.3f} rad, "
            f"{LEAST_MOTION} is wanted. Move it further"
        )
    if len(ranked) > 1 and abs(moved[first]) < LEAST_RATIO * abs(moved[ranked[1]]):
        second = ranked[1]
        raise CommissionError(
            f"{name}: two motors turned, bus {first[0]} id {first[1]} by {moved[first]:+.2f} rad and bus {second[0]} "
            f"id {second[1]} by {moved[second]:+.2f} rad. Hold the others still"
        )
    return FoundJoint(first, 1 if moved[first] > 0 else -1)


def assign(found: Sequence[Sequence[FoundJoint]]) -> tuple[Array, Array, Array]:
    """Ids, buses and directions, each (4, 3), of all joints told apart.

    Raises:
        CommissionError: one motor was found at two joints.
    """
    seen: dict[MotorPlace, str] = {}
    for leg, row in enumerate(found):
        for joint, item in enumerate(row):
            name = joint_name(leg, joint)
            if item.place in seen:
                raise CommissionError(
                    f"bus {item.place[0]} id {item.place[1]} was found at {seen[item.place]} and at {name}: "
                    "move both again, or two motors share an id"
                )
            seen[item.place] = name
    table = np.array([[(*item.place, item.direction) for item in row] for row in found])
    return table[:, :, 1], table[:, :, 0], table[:, :, 2]


def zeros_from_stops(
    description: RobotDescription, at_first: Array, at_second: Array, direction: Array, gear: Array
) -> Array:
    """Offsets (4, 3), rad, from the motors' angles at the joints' two end stops, in whichever order.

    joint = direction · motor / gear − offset puts the middle of the measured range on the middle of the model's.

    Raises:
        CommissionError: a measured range that is not the model's, by joint.
    """
    lower, upper = np.array(description.joints.lower), np.array(description.joints.upper)
    ends = np.stack([direction * at_first / gear, direction * at_second / gear])
    low, high = ends.min(axis=0), ends.max(axis=0)
    problems = (
        range_problem(description, leg, joint, high[leg, joint] - low[leg, joint])
        for leg in range(4)
        for joint in range(3)
    )
    if wrong := [problem for problem in problems if problem]:
        raise CommissionError("; ".join(wrong) + ". Bring each joint to both of its stops, or mend the model")
    offsets: Array = (low + high) / 2 - (lower + upper) / 2
    return offsets


def range_problem(description: RobotDescription, leg: int, joint: int, turned: float) -> str:
    """What is wrong with a range, rad, measured from stop to stop; empty where it is the model's."""
    wanted = description.joints.upper[leg][joint] - description.joints.lower[leg][joint]
    if abs(turned - wanted) <= RANGE_TOLERANCE:
        return ""
    return f"{joint_name(leg, joint)}: turned {turned:.2f} rad from stop to stop, the model says {wanted:.2f}"


def zeros_from_pose(motor: Array, pose: Array, direction: Array, gear: Array) -> Array:
    """Offsets (4, 3), rad, from the motors' angles while a jig or folded legs hold the joints at ``pose`` (4, 3)."""
    offsets: Array = direction * motor / gear - pose
    return offsets


def mount_from_gravity(level: Array, nose_down: Array, left_down: Array) -> Array:
    """How the IMU is mounted, from what its accelerometer says at rest in three poses, each (3,), m/s².

    Level gives the body's z in the sensor's frame; nose down brings gravity's reaction towards the body's −x, left side
    down towards −y: two directions more than are needed, so that they check each other (least squares on rotations).

    Returns:
        Unit quaternion w x y z, sensor → body.

    Raises:
        CommissionError: not at rest, not tilted enough, or poses that contradict each other.
    """
    for name, force in (("level", level), ("nose down", nose_down), ("left down", left_down)):
        if not abs(float(np.linalg.norm(force)) - GRAVITY) < GRAVITY_TOLERANCE:
            raise CommissionError(
                f"{name}: the accelerometer reads {np.linalg.norm(force):.2f} m/s², {GRAVITY} ± {GRAVITY_TOLERANCE} is "
                "wanted. Hold the body still"
            )
    up = level / np.linalg.norm(level)
    forward = -_across(nose_down, up, "nose down")
    left = -_across(left_down, up, "left down")
    if np.dot(np.cross(forward, left), up) < np.cos(0.35) or abs(np.dot(forward, left)) > np.sin(0.35):
        raise CommissionError(
            "nose down and left down are not at right angles, or are exchanged: tilt about one axis at a time"
        )
    u, _, vt = np.linalg.svd(np.stack([forward, left, up]))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return quaternion_of(rotation)


def quaternion_of(rotation: Array) -> Array:
    """Unit quaternion w x y z of a rotation matrix (3, 3), w ≥ 0. Shape (4,)."""
    m = rotation
    # The eigenvector of this symmetric matrix with the largest eigenvalue is the quaternion x y z w (Bar-Itzhack 2000).
    k = np.array(
        [
            [m[0, 0] - m[1, 1] - m[2, 2], m[1, 0] + m[0, 1], m[2, 0] + m[0, 2], m[2, 1] - m[1, 2]],
            [m[1, 0] + m[0, 1], m[1, 1] - m[0, 0] - m[2, 2], m[2, 1] + m[1, 2], m[0, 2] - m[2, 0]],
            [m[2, 0] + m[0, 2], m[2, 1] + m[1, 2], m[2, 2] - m[0, 0] - m[1, 1], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], m[0, 0] + m[1, 1] + m[2, 2]],
        ]
    )
    x, y, z, w = np.linalg.eigh(k)[1][:, -1]
    quaternion = np.array([w, x, y, z])
    return -quaternion if w < 0 else quaternion


def contact_baseline(forces: Array, feet: Array, weight: float, com: Array) -> tuple[float, float, float, float]:
    """Vertical force that each leg's torque feigns while the robot stands still, N.

    Forces that carry the weight obey three equations: their sum, and their moments about x and y. What the felt ones
    disagree by is shared among the legs with the least norm. A load that the legs exchange diagonally obeys all three
    and cannot be told from an error: it stays.

    Args:
        forces: felt, heading frame. Shape (n, 4).
        feet: x and y from the body origin, heading frame, m. Shape (4, 2).
        weight: of the robot, N.
        com: x and y of the centre of mass from the body origin, heading frame, m. Shape (2,).

    Raises:
        CommissionError: a leg feigns too much to be an error of its torque sensing.
    """
    balance = np.vstack([np.ones(4), feet.T])
    carried = weight * np.array([1.0, *com])
    feigned = np.linalg.pinv(balance) @ (balance @ np.median(forces, axis=0) - carried)
    bound = LARGEST_BASELINE * weight / 4
    for leg, force in zip(LEGS, feigned.tolist(), strict=True):
        if not abs(force) <= bound:
            raise CommissionError(
                f"{leg} feigns {force:+.0f} N, {bound:.0f} N is the most that is believed: does the robot carry a "
                "load, does it stand still on level ground, are its zeros right?"
            )
    a, b, c, d = feigned.tolist()
    return a, b, c, d


def _across(force: Array, up: Array, name: str) -> Array:
    """Unit direction in which gravity's reaction moved away from ``up``, both in the sensor's frame."""
    direction = force / np.linalg.norm(force)
    moved = direction - np.dot(direction, up) * up
    size = float(np.linalg.norm(moved))
    if size < np.sin(LEAST_TILT):
        raise CommissionError(f"{name}: the body is tilted by {np.arcsin(size):.2f} rad, {LEAST_TILT} is wanted")
    unit: Array = moved / size
    return unit
