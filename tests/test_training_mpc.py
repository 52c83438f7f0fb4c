from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.robot import Array
from training import mpc
from training.mpc import HORIZON, Horizon, MpcConfig, MpcError
from training.rigid_body import GRAVITY, STATES, RigidBody, advance

BODY = RigidBody(mass=25.0, inertia=np.diag([0.7, 1.4, 1.7]), com=np.zeros(3))
CONFIG = MpcConfig()
FEET = np.array([[0.27, 0.22, 0.0], [0.27, -0.22, 0.0], [-0.27, 0.22, 0.0], [-0.27, -0.22, 0.0]])
HEIGHT = 0.55
seeds = st.integers(0, 2**32 - 1)


def trot_stance() -> np.ndarray:
    first = np.array([True, False, False, True])
    return np.array([first if k // 5 % 2 == 0 else ~first for k in range(HORIZON)])


def horizon(rng: np.random.Generator, stance: np.ndarray | None = None) -> Horizon:
    state = np.zeros(STATES)
    state[2] = HEIGHT
    state += rng.normal(0, 0.05, STATES)
    reference = np.zeros((HORIZON, STATES))
    reference[:, 2] = HEIGHT
    reference[:, 0] = 0.4 * CONFIG.dt * np.arange(1, HORIZON + 1)
    reference[:, 3] = 0.4
    reference[:, 8] = rng.uniform(-1, 1)
    state[8] += reference[0, 8]
    feet = np.tile(FEET, (HORIZON, 1, 1)) + rng.normal(0, 0.02, (HORIZON, 4, 3))
    expected = state[:3] + reference[:, 3:6] * CONFIG.dt * np.arange(HORIZON)[:, None]
    return Horizon(state, reference, expected, feet, trot_stance() if stance is None else stance)


def test_the_sparse_form_has_the_papers_144_variables() -> None:
    problem = mpc.build_sparse(horizon(np.random.default_rng(0)), BODY, CONFIG)
    assert problem.gradient.shape == (144,)
    assert mpc.build_condensed(horizon(np.random.default_rng(0)), BODY, CONFIG).gradient.shape == (36,)


@settings(max_examples=25, deadline=None)
@given(seeds)
def test_sparse_and_condensed_forms_have_one_solution(seed: int) -> None:
    rng = np.random.default_rng(seed)
    stance = rng.random((HORIZON, 4)) < 0.6
    stance[:, 0] |= ~stance.any(axis=1)
    asked = horizon(rng, stance)
    condensed = mpc.condensed_forces(mpc.solve_problem(mpc.build_condensed(asked, BODY, CONFIG)), stance)
    sparse = mpc.sparse_forces(mpc.solve_problem(mpc.build_sparse(asked, BODY, CONFIG), "proxqp"))
    np.testing.assert_allclose(condensed, sparse, atol=2e-3)


@settings(max_examples=25, deadline=None)
@given(seeds)
def test_both_forms_cost_the_same_whatever_the_forces(seed: int) -> None:
    rng = np.random.default_rng(seed)
    asked = horizon(rng)
    sparse, condensed = mpc.build_sparse(asked, BODY, CONFIG), mpc.build_condensed(asked, BODY, CONFIG)

    def gap(forces: Array) -> float:
        variables = np.concatenate([roll_out(asked, forces).ravel(), forces.ravel()])
        stacked = forces[asked.stance].ravel()
        np.testing.assert_allclose((sparse.rows @ variables)[:72], sparse.upper[144 : 144 + 72], atol=1e-9)
        return cost(sparse, variables) - cost(condensed, stacked)

    first, second = (np.where(asked.stance[:, :, None], rng.normal(0, 100, (HORIZON, 4, 3)), 0.0) for _ in range(2))
    assert gap(first) == pytest.approx(gap(second), rel=1e-9, abs=1e-6)


def cost(problem: mpc.Problem, x: Array) -> float:
    return float(0.5 * x @ problem.hessian @ x + problem.gradient @ x)


def roll_out(asked: Horizon, forces: Array) -> Array:
    """The model's own words, a step at a time: an oracle that shares only A_k and B_k's definition."""
    states, x = [], asked.state.copy()
    for k in range(HORIZON):
        yaw = asked.reference[k, 8] if k else asked.state[8]
        column = x.reshape(-1, 1).copy()
        mpc.drift(column, yaw, CONFIG.dt)
        x = column[:, 0] + mpc.input_matrix(
            asked.feet[k], asked.expected[k], yaw, BODY.mass, BODY.inertia, CONFIG.dt
        ) @ (forces[k].ravel())
        x[2] -= 0.5 * CONFIG.dt**2 * GRAVITY
        x[5] -= CONFIG.dt * GRAVITY
        states.append(x)
    return np.array(states)


@settings(max_examples=25, deadline=None)
@given(seeds)
def test_forces_stay_inside_the_pyramid_and_legs_in_the_air_carry_nothing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    asked = horizon(rng)
    asked.state[3:6] += rng.normal(0, 1.0, 3)
    forces = mpc.solve_mpc(asked, BODY, CONFIG)
    assert (forces[~asked.stance] == 0).all()
    carried = forces[asked.stance]
    assert (carried[:, 2] >= CONFIG.min_force - 1e-6).all() and (carried[:, 2] <= CONFIG.max_force + 1e-6).all()
    assert (np.abs(carried[:, :2]) <= CONFIG.friction * carried[:, 2:] + 1e-6).all()


def test_no_feasible_neighbour_is_cheaper() -> None:
    rng = np.random.default_rng(4)
    problem = mpc.build_condensed(horizon(rng), BODY, CONFIG)
    best = mpc.solve_problem(problem)
    compared = 0
    for _ in range(300):
        other = best + rng.normal(0, 1.0, best.size)
        stacked = np.concatenate([other, problem.rows @ other])
        if (stacked >= problem.lower).all() and (stacked <= problem.upper).all():
            compared += 1
            assert cost(problem, other) >= cost(problem, best)
    assert compared > 10


def test_linear_model_is_the_derivative_of_the_rigid_body() -> None:
    dt, step = 1e-4, 1e-3
    state = np.zeros(STATES)
    state[2], state[8] = HEIGHT, 0.7
    forces = np.zeros((4, 3))
    forces[:, 2] = 25.0 * GRAVITY / 4
    b = mpc.input_matrix(FEET, state[:3], 0.7, BODY.mass, BODY.inertia, dt)
    for variable in range(12):
        ahead, behind = (state.copy(), state.copy())
        push = np.zeros(12)
        push[variable] = step
        advance(ahead, forces + push.reshape(4, 3), FEET, BODY.mass, BODY.inertia, dt)
        advance(behind, forces - push.reshape(4, 3), FEET, BODY.mass, BODY.inertia, dt)
        np.testing.assert_allclose((ahead - behind) / (2 * step), b[:, variable], atol=1e-9)


def test_the_rigid_body_keeps_angular_momentum_when_it_flies() -> None:
    state = np.zeros(STATES)
    state[6:9] = [0.1, -0.2, 0.3]
    state[9:] = [1.0, 2.0, -1.5]

    def momentum() -> Array:
        from training.rigid_body import rotation_from_rpy

        rotation = np.empty((3, 3))
        rotation_from_rpy(state[6:9], rotation)
        return np.asarray(rotation @ BODY.inertia @ rotation.T @ state[9:])

    before = momentum()
    for _ in range(2000):
        advance(state, np.zeros((4, 3)), FEET, BODY.mass, BODY.inertia, 1e-4)
    np.testing.assert_allclose(momentum(), before, rtol=1e-3)
    assert state[5] == pytest.approx(-GRAVITY * 0.2)


def test_standing_still_needs_the_weight() -> None:
    state = np.zeros(STATES)
    state[2] = HEIGHT
    everywhere = np.ones((HORIZON, 4), dtype=bool)
    asked = Horizon(
        state,
        np.tile(state, (HORIZON, 1)),
        np.tile(state[:3], (HORIZON, 1)),
        np.tile(FEET, (HORIZON, 1, 1)),
        everywhere,
    )
    forces = mpc.solve_mpc(asked, BODY, CONFIG)
    assert forces[0, :, 2].sum() == pytest.approx(25.0 * GRAVITY, rel=0.05)
    np.testing.assert_allclose(forces[0, :, :2], 0.0, atol=0.5)


def test_nothing_on_the_ground_is_nothing_to_solve() -> None:
    asked = horizon(np.random.default_rng(0), np.zeros((HORIZON, 4), dtype=bool))
    assert (mpc.solve_mpc(asked, BODY, CONFIG) == 0).all()


def test_a_number_that_is_not_finite_is_refused_before_the_solver() -> None:
    asked = horizon(np.random.default_rng(0))
    asked.state[4] = np.nan
    with pytest.raises(MpcError, match="not finite"):
        mpc.solve_mpc(asked, BODY, CONFIG)


def test_an_infeasible_problem_is_an_error() -> None:
    problem = mpc.build_condensed(horizon(np.random.default_rng(0)), BODY, CONFIG)
    problem.lower[2], problem.upper[2] = 10.0, -10.0
    with pytest.raises(MpcError, match="daqp"):
        mpc.solve_problem(problem)
