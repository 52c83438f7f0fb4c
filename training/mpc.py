"""The teacher: convex model predictive control of a single rigid body (paper Section IV.A; Di Carlo et al. 2018).

Over the horizon x_{k+1} = A_k x_k + B_k u_k + c, minimise Σ (x_{k+1} - x_ref)ᵀ Q (x_{k+1} - x_ref) + u_kᵀ R u_k with
every force inside its friction pyramid. ``build_sparse`` keeps states and forces as variables: 6 x (12 + 12) = 144, the
paper's form. ``build_condensed`` eliminates the states and the legs in the air: 36 variables in a trot. Both have one
solution; a test holds them to it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import daqp
import numpy as np
from numpy.typing import NDArray

from drivers.robot import Array
from runtime.control.compilation import compiled
from training.rigid_body import GRAVITY, STATES, P, R, RigidBody, V, W, rotation_from_rpy

HORIZON = 6
INFINITE = 1e30
"""Stands for no bound; DAQP's own."""


class MpcError(RuntimeError):
    """A problem that no solver could solve: the message names the solver and its verdict."""


@dataclass(frozen=True, slots=True)
class MpcConfig:
    """Weights and bounds, from the method's page."""

    dt: float = 0.05
    """Step of the horizon, s."""
    position_weight: tuple[float, float, float] = (20.0, 20.0, 400.0)
    velocity_weight: tuple[float, float, float] = (20.0, 20.0, 5.0)
    rpy_weight: tuple[float, float, float] = (200.0, 200.0, 50.0)
    angular_velocity_weight: tuple[float, float, float] = (0.5, 0.5, 1.0)
    force_weight: float = 1e-5
    friction: float = 0.6
    min_force: float = 5.0
    """Of a stance leg, N."""
    max_force: float = 400.0

    @property
    def state_weight(self) -> Array:
        """Diagonal of Q. Shape (12,)."""
        return np.array([*self.position_weight, *self.velocity_weight, *self.rpy_weight, *self.angular_velocity_weight])


class Horizon(NamedTuple):
    """What the teacher is asked: where the body is, where it should go, which feet carry it and where they stand."""

    state: Array
    """Now. Shape (12,)."""
    reference: Array
    """After each step. Shape (horizon, 12)."""
    expected: Array
    """Where the centre of mass is expected at the start of each step: the arms of the forces. Shape (horizon, 3)."""
    feet: Array
    """Contact points in the world during each step, m. Shape (horizon, 4, 3)."""
    stance: NDArray[np.bool_]
    """Shape (horizon, 4)."""


class Problem(NamedTuple):
    """min ½ xᵀ H x + gᵀ x, lower ≤ [x; A x] ≤ upper."""

    hessian: Array
    """Shape (n, n)."""
    gradient: Array
    """Shape (n,)."""
    rows: Array
    """A. Shape (m, n)."""
    lower: Array
    """Of the variables, then of the rows. Shape (n + m,)."""
    upper: Array
    """Shape (n + m,)."""


def build_condensed(horizon: Horizon, body: RigidBody, config: MpcConfig) -> Problem:
    """Forces of the stance legs only, step by step and leg by leg."""
    return Problem(*_condense(
        horizon.state, horizon.reference, horizon.expected, horizon.feet, horizon.stance, body.mass, body.inertia,
        config.dt, config.state_weight, config.force_weight, config.friction, config.min_force, config.max_force,
    ))  # fmt: skip


def build_sparse(horizon: Horizon, body: RigidBody, config: MpcConfig) -> Problem:
    """The paper's 144 variables: x_1 … x_6, then u_0 … u_5. Dynamics are rows with equal bounds."""
    return Problem(*_spread(
        horizon.state, horizon.reference, horizon.expected, horizon.feet, horizon.stance, body.mass, body.inertia,
        config.dt, config.state_weight, config.force_weight, config.friction, config.min_force, config.max_force,
    ))  # fmt: skip


def condensed_forces(solution: Array, stance: NDArray[np.bool_]) -> Array:
    """A condensed solution → forces (horizon, 4, 3), zero in the air."""
    forces = np.zeros((*stance.shape, 3))
    forces[stance] = solution.reshape(-1, 3)
    return forces


def sparse_forces(solution: Array) -> Array:
    """A sparse solution → forces (horizon, 4, 3)."""
    steps = solution.size // (2 * STATES)
    return solution[steps * STATES :].reshape(steps, 4, 3).copy()


def solve_problem(problem: Problem, solver: str = "daqp") -> Array:
    """Minimise; ``solver`` is ``daqp`` or any name that qpsolvers knows (``proxqp``, …). Shape (n,).

    Raises:
        MpcError: not finite, infeasible or out of iterations; bad numbers are refused before a solver sees them.
    """
    if not (np.isfinite(problem.hessian).all() and np.isfinite(problem.gradient).all()):
        raise MpcError(f"{solver}: the problem has a number that is not finite")
    solution = _solve_daqp(problem) if solver == "daqp" else _solve_by_name(problem, solver)
    if not np.isfinite(solution).all():
        raise MpcError(f"{solver}: the solution is not finite")
    return solution


def solve_mpc(horizon: Horizon, body: RigidBody, config: MpcConfig) -> Array:
    """Forces of every step, in the world, N. Shape (horizon, 4, 3); zero for legs in the air."""
    if not horizon.stance.any():
        return np.zeros((*horizon.stance.shape, 3))
    return condensed_forces(solve_problem(build_condensed(horizon, body, config)), horizon.stance)


def _solve_daqp(problem: Problem) -> Array:
    sense = np.zeros(problem.upper.size, dtype=np.int32)
    solution, _, verdict, _ = daqp.solve(
        problem.hessian, problem.gradient, problem.rows, problem.upper, problem.lower, sense
    )
    if verdict < 1:
        raise MpcError(f"daqp: exit flag {verdict}")
    return np.asarray(solution)


def _solve_by_name(problem: Problem, solver: str) -> Array:
    import qpsolvers  # pulls scipy: only for those who ask

    count = problem.gradient.size
    lower, upper = problem.lower[count:], problem.upper[count:]
    equal = lower == upper
    above, below = ~equal & (upper < INFINITE), ~equal & (lower > -INFINITE)
    bounds = [np.where(np.abs(b) >= INFINITE, np.copysign(np.inf, b), b) for b in (problem.lower, problem.upper)]
    options: dict[str, Any] = {"eps_abs": 1e-10, "eps_rel": 0.0} if solver == "proxqp" else {}
    solution = qpsolvers.solve_qp(
        problem.hessian, problem.gradient,
        G=np.concatenate([problem.rows[above], -problem.rows[below]]), h=np.concatenate([upper[above], -lower[below]]),
        A=problem.rows[equal] if equal.any() else None, b=upper[equal] if equal.any() else None,
        lb=bounds[0][:count], ub=bounds[1][:count], solver=solver, **options,
    )  # fmt: skip
    if solution is None:
        raise MpcError(f"{solver}: no solution")
    return np.asarray(solution, dtype=np.float64)


@compiled
def input_matrix(feet, position, yaw, mass, inertia, dt):  # type: ignore[no-untyped-def]
    """B_k (12, 12): what the forces of a step do to the state; level body at ``yaw``, zero-order hold."""
    rotation = np.empty((3, 3))
    rotation_from_rpy(np.array([0.0, 0.0, yaw]), rotation)
    inverse = np.linalg.inv(rotation @ inertia @ rotation.T)
    b = np.zeros((STATES, 12))
    skew = np.zeros((3, 3))
    for leg in range(4):
        r = feet[leg] - position
        skew[0, 1], skew[0, 2], skew[1, 2] = -r[2], r[1], -r[0]
        skew[1, 0], skew[2, 0], skew[2, 1] = r[2], -r[1], r[0]
        angular = inverse @ skew
        turning = rotation.T @ angular
        for row in range(3):
            b[P + row, 3 * leg + row] = 0.5 * dt * dt / mass
            b[V + row, 3 * leg + row] = dt / mass
            for column in range(3):
                b[R + row, 3 * leg + column] = 0.5 * dt * dt * turning[row, column]
                b[W + row, 3 * leg + column] = dt * angular[row, column]
    return b


@compiled
def drift(x, yaw, dt):  # type: ignore[no-untyped-def]
    """A_k x in place, for the columns of ``x`` (12, any): p += dt ṗ, θ += dt Rz(yaw)ᵀ ω."""
    c, s = math.cos(yaw), math.sin(yaw)
    for j in range(x.shape[1]):
        for i in range(3):
            x[P + i, j] += dt * x[V + i, j]
        x[R, j] += dt * (c * x[W, j] + s * x[W + 1, j])
        x[R + 1, j] += dt * (-s * x[W, j] + c * x[W + 1, j])
        x[R + 2, j] += dt * x[W + 2, j]


@compiled
def _fall(x, dt):  # type: ignore[no-untyped-def]
    """Add c, gravity's part of a step, to the column ``x`` (12, 1)."""
    x[P + 2, 0] -= 0.5 * dt * dt * GRAVITY
    x[V + 2, 0] -= dt * GRAVITY


@compiled
def _pyramid(rows, lower, upper, first_row, first_bound, variable, friction):  # type: ignore[no-untyped-def]
    """|f_x|, |f_y| ≤ μ f_z as four rows about the force at ``variable``."""
    row = first_row
    for axis in range(2):
        for sign in (-1.0, 1.0):
            rows[row, variable + axis] = sign
            rows[row, variable + 2] = -friction
            lower[first_bound + row] = -INFINITE
            upper[first_bound + row] = 0.0
            row += 1


@compiled
def _condense(  # type: ignore[no-untyped-def]
    state, reference, expected, feet, stance, mass, inertia, dt, weight, force_weight, friction, min_force, max_force
):
    steps = reference.shape[0]
    contacts = np.sum(stance)
    n = 3 * contacts
    response = np.zeros((steps * STATES, n))
    error = np.empty(steps * STATES)
    root = np.sqrt(weight)
    influence = np.zeros((STATES, n))
    free = state.copy().reshape(STATES, 1)
    done = 0
    for k in range(steps):
        yaw = reference[k, R + 2] if k else state[R + 2]
        b = input_matrix(feet[k], expected[k], yaw, mass, inertia, dt)
        drift(influence[:, :done], yaw, dt)
        drift(free, yaw, dt)
        _fall(free, dt)
        for leg in range(4):
            if stance[k, leg]:
                influence[:, done : done + 3] = b[:, 3 * leg : 3 * leg + 3]
                done += 3
        for i in range(STATES):
            error[k * STATES + i] = root[i] * (free[i, 0] - reference[k, i])
            for j in range(done):
                response[k * STATES + i, j] = root[i] * influence[i, j]
    hessian = 2.0 * (response.T @ response)
    gradient = 2.0 * (response.T @ error)
    rows = np.zeros((4 * contacts, n))
    lower, upper = np.empty(n + 4 * contacts), np.empty(n + 4 * contacts)
    for contact in range(contacts):
        variable = 3 * contact
        for axis in range(3):
            hessian[variable + axis, variable + axis] += 2.0 * force_weight
            lower[variable + axis] = min_force if axis == 2 else -INFINITE
            upper[variable + axis] = max_force if axis == 2 else INFINITE
        _pyramid(rows, lower, upper, 4 * contact, n, variable, friction)
    return hessian, gradient, rows, lower, upper


@compiled
def _spread(  # type: ignore[no-untyped-def]
    state, reference, expected, feet, stance, mass, inertia, dt, weight, force_weight, friction, min_force, max_force
):
    steps = reference.shape[0]
    states = steps * STATES
    n = 2 * states
    dynamics = states
    hessian, gradient = np.zeros((n, n)), np.zeros(n)
    rows = np.zeros((dynamics + 16 * steps, n))
    lower, upper = np.zeros(n + rows.shape[0]), np.zeros(n + rows.shape[0])
    lower[:states], upper[:states] = -INFINITE, INFINITE
    for k in range(steps):
        yaw = reference[k, R + 2] if k else state[R + 2]
        start, forces = k * STATES, states + k * 12
        for i in range(STATES):
            hessian[start + i, start + i] = 2.0 * weight[i]
            gradient[start + i] = -2.0 * weight[i] * reference[k, i]
            hessian[forces + i, forces + i] = 2.0 * force_weight
            rows[start + i, start + i] = 1.0
        transition = np.eye(STATES)
        drift(transition, yaw, dt)
        constant = np.zeros((STATES, 1))
        if k:
            rows[start : start + STATES, start - STATES : start] = -transition
        else:
            constant[:, 0] = transition @ state
        _fall(constant, dt)
        rows[start : start + STATES, forces : forces + 12] = -input_matrix(feet[k], expected[k], yaw, mass, inertia, dt)
        lower[n + start : n + start + STATES] = constant[:, 0]
        upper[n + start : n + start + STATES] = constant[:, 0]
        for leg in range(4):
            variable = forces + 3 * leg
            if stance[k, leg]:
                lower[variable : variable + 2], upper[variable : variable + 2] = -INFINITE, INFINITE
                lower[variable + 2], upper[variable + 2] = min_force, max_force
            _pyramid(rows, lower, upper, dynamics + 16 * k + 4 * leg, n, variable, friction)
    return hessian, gradient, rows, lower, upper
