"""Solvers of the GRF programme, by name, behind one verb; and the ladder that never leaves a tick without an answer.

Each keeps one workspace for each number of stance legs. Nothing a solver says is believed: ``grf.accept`` decides.
What is known of each one's ways is in docs/decisions/0004-grf-solver.md.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from drivers.robot import Array
from runtime.control.grf import (
    PYRAMID_ROWS,
    GrfProblem,
    accept,
    clipped_least_squares,
    force_bounds,
    free_minimum,
    pyramid,
    well_posed,
)
from runtime.control.records import SolverStatus


class GrfSolver(Protocol):
    """One way to solve a ``GrfProblem``."""

    def solve(self, problem: GrfProblem) -> Array | None:
        """The forces (3n,), or None where the solver gives up. May be wrong: check with ``grf.accept``."""


class DaqpSolver:
    """DAQP, a dual active-set method, with a persistent workspace for each number of legs.

    Nine of ten ticks touch no constraint: then the answer is one Cholesky factorisation away, and DAQP is not asked.
    """

    def __init__(self) -> None:
        import daqp

        self._model: Callable[[], Any] = daqp.Model
        self._models: dict[int, tuple[GrfProblem, Any, Array]] = {}

    def solve(self, problem: GrfProblem) -> Array | None:
        """See ``GrfSolver``. ``sense`` is cleared each time, so the result is a pure function of the problem."""
        n = len(problem.gradient)
        free = np.empty(n)
        if free_minimum(*problem, free):
            return free
        if not problem.min_force <= problem.max_force:  # nothing to find, and a workspace to lose
            return None
        known = self._models.pop(n, None)  # put back on success alone: whatever went wrong may have left it broken
        if known is None or (known[0] is not problem and known[0][2:] != problem[2:]):
            known = (problem, self._setup(problem), np.zeros(n + PYRAMID_ROWS * n // 3, np.int32))
        _, model, sense = known
        if model.update(problem.hessian, problem.gradient, None, None, None, sense) < 0:
            return None
        force, _, exitflag, _ = model.solve()
        if exitflag != 1:
            return None
        self._models[n] = known
        return force  # type: ignore[no-any-return]

    def _setup(self, problem: GrfProblem) -> Any:
        legs = len(problem.gradient) // 3
        lower, upper = force_bounds(legs, problem.friction, problem.min_force, problem.max_force)
        rows = pyramid(legs, problem.friction)
        model = self._model()
        model.settings = {"iter_limit": 200, "primal_tol": 1e-9}
        model.setup(
            problem.hessian,
            problem.gradient,
            rows,
            np.concatenate([upper, np.zeros(len(rows))]),
            np.concatenate([lower, np.full(len(rows), -1e30)]),
            np.zeros(len(upper) + len(rows), np.int32),
        )
        return model


class ProxqpSolver:
    """proxsuite's dense ProxQP, persistent, started cold each time: kept warm it returned wrong forces as solved."""

    def __init__(self) -> None:
        import proxsuite

        self._proxqp = proxsuite.proxqp
        self._problems: dict[int, tuple[tuple[float, float, float], Any]] = {}

    def solve(self, problem: GrfProblem) -> Array | None:
        """See ``GrfSolver``. The object is rebuilt after anything but success: one NaN would poison it for ever."""
        n = len(problem.gradient)
        bounds = (problem.friction, problem.min_force, problem.max_force)
        known = self._problems.pop(n, None)
        if known is None or known[0] != bounds:
            known = (bounds, self._setup(problem))
        else:
            known[1].update(H=problem.hessian, g=problem.gradient)
        qp = known[1]
        qp.solve()
        if qp.results.info.status != self._proxqp.PROXQP_SOLVED:
            return None
        self._problems[n] = known
        return np.array(qp.results.x)

    def _setup(self, problem: GrfProblem) -> Any:
        legs = len(problem.gradient) // 3
        rows = np.vstack([pyramid(legs, problem.friction), np.eye(3 * legs)[2::3]])
        upper = np.concatenate([np.zeros(PYRAMID_ROWS * legs), np.full(legs, problem.max_force)])
        lower = np.concatenate([np.full(PYRAMID_ROWS * legs, -1e20), np.full(legs, problem.min_force)])
        qp = self._proxqp.dense.QP(3 * legs, 0, len(rows))
        qp.settings.eps_abs = 1e-10
        qp.settings.check_duality_gap = True  # without it a side force lies up to 10 µN off the edge that holds it
        qp.settings.eps_duality_gap_abs = 1e-9
        qp.settings.eps_duality_gap_rel = 0.0
        qp.settings.eps_rel = 0.0
        qp.settings.eps_primal_inf = 1e-12
        qp.settings.eps_dual_inf = 1e-12
        qp.settings.max_iter = 50
        qp.settings.max_iter_in = 20  # the default 1500 took a second over one NaN
        qp.settings.initial_guess = self._proxqp.InitialGuess.NO_INITIAL_GUESS
        qp.init(problem.hessian, problem.gradient, None, None, rows, lower, upper)
        return qp


class QpsolversSolver:
    """Any other solver that qpsolvers knows, by its name there; no workspace is kept."""

    def __init__(self, name: str) -> None:
        import qpsolvers

        if name not in qpsolvers.available_solvers:
            known = ", ".join(sorted({"daqp", "proxqp", *qpsolvers.available_solvers}))
            raise ValueError(f"control.grf.solver = {name!r}: not installed; here are {known}")
        self._name = name
        self._solve: Callable[..., Any] = qpsolvers.solve_qp

    def solve(self, problem: GrfProblem) -> Array | None:
        """See ``GrfSolver``."""
        legs = len(problem.gradient) // 3
        lower, upper = force_bounds(legs, problem.friction, problem.min_force, problem.max_force)
        rows = pyramid(legs, problem.friction)
        zero = np.zeros(len(rows))
        result = self._solve(problem.hessian, problem.gradient, rows, zero, lb=lower, ub=upper, solver=self._name)
        return None if result is None else np.asarray(result, np.float64)


def make_solver(name: str) -> GrfSolver:
    """The solver of that name.

    Raises:
        ValueError: no such solver is installed; the message lists those that are.
    """
    if name == "daqp":
        return DaqpSolver()
    if name == "proxqp":
        return ProxqpSolver()
    return QpsolversSolver(name)


class Ladder:
    """Solve → second solver → clipped least squares → failed: each step checked, counted and named."""

    def __init__(self, first: GrfSolver, second: GrfSolver) -> None:
        self.first = first
        self.second = second

    def solve(self, problem: GrfProblem) -> tuple[Array | None, SolverStatus]:
        """Forces (3n,) that were accepted and how they were found; None when nothing finite came out."""
        force = self.ask_first(problem)
        if force is not None and accept(*problem, force):
            return force, SolverStatus.SOLVED
        return self.fall_back(problem)

    def warm_up(self, problem: GrfProblem) -> None:
        """Take every step on a problem that has a solution."""
        self.solve(problem)
        self.fall_back(problem)
        clipped_least_squares(*problem)

    def ask_first(self, problem: GrfProblem) -> Array | None:
        """What the first solver says; the caller is to hold it against ``grf.accept``."""
        try:
            return self.first.solve(problem)
        except Exception:  # see _guarded; here every call counts
            return None

    def fall_back(self, problem: GrfProblem) -> tuple[Array | None, SolverStatus]:
        """The steps below the first solver."""
        if not well_posed(*problem):  # nothing to ask the others, who may take long to find out
            return None, SolverStatus.FAILED
        force = _guarded(self.second, problem)
        if force is not None and accept(*problem, force):
            return force, SolverStatus.SECOND
        try:
            force = clipped_least_squares(*problem)
        except np.linalg.LinAlgError:
            return None, SolverStatus.FAILED
        if np.isfinite(force).all():
            return force, SolverStatus.LEAST_SQUARES
        return None, SolverStatus.FAILED


def _guarded(solver: GrfSolver, problem: GrfProblem) -> Array | None:
    """A solver that raises has failed like one that says so: the tick goes on with the next."""
    try:
        return solver.solve(problem)
    except Exception:  # a third-party solver may raise anything, and the robot must not fall for it
        return None
