from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from drivers.robot import Array
from training import pgpe
from training.pgpe import Params, State


def test_centred_ranks_by_hand() -> None:
    np.testing.assert_allclose(pgpe.centred_ranks(np.array([30.0, -1.0, 7.0])), [0.5, -0.5, 0.0])
    np.testing.assert_allclose(pgpe.centred_ranks(np.array([2.0, 2.0, 2.0])), [0.0, 0.0, 0.0])
    np.testing.assert_allclose(pgpe.centred_ranks(np.array([1.0, 5.0, 5.0, 9.0])), [-0.5, 0.0, 0.0, 0.5])


def test_nan_fitness_ranks_lowest() -> None:
    ranks = pgpe.centred_ranks(np.array([-1e9, np.nan, 3.0]))
    np.testing.assert_allclose(ranks, [0.0, -0.5, 0.5])


@given(arrays(np.float64, st.integers(2, 40), elements=st.floats(-1e6, 1e6)))
def test_ranks_are_centred_bounded_and_order_preserving(fitness: Array) -> None:
    ranks = pgpe.centred_ranks(fitness)
    assert abs(ranks.sum()) < 1e-9
    assert ranks.min() >= -0.5 and ranks.max() <= 0.5
    order = np.argsort(fitness)
    assert (np.diff(ranks[order]) >= 0).all()


def test_gradients_by_hand() -> None:
    state = pgpe.start(np.array([1.0, 0.0]), 1.0)
    population = np.array([[3.0, 0.0], [-1.0, 0.0], [1.0, 1.0], [1.0, -1.0]])
    utilities = np.array([0.5, -0.5, 0.25, -0.25])
    mean, stdev = pgpe.estimate_gradients(population, utilities, state)
    # ((0.5 + 0.5)/2 * [2, 0] + (0.25 + 0.25)/2 * [0, 1]) / 2; every pair's level equals the baseline
    np.testing.assert_allclose(mean, [0.5, 0.125])
    np.testing.assert_allclose(stdev, [0.0, 0.0])
    mean, stdev = pgpe.estimate_gradients(population, np.array([0.5, 0.5, -0.5, -0.5]), state)
    # (0.5 * [(4 - 1)/1, (0 - 1)/1] - 0.5 * [(0 - 1)/1, (1 - 1)/1]) / 2
    np.testing.assert_allclose(mean, [0.0, 0.0])
    np.testing.assert_allclose(stdev, [1.0, -0.25])


def test_first_adam_step_is_the_learning_rate_along_the_gradients_sign() -> None:
    params = Params(directions=2, learning_rate=0.05, learning_rate_end=0.05)
    state = pgpe.start(np.zeros(2), 1.0)
    population = np.array([[2.0, -1.0], [-2.0, 1.0], [1.0, -3.0], [-1.0, 3.0]])
    after = pgpe.tell(state, params, population, np.array([0.5, -0.5, 1 / 6, -1 / 6]))
    np.testing.assert_allclose(after.mean, [0.05, -0.05], rtol=1e-6)


def test_second_adam_step_by_hand() -> None:
    params = Params(directions=1, learning_rate=0.1, learning_rate_end=0.1, stdev_learning_rate=0.0)
    state = pgpe.start(np.zeros(1), 1.0)
    gradients = [1.0, -0.5]
    moments = [0.1, 0.9 * 0.1 + 0.1 * -0.5]
    squares = [0.001, 0.999 * 0.001 + 0.001 * 0.25]
    expected = 0.0
    for step, gradient in enumerate(gradients):
        state = pgpe.tell(state, params, state.mean + np.array([[1.0], [-1.0]]), np.array([gradient, -gradient]))
        unbiased = moments[step] / (1 - 0.9 ** (step + 1))
        expected += 0.1 * unbiased / (np.sqrt(squares[step] / (1 - 0.999 ** (step + 1))) + 1e-8)
        np.testing.assert_allclose(state.mean, [expected], rtol=1e-9)


@given(st.integers(0, 2**32 - 1), st.floats(0.1, 1e4))
def test_stdev_changes_by_at_most_a_fifth(seed: int, stdev_learning_rate: float) -> None:
    rng = np.random.default_rng(seed)
    params = Params(directions=3, stdev_learning_rate=stdev_learning_rate)
    state = pgpe.start(rng.standard_normal(4), 0.3)
    after = pgpe.tell(state, params, pgpe.ask(state, params, rng), pgpe.centred_ranks(rng.standard_normal(6)))
    assert (np.abs(after.stdev / state.stdev - 1) <= 0.2 + 1e-12).all()
    assert (after.stdev > 0).all()


def test_population_is_mirrored_about_the_mean() -> None:
    state = pgpe.start(np.arange(5.0), 0.2)
    population = pgpe.ask(state, Params(directions=4), np.random.default_rng(1))
    np.testing.assert_allclose((population[0::2] + population[1::2]) / 2, np.tile(state.mean, (4, 1)), atol=1e-12)
    assert population[0::2].std(axis=0).min() > 0


def climb(function: object, target_start: Array, iterations: int, stdev: float) -> State:
    assert callable(function)
    params = Params(directions=32, learning_rate=0.1, learning_rate_end=0.005, learning_rate_steps=iterations)
    rng = np.random.default_rng(3)
    state = pgpe.start(target_start, stdev)
    for _ in range(iterations):
        population = pgpe.ask(state, params, rng)
        fitness = np.array([function(member) for member in population])
        state = pgpe.tell(state, params, population, pgpe.centred_ranks(fitness))
    return state


def sphere(x: Array) -> float:
    return -float(((x - 1.5) ** 2).sum())


def rosenbrock(x: Array) -> float:
    return -float((100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2).sum())


def rastrigin(x: Array) -> float:
    return -float((x**2 - 10 * np.cos(2 * np.pi * x) + 10).sum())


def test_weight_decay_forgets_what_no_return_asks_for_and_keeps_what_one_does() -> None:
    params = Params(directions=32, learning_rate=0.02, learning_rate_end=0.02, weight_decay=1.0)
    rng, state = np.random.default_rng(5), pgpe.start(np.array([2.0, 2.0]), 0.05)
    for _ in range(150):
        population = pgpe.ask(state, params, rng)
        fitness = -np.abs(population[:, 0] - 0.7)
        state = pgpe.tell(state, params, population, pgpe.centred_ranks(fitness))
    assert abs(state.mean[0] - 0.7) < 0.1
    assert abs(state.mean[1]) < 0.5


def test_climbs_the_sphere() -> None:
    state = climb(sphere, np.zeros(20), 150, 0.3)
    assert sphere(state.mean) > -0.05


def test_climbs_rosenbrocks_valley() -> None:
    state = climb(rosenbrock, np.full(2, -1.0), 400, 0.2)
    assert rosenbrock(state.mean) > -0.05


def test_climbs_out_of_rastrigins_pits() -> None:
    start = np.full(3, 2.8)
    state = climb(rastrigin, start, 300, 1.5)
    assert rastrigin(state.mean) > -4.0 > rastrigin(start)


def test_paired_ranks_ignore_how_hard_a_pairs_scenario_is() -> None:
    easy_and_hard = np.array([1000.0, 999.0, 3.0, 1.0])
    utilities = pgpe.paired_ranks(easy_and_hard, np.zeros(4), 2.5)
    assert utilities[2] - utilities[3] > utilities[0] - utilities[1] >= 0


def test_a_fall_outweighs_a_rank() -> None:
    fitness = np.array([10.0, 1.0, 2.0, 1.0])
    falls = np.array([1.0, 0.0, 0.0, 0.0])
    utilities = pgpe.paired_ranks(fitness, falls, 2.5)
    assert utilities[0] < utilities[1]
    assert utilities[2] > utilities[3]


@pytest.mark.parametrize("fitness", [np.full(4, np.nan), np.array([1.0, np.nan, 2.0, 3.0])])
def test_paired_ranks_survive_nan(fitness: Array) -> None:
    utilities = pgpe.paired_ranks(fitness, np.zeros(4), 2.5)
    assert np.isfinite(utilities).all()
    assert not np.isnan(fitness[0]) or utilities[0] == 0.0 or utilities[0] < 0.0
    if not np.isnan(fitness[0]):
        assert utilities[1] <= utilities[0]
