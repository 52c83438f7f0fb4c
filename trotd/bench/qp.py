"""The force problem: what both solvers make of a corpus of problems, against answers that carry their own proof."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
import proxsuite

from drivers.robot import Array
from runtime.control.grf import GrfProblem, accept
from runtime.control.solvers import Ladder, make_solver
from trotd.bench.corpus import Corpus
from trotd.bench.exact import constraints, exact_forces
from trotd.bench.report import Figure, Finding, shown

SOLVERS = (("daqp", "proxqp", 1e-6), ("proxqp", "daqp", 1e-2))
"""First and second solver, and the bound of the error of what is accepted, N."""
WRONG = 1e-2
"""Error, N, from which an answer given as solved is called wrong."""


class WarmProxqp:
    """ProxQP as a first try would use it: one object a number of legs, warm started, all settings as they come."""

    def __init__(self) -> None:
        self._problems: dict[int, Any] = {}

    def solve(self, problem: GrfProblem) -> Array | None:
        """The forces (3n,) where it says that it has solved the problem."""
        rows, limits = constraints(problem)
        n = len(problem.gradient)
        lower = np.full(len(limits), -1e20)
        if n in self._problems:
            qp = self._problems[n]
            qp.update(H=problem.hessian, g=problem.gradient, C=rows, l=lower, u=limits)
        else:
            qp = self._problems[n] = proxsuite.proxqp.dense.QP(n, 0, len(rows))
            qp.settings.initial_guess = proxsuite.proxqp.InitialGuess.WARM_START_WITH_PREVIOUS_RESULT
            qp.init(problem.hessian, problem.gradient, None, None, rows, lower, limits)
        qp.solve()
        solved = qp.results.info.status == proxsuite.proxqp.PROXQP_SOLVED
        return np.array(qp.results.x) if solved else None


def measure(quick: bool) -> Iterator[Finding]:
    """Everything of this section."""
    count = 2_000 if quick else 100_000
    tallies = {name: _Tally(name, second) for name, second, _ in SOLVERS}
    naive, wrong, let_through = WarmProxqp(), 0, 0
    for case in shown(Corpus(seed=1).cases(count), "problems", count):
        if case.legs <= 0:
            for tally in tallies.values():
                tally.seen["no leg: idle"] += 1
            continue
        best = exact_forces(case.problem)
        for tally in tallies.values():
            tally.add(case.problem, best)
        force = naive.solve(case.problem)
        if force is not None and not np.abs(force - best).max() <= WRONG:
            wrong += 1
            let_through += bool(accept(*case.problem, force))
    for name, _, bound in SOLVERS:
        yield from tallies[name].findings(count, bound)
    notes = f"of {wrong} that it gave as solved"
    yield Figure(
        "qp",
        f"warm ProxQP at its defaults: answers over {WRONG:g} N wrong let through",
        let_through,
        "",
        0.0,
        "<=",
        notes,
    )


class _Tally:
    """What became of every problem that one solver was asked first."""

    def __init__(self, first: str, second: str) -> None:
        self.name = first
        self.solver = make_solver(first)
        self.ladder = Ladder(self.solver, make_solver(second))
        self.seen = Counter[str]()
        self.worst = 0.0
        self.unnamed = 0

    def add(self, problem: GrfProblem, best: Array) -> None:
        force = self.solver.solve(problem)
        if force is not None and accept(*problem, force):
            self.seen["accepted"] += 1
            self.worst = max(self.worst, float(np.abs(force - best).max()))
            return
        force, status = self.ladder.fall_back(problem)
        self.seen[f"fell to {status.name.lower()}"] += 1
        self.unnamed += force is None or not bool(np.isfinite(force).all())

    def findings(self, count: int, bound: float) -> Iterator[Finding]:
        named = 100.0 * (count - self.unnamed) / count
        notes = ", ".join(f"{key} {value}" for key, value in sorted(self.seen.items()))
        yield Figure("qp", f"{self.name}: accepted or a named fallback, of {count}", named, "%", 100.0, ">=", notes)
        yield Figure("qp", f"{self.name}: worst error of what was accepted", self.worst, "N", bound)
