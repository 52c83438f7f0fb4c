"""Policy gradients with parameter-based exploration (Sehnke et al. 2010), as the paper changed it (Section IV.B).

Mirrored sampling, fitness ranked linearly in [-0.5, 0.5], Adam on the mean, stdev changed by at most 20 % an iteration.
``ask`` and ``tell`` are pure: ``State`` is what an iteration changes, ``Params`` what it never does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drivers.robot import Array


@dataclass(frozen=True, slots=True)
class Params:
    """What stays the same over a run."""

    directions: int = 64
    """Explored both ways: twice as many episodes an iteration."""
    learning_rate: float = 0.05
    """Adam's step on the mean."""
    learning_rate_end: float = 0.05
    """Its value at the end of the run, reached linearly in ``learning_rate_steps``."""
    learning_rate_steps: int = 1
    stdev_learning_rate: float = 0.1
    """0 keeps the stdev as it is."""
    stdev_max_change: float = 0.2
    """Share of itself by which a stdev may change in an iteration."""
    weight_decay: float = 0.0
    """Share of itself that the mean loses in an iteration, times the learning rate: what no return asks for fades."""
    adam_mean_decay: float = 0.9
    adam_square_decay: float = 0.999
    adam_epsilon: float = 1e-8


@dataclass(frozen=True, slots=True)
class State:
    """What an iteration changes. All arrays of shape (n,)."""

    mean: Array
    stdev: Array
    gradient_mean: Array
    """Adam's first moment."""
    gradient_square: Array
    """Adam's second moment."""
    iteration: int


def start(mean: Array, stdev: float) -> State:
    """The state before the first iteration; ``stdev`` the same in every coordinate."""
    zero = np.zeros_like(mean)
    return State(mean.copy(), np.full_like(mean, stdev), zero, zero, 0)


def ask(state: State, params: Params, rng: np.random.Generator) -> Array:
    """Sample a population around the mean. Shape (2 directions, n): row 2i is mean + d, row 2i + 1 is mean - d."""
    directions = rng.standard_normal((params.directions, state.mean.size)) * state.stdev
    population = np.empty((2 * params.directions, state.mean.size))
    population[0::2] = state.mean + directions
    population[1::2] = state.mean - directions
    return population


def centred_ranks(fitness: Array) -> Array:
    """Ranks spread linearly over [-0.5, 0.5]; equal fitnesses share their mean rank, NaN ranks lowest. Shape (m,)."""
    if fitness.size < 2:
        return np.zeros_like(fitness)
    values = np.where(np.isnan(fitness), -np.inf, fitness)
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(counts) - 1
    return np.asarray((last - (counts - 1) / 2)[inverse] / (fitness.size - 1) - 0.5)


def paired_ranks(fitness: Array, falls: Array, fall_weight: float) -> Array:
    """Utilities from each pair alone: sign(d) rank|d| plus falls, for a scenario of its own in every pair. Shape (m,).

    Ranks over the population would compare easy scenarios with hard ones. ``falls`` (m,) counts falls of each member;
    ranks alone under-weight rare ones, so a difference of one weighs ``fall_weight`` (2.5 by the prototype).
    """
    values = np.where(np.isnan(fitness), np.nanmin(fitness) if not np.isnan(fitness).all() else 0.0, fitness)
    difference = values[0::2] - values[1::2]
    count = len(difference)
    size = ((centred_ranks(np.abs(difference)) + 0.5) * (count - 1) + 1) / count
    utility = 0.5 * (np.sign(difference) * size + fall_weight * (falls[1::2] - falls[0::2]))
    paired = np.empty_like(fitness)
    paired[0::2] = utility
    paired[1::2] = -utility
    return paired


def estimate_gradients(population: Array, utilities: Array, state: State) -> tuple[Array, Array]:
    """Ascent directions of mean and stdev, both of shape (n,).

    mean: average of (u+ - u-)/2 d; stdev: average of ((u+ + u-)/2 - baseline) (d² - σ²)/σ (Sehnke et al., Eq. 13-14).
    """
    directions = population[0::2] - state.mean
    difference = (utilities[0::2] - utilities[1::2]) / 2
    level = (utilities[0::2] + utilities[1::2]) / 2 - utilities.mean()
    count = len(directions)
    return (
        difference @ directions / count,
        level @ ((directions**2 - state.stdev**2) / state.stdev) / count,
    )


def tell(state: State, params: Params, population: Array, utilities: Array) -> State:
    """Move mean and stdev by a population's utilities (``centred_ranks`` or ``paired_ranks`` of its fitness)."""
    mean_gradient, stdev_gradient = estimate_gradients(population, utilities, state)
    step = state.iteration + 1
    first = params.adam_mean_decay * state.gradient_mean + (1 - params.adam_mean_decay) * mean_gradient
    second = params.adam_square_decay * state.gradient_square + (1 - params.adam_square_decay) * mean_gradient**2
    unbiased_first = first / (1 - params.adam_mean_decay**step)
    unbiased_second = second / (1 - params.adam_square_decay**step)
    rate = _learning_rate(params, state.iteration)
    step_taken = unbiased_first / (np.sqrt(unbiased_second) + params.adam_epsilon)
    mean = state.mean + rate * (step_taken - params.weight_decay * state.mean)
    allowed = params.stdev_max_change * state.stdev
    change = np.clip(params.stdev_learning_rate * stdev_gradient, -allowed, allowed)
    return State(mean, state.stdev + change, first, second, step)


def _learning_rate(params: Params, iteration: int) -> float:
    done = min(iteration / max(params.learning_rate_steps, 1), 1.0)
    return params.learning_rate + done * (params.learning_rate_end - params.learning_rate)
