"""The forces that a force problem really asks for: an answer that carries its own proof.

No solver is believed. One of them names the active constraints; the equations of that set are solved and refined in
extended precision, and the answer counts only if it then meets the optimality conditions, which are sufficient because
the problem is strictly convex. So it does not matter where the guess came from.
"""

from __future__ import annotations

from collections.abc import Iterator

import daqp
import numpy as np
import proxsuite
from numpy.typing import NDArray

from drivers.robot import Array
from runtime.control.grf import GrfProblem

Extended = NDArray[np.longdouble]
FEASIBLE = 1e-10
"""Violation of a constraint, N, that still counts as none."""
STATIONARY = 1e-11
"""Slope that the constraints do not explain; over the curvature of at least 2e-3 it is a force error of 5e-9 N."""
_REPAIRS = 30


class NotExact(ArithmeticError):
    """No answer could be proven."""


def constraints(problem: GrfProblem) -> tuple[Array, Array]:
    """All constraints as G f ≤ h: four sides, floor and ceiling of every leg. Shapes (6 legs, 3 legs), (6 legs,)."""
    legs, mu = len(problem.gradient) // 3, problem.friction
    leg = np.array([[1, 0, -mu], [-1, 0, -mu], [0, 1, -mu], [0, -1, -mu], [0, 0, -1], [0, 0, 1]], float)
    return np.kron(np.eye(legs), leg), np.tile([0.0, 0.0, 0.0, 0.0, -problem.min_force, problem.max_force], legs)


def exact_forces(problem: GrfProblem) -> Array:
    """The forces (3n,) at the minimum, N.

    Raises:
        NotExact: no guess led to an answer that meets the optimality conditions.
    """
    rows, limits = constraints(problem)
    for guess in _guesses(problem, rows, limits):
        active = guess
        for _ in range(_REPAIRS):
            try:
                force, multipliers = _equations(problem, rows, limits, active)
            except np.linalg.LinAlgError:
                break
            if is_minimum(problem, force, multipliers):
                return force.astype(np.float64)
            active = (multipliers > 0.0) | (rows @ force - limits > FEASIBLE)
    raise NotExact(f"no proven minimum of a problem with {len(problem.gradient)} variables")


def is_minimum(problem: GrfProblem, force: Array | Extended, multipliers: Array | Extended) -> bool:
    """Whether forces (3n,) and multipliers (6n,) of ``constraints`` meet the conditions of Karush, Kuhn and Tucker."""
    rows, limits = constraints(problem)
    slack = limits - rows @ force
    slope = problem.hessian @ force + problem.gradient + rows.T @ multipliers
    return bool(
        slack.min() >= -FEASIBLE
        and multipliers.min() >= 0.0
        and np.abs(slack[multipliers > 0.0]).max(initial=0.0) <= FEASIBLE
        and np.abs(slope).max() <= STATIONARY * max(1.0, np.abs(problem.gradient).max() / 1e3)
    )


def _equations(problem: GrfProblem, rows: Array, limits: Array, active: NDArray[np.bool_]) -> tuple[Extended, Extended]:
    """Forces and multipliers with the ``active`` rows as equations, refined in extended precision."""
    n, chosen = len(problem.gradient), rows[active]
    size = n + len(chosen)
    matrix = np.zeros((size, size))
    matrix[:n, :n], matrix[:n, n:], matrix[n:, :n] = problem.hessian, chosen.T, chosen
    wanted = np.concatenate([-problem.gradient, limits[active]]).astype(np.longdouble)
    inverse = np.linalg.inv(matrix)
    solution = (inverse @ wanted.astype(np.float64)).astype(np.longdouble)
    for _ in range(4):
        solution += inverse @ (wanted - matrix.astype(np.longdouble) @ solution).astype(np.float64)
    multipliers = np.zeros(len(rows), np.longdouble)
    multipliers[active] = solution[n:]
    return solution[:n], multipliers


def _guesses(problem: GrfProblem, rows: Array, limits: Array) -> Iterator[NDArray[np.bool_]]:
    lower = np.full(len(limits), -1e30)
    sense = np.zeros(len(limits), np.int32)
    _, _, flag, info = daqp.solve(
        problem.hessian.copy(), problem.gradient.copy(), rows, limits, lower, sense, primal_tol=1e-11, dual_tol=1e-12
    )
    if flag == 1:
        yield info["lam"] > 0.0
    qp = proxsuite.proxqp.dense.QP(len(problem.gradient), 0, len(limits))
    qp.settings.eps_abs, qp.settings.eps_primal_inf, qp.settings.eps_dual_inf = 1e-11, 1e-14, 1e-14
    qp.settings.max_iter = 2000
    qp.init(problem.hessian, problem.gradient, None, None, rows, np.full(len(limits), -1e20), limits)
    qp.solve()
    yield qp.results.z > 1e-7
    yield np.zeros(len(limits), bool)
