"""The force problem: built as Eq. 3-4 say, accepted only at its minimum, shared out to the legs that stand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import Workbench

from runtime.control.grf import (
    GrfProblem,
    accept,
    aim_wrench,
    build_qp,
    clipped_least_squares,
    cut_forces,
    force_bounds,
    pyramid,
    share_forces,
)
from runtime.control.records import Clamp
from trotd.bench.corpus import Corpus
from trotd.bench.exact import exact_forces

CASES = [case for case in Corpus(seed=7).cases(400) if case.legs > 0]
EXACT = [exact_forces(case.problem) for case in CASES]


def cross(arm: np.ndarray) -> np.ndarray:
    x, y, z = arm
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def random_bench(rng: np.random.Generator, stance: tuple[int, ...]) -> tuple[Workbench, np.ndarray]:
    bench = Workbench()
    bench.t.stance = stance
    bench.t.feet = rng.normal([0, 0, -0.5], [0.3, 0.2, 0.05], (4, 3))
    bench.t.target_wrench = rng.normal([0, 0, 250, 0, 0, 0], [50, 50, 50, 20, 20, 10])
    return bench, rng.normal(0, 0.03, 3)


@pytest.mark.parametrize("stance", [(1, 0, 0, 1), (0, 1, 1, 0), (1, 1, 1, 1), (1, 0, 1, 1), (0, 0, 1, 0)])
def test_problem_is_the_papers(stance: tuple[int, ...]) -> None:
    """Q and c against the wrench map A and the weights H, P, written out with matrices."""
    rng = np.random.default_rng(0)
    bench, com = random_bench(rng, stance)
    buffer, gradient = np.full(144, np.nan), np.full(12, np.nan)
    legs = build_qp(bench.p, bench.t, com, buffer, gradient)
    assert legs == sum(stance)
    n = 3 * legs
    arms = bench.t.feet[np.array(stance, bool)] - com
    wrench_map = np.vstack([np.tile(np.eye(3), legs), np.hstack([cross(arm) for arm in arms])])
    weight = np.diag(bench.config.grf.wrench_weight)
    quadratic = 2 * (wrench_map.T @ weight @ wrench_map + bench.config.grf.force_weight * np.eye(n))
    np.testing.assert_allclose(buffer[: n * n].reshape(n, n), quadratic, rtol=1e-13, atol=1e-12)
    np.testing.assert_allclose(gradient[:n], -2 * wrench_map.T @ weight @ bench.t.target_wrench, rtol=1e-13, atol=1e-10)


def test_no_stance_leg_is_no_problem_at_all() -> None:
    bench, com = random_bench(np.random.default_rng(1), (0, 0, 0, 0))
    assert build_qp(bench.p, bench.t, com, np.empty(144), np.empty(12)) == 0


@pytest.mark.parametrize("poison", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("where", ["target_wrench", "feet", "com"])
def test_a_number_that_is_not_finite_is_told(poison: float, where: str) -> None:
    bench, com = random_bench(np.random.default_rng(2), (1, 0, 0, 1))
    if where == "com":
        com[1] = poison
    elif where == "feet":
        bench.t.feet[3, 2] = poison
    else:
        bench.t.target_wrench[5] = poison
    assert build_qp(bench.p, bench.t, com, np.empty(144), np.empty(12)) == -1


def test_a_swing_legs_bad_number_does_not_touch_the_others() -> None:
    bench, com = random_bench(np.random.default_rng(2), (1, 0, 0, 1))
    bench.t.feet[1] = np.nan
    assert build_qp(bench.p, bench.t, com, np.empty(144), np.empty(12)) == 2


def test_target_is_gravity_the_policys_wrench_and_the_centripetal_force() -> None:
    bench = Workbench()
    bench.t.action[12:] = [1, 2, 3, 4, 5, 6]
    bench.t.velocity_command = [0.5, -0.2, 0.8]
    bench.chosen.centripetal = 0.5
    aim_wrench(bench.p, bench.chosen, bench.t)
    mass = bench.p.mass
    centripetal = 0.5 * mass * np.cross([0, 0, 0.8], [0.5, -0.2, 0])
    expected = np.array([1, 2, 3 + mass * 9.81, 4, 5, 6])
    expected[:3] += centripetal
    np.testing.assert_allclose(bench.t.target_wrench, expected, rtol=1e-12)


def test_pyramid_and_bounds_hold_exactly_the_forces_of_the_method() -> None:
    rows = pyramid(2, 0.5)
    lower, upper = force_bounds(2, 0.5, 5.0, 100.0)

    def allowed(force: list[float]) -> bool:
        f = np.array(force)
        return bool((rows @ f <= 1e-12).all() and (f >= lower).all() and (f <= upper).all())

    assert allowed([5, -5, 10, 0, 0, 100])
    for wrong in (
        [5.1, 0, 10, 0, 0, 50],
        [0, -5.1, 10, 0, 0, 50],
        [0, 0, 10, 0, 26, 50],
        [0, 0, 4.9, 0, 0, 50],
        [0, 0, 10, 0, 0, 100.1],
    ):
        assert not allowed(wrong), wrong


def test_exact_forces_are_accepted() -> None:
    refused = [case.kind for case, force in zip(CASES, EXACT, strict=True) if not accept(*case.problem, force)]
    assert refused == []


@given(index=st.integers(0, len(CASES) - 1), size=st.floats(-5, 2), seed=st.integers(0, 2**32 - 1))
def test_nothing_further_than_a_micronewton_from_the_minimum_is_accepted(index: int, size: float, seed: int) -> None:
    error = np.random.default_rng(seed).normal(size=len(EXACT[index]))
    error *= 10.0**size / np.abs(error).max()
    assert not accept(*CASES[index].problem, EXACT[index] + error)


@given(index=st.integers(0, len(CASES) - 1), size=st.floats(-5, 2), seed=st.integers(0, 2**32 - 1))
def test_feasible_but_not_optimal_is_refused(index: int, size: float, seed: int) -> None:
    problem, best = CASES[index].problem, EXACT[index].reshape(-1, 3)
    force = best + 10.0**size * np.random.default_rng(seed).normal(size=best.shape)
    force[:, 2] = np.clip(force[:, 2], problem.min_force, problem.max_force)
    side = problem.friction * force[:, 2:]
    force[:, :2] = np.clip(force[:, :2], -side, side)
    assert np.abs(force - best).max() <= 1e-6 or not accept(*problem, force.ravel())


@given(
    index=st.integers(0, len(CASES) - 1),
    poison=st.sampled_from([np.nan, np.inf, -np.inf]),
    place=st.integers(0, 11),
    part=st.sampled_from(["force", "gradient", "hessian"]),
)
def test_what_is_not_finite_is_refused(index: int, poison: float, place: int, part: str) -> None:
    problem, force = CASES[index].problem, EXACT[index].copy()
    hessian, gradient = problem.hessian.copy(), problem.gradient.copy()
    place %= len(force)
    if part == "force":
        force[place] = poison
    elif part == "gradient":
        gradient[place] = np.nan
    else:
        hessian[place, 0] = hessian[0, place] = np.nan
    assert not accept(hessian, gradient, *problem[2:], force)


def test_zero_of_another_problem_and_a_gain_of_the_answer_are_refused() -> None:
    for case, force in zip(CASES, EXACT, strict=True):
        if np.abs(force).max() > 1.0:
            assert not accept(*case.problem, 1.001 * force)
            assert not accept(*case.problem, 0.0 * force)


def test_error_of_an_accepted_force_is_bounded_by_the_slope_left_over() -> None:
    """The comment's claim: a force with residual r is the minimum for the gradient c - r, so it errs by |r| / 2 P."""
    rng = np.random.default_rng(5)
    for case, force in zip(CASES[:100], EXACT, strict=False):
        residual = rng.normal(size=len(force))
        residual *= 1e-3 / np.linalg.norm(residual)
        other = exact_forces(case.problem._replace(gradient=case.problem.gradient - residual))
        least = np.linalg.eigvalsh(case.problem.hessian)[0]
        assert np.linalg.norm(other - force) <= 1.001 * 1e-3 / least


def test_clipped_least_squares_is_feasible_and_right_where_nothing_binds() -> None:
    free = 0
    for case, best in zip(CASES, EXACT, strict=True):
        problem = case.problem
        force = clipped_least_squares(*problem)
        rows = pyramid(case.legs, problem.friction)
        lower, upper = force_bounds(case.legs, problem.friction, problem.min_force, problem.max_force)
        assert (rows @ force <= 1e-9).all()
        assert (force >= lower - 1e-9).all() and (force <= upper + 1e-9).all()
        if np.abs(problem.hessian @ best + problem.gradient).max() < 1e-9:
            free += 1
            np.testing.assert_allclose(force, best, atol=1e-6)
    assert free > 10


def test_clipped_least_squares_of_a_singular_problem_says_so() -> None:
    problem = GrfProblem(np.zeros((6, 6)), np.ones(6), 0.6, 5.0, 400.0)
    with pytest.raises(np.linalg.LinAlgError):
        clipped_least_squares(*problem)


def test_forces_go_to_the_stance_legs_in_order() -> None:
    bench = Workbench()
    bench.t.stance = (0, 1, 1, 0)
    bench.t.grf = np.full((4, 3), 9.0)
    share_forces(bench.p, bench.t, np.array([1.0, 2.0, 100.0, -1.0, -2.0, 90.0]))
    np.testing.assert_array_equal(bench.t.grf, [[0, 0, 0], [1, 2, 100], [-1, -2, 90], [0, 0, 0]])
    assert not bench.t.clamps & Clamp.FRICTION


@pytest.mark.parametrize("force", [[60.0, 0, 100], [0, -60.0, 100], [0, 0, 400]])
def test_a_force_at_its_bound_is_noted(force: list[float]) -> None:
    bench = Workbench()
    bench.t.stance = (0, 0, 0, 1)
    share_forces(bench.p, bench.t, np.array(force))
    assert bench.t.clamps & Clamp.FRICTION


def test_direct_forces_add_a_share_of_gravity_and_are_cut_into_the_pyramid() -> None:
    bench = Workbench()
    bench.t.stance = (1, 0, 0, 1)
    bench.t.grf = [[10.0, -5, 20], [7, 7, 7], [7, 7, 7], [500, -500, 1000]]
    cut_forces(bench.p, bench.t)
    weight = bench.p.mass * 9.81
    np.testing.assert_allclose(bench.t.grf[0], [10, -5, 20 + weight / 2])
    assert not bench.t.grf[1:3].any()
    np.testing.assert_allclose(bench.t.grf[3], [0.6 * 400, -0.6 * 400, 400])
