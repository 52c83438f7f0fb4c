"""Wrench distribution: the quadratic programme of Eq. 3-4, built and checked, and its fallback.

Only stance legs are variables, so the problem has 3, 6, 9 or 12 of them::

    min ½ fᵀ Q f + cᵀ f,   Q = 2 (Aᵀ H A + P),  c = -2 Aᵀ H b
    |f_x|, |f_y| ≤ μ f_z,  f_min ≤ f_z ≤ f_max  for every stance leg
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from drivers.robot import Array
from runtime.control.compilation import compiled
from runtime.control.kinematics import GRAVITY
from runtime.control.records import Clamp

_FRICTION = int(Clamp.FRICTION)
PYRAMID_ROWS = 4
"""Inequality rows a leg: ±f_x - μ f_z ≤ 0, ±f_y - μ f_z ≤ 0."""
TOUCH = 1e-8
"""How far a force may lie beyond a bound or a side of the pyramid, or inside of it and still touch it, N."""
SLOPE_TOLERANCE = 1e-9
"""Slope of the objective that may be left where the touched constraints are taken away, N: with the least curvature
2 P = 2e-3 it bounds the error of the forces by 5e-7 N. DAQP leaves 1e-13 to 1e-10, ProxQP up to 2e-10."""
ROUNDING = 1e-13
"""The same as a share of the gradient, which extreme wrenches make 1e5."""


class GrfProblem(NamedTuple):
    """One tick's programme over the forces of the n stance legs; arrays are views, valid until the next tick."""

    hessian: Array
    """Q. Shape (3n, 3n)."""
    gradient: Array
    """c. Shape (3n,)."""
    friction: float
    min_force: float
    max_force: float


def pyramid(legs: int, friction: float) -> Array:
    """Rows G of the friction pyramid, G f ≤ 0. Shape (4 legs, 3 legs)."""
    leg = np.array([[1.0, 0.0, -friction], [-1.0, 0.0, -friction], [0.0, 1.0, -friction], [0.0, -1.0, -friction]])
    return np.kron(np.eye(legs), leg)


def force_bounds(legs: int, friction: float, min_force: float, max_force: float) -> tuple[Array, Array]:
    """Lower and upper bound of every force component, N; those of x and y follow from the pyramid. Shape (3 legs,)."""
    side = friction * max_force
    return np.tile([-side, -side, min_force], legs), np.tile([side, side, max_force], legs)


@compiled
def aim_wrench(p, policy, t):  # type: ignore[no-untyped-def]
    """Fill ``target_wrench`` (6,): gravity's, the policy's and the centripetal force of the commanded arc."""
    t.target_wrench[:] = t.action[12:]
    t.target_wrench[2] += p.mass * GRAVITY
    turn = policy.centripetal * p.mass * t.velocity_command[2]
    t.target_wrench[0] -= turn * t.velocity_command[1]
    t.target_wrench[1] += turn * t.velocity_command[0]


@compiled
def build_qp(p, t, com, buffer, gradient):  # type: ignore[no-untyped-def]
    """Write Q and c of this tick's stance legs; ``com`` (3,) is the centre of mass in the heading frame.

    Q lies row by row at the start of ``buffer`` (144,), c at the start of ``gradient`` (12,). Returns the
    number of stance legs, or -1 where a number is not finite.
    """
    h = p.wrench_weight
    b = t.target_wrench
    arms = np.empty((4, 3))
    legs = 0
    finite = np.isfinite(b).all()
    for leg in range(4):
        if t.stance[leg]:
            for i in range(3):
                arms[legs, i] = t.feet[leg, i] - com[i]
                finite = finite and np.isfinite(arms[legs, i])
            legs += 1
    hessian = buffer[: 9 * legs * legs].reshape(3 * legs, 3 * legs)
    for i in range(legs):
        rx, ry, rz = arms[i, 0], arms[i, 1], arms[i, 2]
        gradient[3 * i] = -2.0 * (h[0] * b[0] + h[4] * rz * b[4] - h[5] * ry * b[5])
        gradient[3 * i + 1] = -2.0 * (h[1] * b[1] - h[3] * rz * b[3] + h[5] * rx * b[5])
        gradient[3 * i + 2] = -2.0 * (h[2] * b[2] + h[3] * ry * b[3] - h[4] * rx * b[4])
        for k in range(i, legs):
            sx, sy, sz = arms[k, 0], arms[k, 1], arms[k, 2]
            block = hessian[3 * i : 3 * i + 3, 3 * k : 3 * k + 3]
            block[0, 0] = 2.0 * (h[0] + h[4] * rz * sz + h[5] * ry * sy)
            block[0, 1] = -2.0 * h[5] * ry * sx
            block[0, 2] = -2.0 * h[4] * rz * sx
            block[1, 0] = -2.0 * h[5] * rx * sy
            block[1, 1] = 2.0 * (h[1] + h[3] * rz * sz + h[5] * rx * sx)
            block[1, 2] = -2.0 * h[3] * rz * sy
            block[2, 0] = -2.0 * h[4] * rx * sz
            block[2, 1] = -2.0 * h[3] * ry * sz
            block[2, 2] = 2.0 * (h[2] + h[3] * ry * sy + h[4] * rx * sx)
            for a in range(3 if k > i else 0):
                for c in range(3):
                    hessian[3 * k + c, 3 * i + a] = block[a, c]
        for j in range(3):
            hessian[3 * i + j, 3 * i + j] += 2.0 * p.force_weight
    return legs if finite else -1


@compiled
def accept(hessian, gradient, friction, min_force, max_force, force):  # type: ignore[no-untyped-def]
    """Whether ``force`` (3n,) is finite, feasible and optimal within tolerance, whatever its solver says.

    At the minimum the steepest descent is pushed back by the constraints that the force touches and by nothing else
    (Karush, Kuhn, Tucker). What they leave over is the slope of a problem whose exact minimum ``force`` is, so divided
    by the least curvature it bounds the error of the forces; a bound on the objective alone would not.
    """
    n = len(force)
    tolerance = SLOPE_TOLERANCE + ROUNDING * np.abs(gradient).max()
    for leg in range(n // 3):
        fz = force[3 * leg + 2]
        edge = friction * fz
        if not (min_force - TOUCH <= fz <= max_force + TOUCH):
            return False
        pushed = 0.0
        for i in range(2):
            side = force[3 * leg + i]
            slope = _slope(hessian, gradient, force, 3 * leg + i)
            if not abs(side) <= edge + TOUCH:
                return False
            if (slope < 0.0 and side >= edge - TOUCH) or (slope > 0.0 and side <= TOUCH - edge):
                pushed += abs(slope)
            elif not abs(slope) <= tolerance:
                return False
        slope = _slope(hessian, gradient, force, 3 * leg + 2) - friction * pushed
        held = (slope > 0.0 and fz <= min_force + TOUCH) or (slope < 0.0 and fz >= max_force - TOUCH)
        if not (held or abs(slope) <= tolerance):
            return False
    return True


@compiled
def _slope(hessian, gradient, force, row):  # type: ignore[no-untyped-def]
    total = gradient[row]
    for k in range(len(force)):
        total += hessian[row, k] * force[k]
    return total


@compiled
def free_minimum(hessian, gradient, friction, min_force, max_force, force):  # type: ignore[no-untyped-def]
    """Write the minimum without any constraint into ``force`` (3n,). Returns whether it is accepted all the same."""
    n = len(force)
    root = np.empty((12, 12))  # lower triangle of the Cholesky factor
    for i in range(n):
        left = -gradient[i]
        for j in range(i + 1):
            total = hessian[i, j]
            for k in range(j):
                total -= root[i, k] * root[j, k]
            if j < i:
                root[i, j] = total / root[j, j]
                left -= root[i, j] * force[j]
            elif total > 0.0:
                root[i, i] = math.sqrt(total)
            else:
                return False
        force[i] = left / root[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            force[i] -= root[k, i] * force[k]
        force[i] /= root[i, i]
    return accept(hessian, gradient, friction, min_force, max_force, force)


@compiled
def well_posed(hessian, gradient, friction, min_force, max_force):  # type: ignore[no-untyped-def]
    """Whether the problem has a solution at all: finite, and with bounds that leave something between them."""
    return np.isfinite(hessian.sum() + gradient.sum()) and min_force <= max_force


@compiled
def clipped_least_squares(hessian, gradient, friction, min_force, max_force):  # type: ignore[no-untyped-def]
    """The third resort: the unconstrained minimum (3n,), each leg clipped into its truncated pyramid."""
    force = np.linalg.solve(hessian, -gradient)
    for leg in range(len(force) // 3):
        fz = min(max_force, max(min_force, force[3 * leg + 2]))
        side = friction * fz
        force[3 * leg + 2] = fz
        for i in range(2):
            force[3 * leg + i] = min(side, max(-side, force[3 * leg + i]))
    return force


@compiled
def share_forces(p, t, force):  # type: ignore[no-untyped-def]
    """Put the solved forces (3n,) on the stance legs and zero on the others; note a force at its bound."""
    index = 0
    for leg in range(4):
        t.grf[leg] = 0.0
        if t.stance[leg]:
            t.grf[leg] = force[3 * index : 3 * index + 3]
            fz = t.grf[leg, 2]
            edge = p.friction * fz - 1e-6
            bounded = fz >= p.max_force - 1e-6 or fz <= p.min_force + 1e-6
            if bounded or abs(t.grf[leg, 0]) >= edge or abs(t.grf[leg, 1]) >= edge:
                t.clamps |= _FRICTION
            index += 1


@compiled
def cut_forces(p, t):  # type: ignore[no-untyped-def]
    """The direct variant: forces of the policy plus an equal share of gravity, cut into each leg's pyramid."""
    legs = max(1, t.stance.sum())
    for leg in range(4):
        if not t.stance[leg]:
            t.grf[leg] = 0.0
            continue
        wanted = t.grf[leg, 2] + p.mass * GRAVITY / legs
        t.grf[leg, 2] = min(p.max_force, max(p.min_force, wanted))
        side = p.friction * t.grf[leg, 2]
        cut = t.grf[leg, 2] != wanted
        for i in range(2):
            cut = cut or abs(t.grf[leg, i]) > side
            t.grf[leg, i] = min(side, max(-side, t.grf[leg, i]))
        if cut:
            t.clamps |= _FRICTION
