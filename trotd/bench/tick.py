"""One step of the controller: against the bare solver, the plain numpy form, the clock and its own bad ticks."""

from __future__ import annotations

import asyncio
import gc
import importlib.util
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import uvloop

from drivers.robot import Measurement
from runtime import realtime
from runtime.control.controller import Controller
from runtime.control.grf import GrfProblem, force_bounds, pyramid
from runtime.control.solvers import Ladder
from runtime.ticker import Ticker
from trotd.bench.host import stolen_time
from trotd.bench.report import Figure, Finding, Missing, shown
from trotd.bench.walk import Walked, record_walk

PLAIN = Path(__file__).parents[2] / "tests" / "plain.py"
now = time.perf_counter_ns


def measure(quick: bool) -> Iterator[Finding]:
    """Everything of this section."""
    walked = record_walk()
    yield from against_the_solver(walked, 5 if quick else 20)
    yield from against_plain(walked, 1 if quick else 3)
    yield from bad_ticks(walked, 2 if quick else 6)
    for rate in (200.0, 1000.0):
        yield from paced(walked, rate, 3.0 if quick else 15.0)


def bare_solvers(controller: Controller) -> dict[int, tuple[Any, np.ndarray]]:
    """A persistent DAQP model and its ``sense`` for each number of stance legs, with nothing of ours around it."""
    import daqp

    models = {}
    for legs in range(1, 5):
        _, _, *bounds = controller.problems[legs]
        lower, upper = force_bounds(legs, *bounds)
        rows = pyramid(legs, bounds[0])
        sense = np.zeros(len(upper) + len(rows), np.int32)
        model = daqp.Model()
        upper, lower = np.concatenate([upper, np.zeros(len(rows))]), np.concatenate([lower, np.full(len(rows), -1e30)])
        model.setup(np.eye(3 * legs), np.zeros(3 * legs), rows, upper, lower, sense)
        models[legs] = (model, sense)
    return models


def against_the_solver(walked: Walked, rounds: int) -> Iterator[Finding]:
    """Step and bare solve take turns, tick by tick and in both orders, on the same problems.

    The bare solver gets them half a walk later, else it would find its memory warm from the step's own solve.
    """
    controller = walked.controller()
    models = bare_solvers(controller)
    problems = []
    for measured in walked.measurements:
        controller.step(measured, walked.command)
        if legs := int(controller.record["stance"].sum()):
            problems.append((*models[legs], *(array.copy() for array in controller.problems[legs][:2])))
    steps, solves = [], []
    for _ in shown(range(rounds), "step and bare solve", rounds):
        controller.reset(walked.measurements[0])
        for index, measured in enumerate(walked.measurements):
            problem = problems[(index + len(problems) // 2) % len(problems)]
            if index % 2:
                solves.append(_time_solve(*problem))
            first = now()
            controller.step(measured, walked.command)
            steps.append(now() - first)
            if not index % 2:
                solves.append(_time_solve(*problem))
    step_p50, solve_p50 = float(np.median(steps)) / 1e3, float(np.median(solves)) / 1e3
    yield Figure("tick", "one step, hot, p50", step_p50, "µs")
    yield Figure("tick", "bare DAQP update and solve, p50", solve_p50, "µs")
    yield Figure("tick", "step over bare solve, medians", step_p50 / solve_p50, "x", 2.5)


def _time_solve(model: Any, sense: np.ndarray, hessian: np.ndarray, gradient: np.ndarray) -> int:
    first = now()
    model.update(H=hessian, f=gradient, sense=sense)
    model.solve()
    return now() - first


def against_plain(walked: Walked, rounds: int) -> Iterator[Finding]:
    """The plain numpy form of the same arithmetic, which lives with the tests, tick by tick in turns."""
    if not PLAIN.exists():
        yield Missing("tick", "faster than plain numpy", f"{PLAIN.name} lives in the source tree's tests")
        return
    spec = importlib.util.spec_from_file_location("trotd_plain", PLAIN)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    plain = module.PlainController(walked.config.robot, walked.config.control, walked.policy)
    compiled = walked.controller()
    plain.reset(walked.measurements[0])
    ours, theirs = [], []
    for _ in shown(range(rounds), "plain numpy", rounds):
        for measured in walked.measurements:
            first = now()
            compiled.step(measured, walked.command)
            second = now()
            plain.step(measured, walked.command)
            ours.append(second - first)
            theirs.append(now() - second)
    yield Figure("tick", "plain numpy, p50", float(np.median(theirs)) / 1e3, "µs")
    yield Figure("tick", "faster than plain numpy, medians", float(np.median(theirs) / np.median(ours)), "x", 8.0, ">=")


def bad_ticks(walked: Walked, rounds: int) -> Iterator[Finding]:
    """A bad tick between two good ones, again and again; and whether the good one after it is the right one."""
    for name, make in BAD.items():
        controller, sound = walked.controller(), walked.controller()
        spoilt = make(controller)
        bad, good, wrong = [], [], 0
        for measured in walked.measurements * rounds:
            with spoilt(measured) as given:
                first = now()
                controller.step(given, walked.command)
                bad.append(now() - first)
            first = now()
            command = controller.step(measured, walked.command)
            good.append(now() - first)
            if name == NAN:
                expected = sound.step(measured, walked.command)
                wrong += not np.array_equal(command.torque, expected.torque)
        yield Figure("tick", f"bad tick over a good one: {name}", float(np.median(bad) / np.median(good)), "x", 3.0)
        if name == NAN:
            yield Figure("tick", "good ticks that a bad one before them changed", float(wrong), "", 0.0)


Spoiler = Callable[[Measurement], AbstractContextManager[Measurement]]
"""Makes one tick a bad one while its context lasts, and gives the measurement for it."""
NAN = "a number that is none"


def _not_a_number(_controller: Controller) -> Spoiler:
    nothing = np.full(3, np.nan)

    @contextmanager
    def spoilt(measured: Measurement) -> Iterator[Measurement]:
        yield replace(measured, imu=replace(measured.imu, linear_acceleration=nothing))

    return spoilt


def _infeasible(controller: Controller) -> Spoiler:
    usual = controller.problems
    crossed = [problem._replace(min_force=500.0, max_force=100.0) for problem in usual]

    @contextmanager
    def spoilt(measured: Measurement) -> Iterator[Measurement]:
        controller.problems = crossed
        yield measured
        controller.problems = usual

    return spoilt


class _Silent:
    def solve(self, _problem: GrfProblem) -> None:
        return None


def _solvers_give_up(controller: Controller) -> Spoiler:
    usual, broken = controller.ladder, Ladder(_Silent(), _Silent())

    @contextmanager
    def spoilt(measured: Measurement) -> Iterator[Measurement]:
        controller.ladder = broken
        yield measured
        controller.ladder = usual

    return spoilt


def _no_stance(controller: Controller) -> Spoiler:
    usual = float(controller.parameters["swing_fraction"][0])

    @contextmanager
    def spoilt(measured: Measurement) -> Iterator[Measurement]:
        kept = controller.state.copy()
        controller.state["swinging"], controller.state["clock"] = 1, 0.1
        controller.parameters["swing_fraction"] = 1.0
        yield measured
        controller.parameters["swing_fraction"] = usual
        controller.state[:] = kept

    return spoilt


BAD: dict[str, Callable[[Controller], Spoiler]] = {
    NAN: _not_a_number,
    "bounds that leave nothing": _infeasible,
    "both solvers give up": _solvers_give_up,
    "no leg in stance": _no_stance,
}


def paced(walked: Walked, rate_hz: float, seconds: float) -> Iterator[Finding]:
    """The same step in a loop that sleeps between ticks: cold caches, as on the robot.

    Only seconds in which the machine's host took no processor time count (``trotd.bench.host``).
    """
    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        windows = runner.run(_paced(walked.controller(), walked, rate_hz, seconds))
    calm = [taken for taken, stolen in windows if stolen == 0.0]
    if not calm:
        yield Missing("tick", f"paced at {rate_hz:g} Hz", f"the machine's host took time in each of {len(windows)} s")
        return
    p50, p99 = np.percentile(np.concatenate(calm), [50, 99]) / 1e3
    bound = 20.0 if rate_hz == 1000.0 else None
    note = f"{len(calm)} of {len(windows)} s were undisturbed by the host"
    yield Figure("tick", f"paced at {rate_hz:g} Hz, p50", float(p50), "µs", note=note)
    yield Figure("tick", f"paced at {rate_hz:g} Hz, p99", float(p99), "µs")
    yield Figure("tick", f"paced at {rate_hz:g} Hz, p99 of the period", float(p99 * rate_hz / 1e4), "%", bound)


async def _paced(
    controller: Controller, walked: Walked, rate_hz: float, seconds: float
) -> list[tuple[list[int], float]]:
    """Of each second but the first: what its steps took, ns, and what the host took, s."""
    windows: list[tuple[list[int], float]] = []
    taken: list[int] = []
    stolen = stolen_time()
    measurements = walked.measurements
    realtime.settle_garbage()
    realtime.hold_garbage(True)
    try:
        with Ticker(rate_hz) as ticker:
            for index in range(round(rate_hz * (seconds + 1.0))):
                await ticker.wait()
                first = now()
                controller.step(measurements[index % len(measurements)], walked.command)
                taken.append(now() - first)
                if len(taken) == rate_hz:
                    before, stolen = stolen, stolen_time()
                    windows.append((taken, stolen - before))
                    taken = []
    finally:
        realtime.hold_garbage(False)
        gc.unfreeze()
    return windows[1:]
