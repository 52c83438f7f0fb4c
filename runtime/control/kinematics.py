"""Serial 3R legs: forward, inverse, Jacobian and gravity, compiled. Method: Frames and signs.

``geometry`` is a record array (1,) of ``GEOMETRY_DTYPE``; the compiled functions take its record. Feet are the centres
of the foot spheres, from the body origin, in the body frame.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from drivers.description import END, SIDE, RobotDescription
from drivers.robot import Array
from runtime.control.compilation import compiled
from runtime.control.records import Records

GRAVITY = 9.81
REACH_MARGIN = 0.998
"""Share of the leg's length at which a target is cut: a straight leg has no Jacobian."""

GEOMETRY_DTYPE = np.dtype(
    [
        ("hips", "f8", (4, 3)),  # abduction axes from the body origin, m
        ("side", "f8", (4,)),  # +1 left, -1 right
        ("abduction_length", "f8"),
        ("thigh_length", "f8"),
        ("shank_length", "f8"),
        ("foot_radius", "f8"),
        ("lower", "f8", (4, 3)),  # joint bounds, rad
        ("upper", "f8", (4, 3)),
        ("abduction_moment", "f8", (4, 3)),  # mass x centre of mass of each link in its own frame, kg·m
        ("thigh_moment", "f8", (4, 3)),
        ("shank_moment", "f8", (4, 3)),
        ("thigh_mass", "f8"),
        ("shank_mass", "f8"),
    ],
    align=True,
)


def leg_geometry(description: RobotDescription) -> Records:
    """What the compiled kinematics need of a robot. Shape (1,) of ``GEOMETRY_DTYPE``."""
    geometry = np.zeros(1, GEOMETRY_DTYPE)
    links = description.links
    ones, mirror = np.ones(4), SIDE
    for name, link, along in (
        ("abduction_moment", links.abduction, END),
        ("thigh_moment", links.thigh, ones),
        ("shank_moment", links.shank, ones),
    ):
        geometry[name][0] = link.mass * np.stack(
            [along * link.com[0], mirror * link.com[1], ones * link.com[2]], axis=1
        )
    geometry["hips"] = description.hips
    geometry["side"] = SIDE
    for name in ("abduction_length", "thigh_length", "shank_length", "foot_radius"):
        geometry[name] = getattr(description, name)
    geometry["lower"] = description.joints.lower
    geometry["upper"] = description.joints.upper
    geometry["thigh_mass"] = links.thigh.mass
    geometry["shank_mass"] = links.shank.mass
    return geometry


@compiled
def sines_of_leg(q):  # type: ignore[no-untyped-def]
    """Sine and cosine of abduction, hip, and hip + knee: all that foot, Jacobian and gravity need of ``q`` (3,)."""
    return math.sin(q[0]), math.cos(q[0]), math.sin(q[1]), math.cos(q[1]), math.sin(q[1] + q[2]), math.cos(q[1] + q[2])


@compiled
def foot_of_leg(g, leg, q, foot):  # type: ignore[no-untyped-def]
    """Foot of one leg from its angles ``q`` (3,), written into ``foot`` (3,), m, body frame."""
    foot_from_sines(g, leg, sines_of_leg(q), foot)


@compiled
def foot_from_sines(g, leg, sines, foot):  # type: ignore[no-untyped-def]
    """``foot_of_leg`` with the sines at hand."""
    s1, c1, s2, c2, s23, c23 = sines
    l1 = g.side[leg] * g.abduction_length
    x = -g.thigh_length * s2 - g.shank_length * s23
    c = g.thigh_length * c2 + g.shank_length * c23
    foot[0] = g.hips[leg, 0] + x
    foot[1] = g.hips[leg, 1] + l1 * c1 + c * s1
    foot[2] = g.hips[leg, 2] + l1 * s1 - c * c1


@compiled
def jacobian_of_leg(g, leg, q, jacobian):  # type: ignore[no-untyped-def]
    """d foot / d q of one leg, written into ``jacobian`` (3, 3), body frame."""
    jacobian_from_sines(g, leg, sines_of_leg(q), jacobian)


@compiled
def jacobian_from_sines(g, leg, sines, jacobian):  # type: ignore[no-untyped-def]
    """``jacobian_of_leg`` with the sines at hand."""
    s1, c1, s2, c2, s23, c23 = sines
    l1 = g.side[leg] * g.abduction_length
    shank_x = -g.shank_length * s23
    shank_c = g.shank_length * c23
    x = -g.thigh_length * s2 + shank_x
    c = g.thigh_length * c2 + shank_c
    jacobian[0, 0] = 0.0
    jacobian[0, 1] = -c
    jacobian[0, 2] = -shank_c
    jacobian[1, 0] = -l1 * s1 + c * c1
    jacobian[1, 1] = x * s1
    jacobian[1, 2] = shank_x * s1
    jacobian[2, 0] = l1 * c1 + c * s1
    jacobian[2, 1] = -x * c1
    jacobian[2, 2] = -shank_x * c1


@compiled
def angles_of_leg(g, leg, foot, q):  # type: ignore[no-untyped-def]
    """Angles that put one foot at ``foot`` (3,), written into ``q`` (3,), on the stand branch (knee < 0).

    A target out of reach is answered with the nearest direction at full reach. Returns whether it was in reach.
    """
    l1 = g.side[leg] * g.abduction_length
    l2, l3 = g.thigh_length, g.shank_length
    x = foot[0] - g.hips[leg, 0]
    y = foot[1] - g.hips[leg, 1]
    z = foot[2] - g.hips[leg, 2]
    square = y * y + z * z - l1 * l1
    reached = square > 1e-8
    c = math.sqrt(square) if reached else 1e-4
    q[0] = math.atan2(z * l1 + c * y, y * l1 - c * z)  # atan2(z, y) - atan2(-c, l1) in one
    length = math.sqrt(x * x + c * c)
    longest = REACH_MARGIN * (l2 + l3)
    shortest = abs(l2 - l3) + (1.0 - REACH_MARGIN) * (l2 + l3)
    if length > longest or length < shortest:
        reached = False
        bounded = longest if length > longest else shortest
        x, c, length = x * bounded / length, c * bounded / length, bounded
    cosine = min(1.0, max(-1.0, (length * length - l2 * l2 - l3 * l3) / (2.0 * l2 * l3)))
    along, across = l2 + l3 * cosine, -l3 * math.sqrt(1.0 - cosine * cosine)  # of the shank's end, seen from the thigh
    q[1] = math.atan2(-x * along - c * across, c * along - x * across)
    if q[1] < -0.5 * math.pi:  # beyond half a turn backwards: the nearer stop is the upper one
        q[1] += 2.0 * math.pi
    q[2] = -math.acos(cosine)
    return reached


@compiled
def gravity_of_leg(g, leg, q, up, torque):  # type: ignore[no-untyped-def]
    """Torque that holds one leg's own links against gravity, N·m, written into ``torque`` (3,).

    ``up`` (3,) is the world's z axis in the body frame. The sum of m g (up · d com / d q) over the three links.
    """
    gravity_from_sines(g, leg, sines_of_leg(q), up, torque)


@compiled
def gravity_from_sines(g, leg, sines, up, torque):  # type: ignore[no-untyped-def]
    """``gravity_of_leg`` with the sines at hand."""
    s1, c1, s2, c2, s23, c23 = sines
    thigh, shank, abduction = g.thigh_moment[leg], g.shank_moment[leg], g.abduction_moment[leg]
    # m x com before the abduction rotation: x and z turn about y with hip and knee, y does not
    knee_x, knee_z = -g.shank_mass * g.thigh_length * s2, -g.shank_mass * g.thigh_length * c2
    thigh_x, thigh_z = thigh[0] * c2 + thigh[2] * s2, -thigh[0] * s2 + thigh[2] * c2
    shank_x, shank_z = shank[0] * c23 + shank[2] * s23, -shank[0] * s23 + shank[2] * c23
    l1 = g.side[leg] * g.abduction_length * (g.thigh_mass + g.shank_mass)
    y = abduction[1] + l1 + thigh[1] + shank[1]
    z = abduction[2] + thigh_z + knee_z + shank_z
    along_y = up[1] * c1 + up[2] * s1
    along_z = -up[1] * s1 + up[2] * c1
    # about y a vector (x, z) moves by (z, -x); about x a vector (y, z) moves by (-z, y)
    torque[0] = GRAVITY * (along_z * y - along_y * z)
    knee = up[0] * shank_z - along_z * shank_x
    torque[1] = GRAVITY * (up[0] * (thigh_z + knee_z) - along_z * (thigh_x + knee_x) + knee)
    torque[2] = GRAVITY * knee


@compiled
def _all_legs(geometry, values, out, inverse):  # type: ignore[no-untyped-def]
    reached = np.ones(4, np.bool_)
    for leg in range(4):
        if inverse:
            reached[leg] = angles_of_leg(geometry[0], leg, values[leg], out[leg])
        else:
            foot_of_leg(geometry[0], leg, values[leg], out[leg])
    return reached


@compiled
def _all_jacobians(geometry, q, out):  # type: ignore[no-untyped-def]
    for leg in range(4):
        jacobian_of_leg(geometry[0], leg, q[leg], out[leg])


def forward(geometry: Records, q: Array) -> Array:
    """Feet (4, 3) from joint angles (4, 3), m, body frame from the body origin."""
    feet = np.empty((4, 3))
    _all_legs(geometry, q, feet, False)
    return feet


def inverse(geometry: Records, feet: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Joint angles (4, 3) that put the feet (4, 3) where asked, and which were in reach (4,)."""
    q = np.empty((4, 3))
    reached = _all_legs(geometry, feet, q, True)
    return q, reached


def jacobians(geometry: Records, q: Array) -> Array:
    """d foot / d q of every leg, body frame. Shape (4, 3, 3)."""
    out = np.empty((4, 3, 3))
    _all_jacobians(geometry, q, out)
    return out
