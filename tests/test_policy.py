"""The policy's arithmetic: matrix, network, direct forces, low-pass, bounds and fixed terms; and the hand-built one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scenes import ROBOTS, Workbench, policy, robot, variant

from runtime.control.observation import OBSERVATION_NAMES
from runtime.control.policy import (
    GRF_NAMES,
    SHIFT_NAMES,
    WRENCH_NAMES,
    Policy,
    Terms,
    act,
    balance_policy,
    encode_policy,
    policy_record,
    set_parameters,
)
from runtime.control.records import Clamp
from runtime.policies import decode, find_policy, load, verify

RNG = np.random.default_rng(0)
MATRIX = RNG.normal(size=(18, 28))
OBSERVATION = RNG.normal(size=28)
SCALE = RNG.uniform(0.1, 1.0, 18)


def rows(array: np.ndarray) -> tuple[tuple[float, ...], ...]:
    return tuple(map(tuple, array.tolist()))


def linear(**changes: Any) -> Policy:
    base: dict[str, Any] = {
        "matrix": rows(MATRIX),
        "action_scale": tuple(SCALE.tolist()),
        "action_bound": (1e6,) * 18,
        "terms": Terms(),
        "shift_time_constant": 0.0,
    }
    return variant(policy(), **{**base, **changes})


WIDE = {"shift": 1e6, "force": [1e6] * 3, "moment": [1e6] * 3}


def play(chosen: Policy, observation: np.ndarray = OBSERVATION, bounds: dict[str, Any] | None = None) -> Workbench:
    bench = Workbench(chosen=chosen, bounds=bounds or WIDE)
    bench.t.observation = observation
    act(bench.p, bench.chosen, bench.chosen, bench.s, bench.t)
    return bench


def test_linear_policy_is_scale_times_matrix_times_observation() -> None:
    bench = play(linear())
    np.testing.assert_allclose(bench.t.asked, SCALE * (MATRIX @ OBSERVATION), rtol=1e-12)
    np.testing.assert_allclose(bench.t.action, bench.t.asked, rtol=1e-12)
    assert bench.t.clamps == 0


@pytest.mark.parametrize("hidden", [1, 5, 32])
def test_network_is_readout_of_tanh_of_hidden(hidden: int) -> None:
    first, second = RNG.normal(size=(hidden, 28)), RNG.normal(size=(18, hidden))
    bench = play(linear(matrix=(), hidden=rows(first), readout=rows(second)))
    np.testing.assert_allclose(bench.t.asked, SCALE * (second @ np.tanh(first @ OBSERVATION)), rtol=1e-12)


def test_direct_policy_fills_forces_and_leaves_the_wrench_alone() -> None:
    matrix = RNG.normal(size=(24, 28))
    chosen = linear(
        output="grf",
        action_names=SHIFT_NAMES + GRF_NAMES,
        matrix=rows(matrix),
        action_scale=(1.0,) * 24,
        action_bound=(1e6,) * 12 + (3.0,) * 12,
    )
    bench = play(chosen)
    np.testing.assert_allclose(bench.t.asked[:12], matrix[:12] @ OBSERVATION, rtol=1e-12)
    np.testing.assert_allclose(bench.t.grf.ravel(), np.clip(matrix[12:] @ OBSERVATION, -3, 3), rtol=1e-12)
    assert not bench.t.action[12:].any()
    assert bench.t.clamps & Clamp.WRENCH


@pytest.mark.parametrize("tighter", ["policy", "robot"])
def test_the_tighter_bound_of_policy_and_robot_holds(tighter: str) -> None:
    if tighter == "policy":
        bench = play(linear(action_bound=(0.05,) * 12 + (2.0,) * 6))
    else:
        bench = play(linear(), bounds={"shift": 0.05, "force": [2.0] * 3, "moment": [2.0] * 3})
    asked = SCALE * (MATRIX @ OBSERVATION)
    np.testing.assert_allclose(bench.t.action[:12], np.clip(asked[:12], -0.05, 0.05))
    np.testing.assert_allclose(bench.t.action[12:], np.clip(asked[12:], -2.0, 2.0))
    np.testing.assert_allclose(bench.t.asked, asked, rtol=1e-12)
    assert bench.t.clamps == Clamp.SHIFT | Clamp.WRENCH


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("place", [0, 5, 12, 17])
def test_what_is_asked_and_is_no_number_is_told_and_never_bounded_into_one(value: float, place: int) -> None:
    bench = Workbench(chosen=linear(), bounds=WIDE)
    bench.t.observation = OBSERVATION
    assert act(bench.p, bench.chosen, bench.chosen, bench.s, bench.t)
    before = bench.t.action.copy()
    bench.chosen["matrix"][3, place] = value
    assert not act(bench.p, bench.chosen, bench.chosen, bench.s, bench.t)
    np.testing.assert_array_equal(bench.t.action, before)


def test_shifts_follow_with_their_time_constant_and_do_not_wind_up() -> None:
    chosen = linear(shift_time_constant=0.05)
    bench = Workbench(chosen=chosen, bounds={**WIDE, "shift": 0.5})
    bench.t.observation = OBSERVATION
    dt, wanted = float(bench.p.dt), SCALE[:12] * (MATRIX[:12] @ OBSERVATION)
    for tick in range(1, 200):
        act(bench.p, bench.chosen, bench.chosen, bench.s, bench.t)
        free = wanted * (1 - (0.05 / (0.05 + dt)) ** tick)
        within = np.abs(wanted) < 0.5
        np.testing.assert_allclose(bench.t.action[:12][within], free[within], rtol=1e-9)
    assert np.abs(bench.t.action[:12]).max() == 0.5
    bench.t.observation = -OBSERVATION
    act(bench.p, bench.chosen, bench.chosen, bench.s, bench.t)
    assert (np.abs(bench.t.action[:12]) < 0.5).all(), "leaves its bound at once"


def test_capture_point_moves_every_touchdown_by_the_velocity_error() -> None:
    bench = Workbench(chosen=linear(matrix=rows(np.zeros((18, 28))), terms=Terms(capture_point=0.13)), bounds=WIDE)
    bench.t.twist, bench.t.velocity_command = (0.5, -0.2, 0, 0, 0, 0), (0.3, 0.1, 0.7)
    act(bench.p, bench.chosen, bench.chosen, bench.s, bench.t)
    expected = np.tile([0.13 * 0.2, 0.13 * -0.3, 0.0], 4)
    np.testing.assert_allclose(bench.t.action[:12], expected, atol=1e-15)
    assert not bench.t.action[12:].any()


def test_a_networks_leftovers_do_not_reach_the_next_policy() -> None:
    first = linear(matrix=(), hidden=rows(RNG.normal(size=(3, 28))), readout=rows(RNG.normal(size=(18, 3))))
    bench = Workbench(chosen=first, bounds=WIDE)
    bench.policies[:] = policy_record(linear())
    bench.t.observation = OBSERVATION
    act(bench.p, bench.chosen, bench.chosen, bench.s, bench.t)
    np.testing.assert_allclose(bench.t.asked, SCALE * (MATRIX @ OBSERVATION), rtol=1e-12)


@pytest.mark.parametrize("kind", ["linear", "network"])
def test_parameters_go_out_and_come_back(kind: str) -> None:
    layers = {"hidden": rows(RNG.normal(size=(4, 28))), "readout": rows(RNG.normal(size=(18, 4)))}
    chosen = linear() if kind == "linear" else linear(matrix=(), **layers)
    assert len(chosen.parameters) == (504 if kind == "linear" else 4 * 28 + 18 * 4)
    record = policy_record(chosen)
    again = record.copy()
    set_parameters(again, chosen, chosen.parameters)
    assert (record == again).all()


@pytest.mark.parametrize("name", ROBOTS)
def test_hand_built_policy_pushes_against_every_error(name: str) -> None:
    known = robot(name)
    chosen = balance_policy(known.robot, known.control.gait.walking_height)
    verify(chosen, known.robot.name, "balance")
    gain = np.array(chosen.matrix)
    assert not gain[:12].any()
    for action, watched in (
        ("force_x", "velocity_x"),
        ("force_y", "velocity_y"),
        ("force_z", "velocity_z"),
        ("force_z", "height"),
        ("moment_x", "roll"),
        ("moment_y", "pitch"),
        ("moment_z", "yaw"),
        ("moment_x", "rate_x"),
        ("moment_y", "rate_y"),
        ("moment_z", "rate_z"),
    ):
        assert gain[12 + WRENCH_NAMES.index(action), OBSERVATION_NAMES.index(watched)] < 0


@pytest.mark.parametrize("name", ROBOTS)
def test_a_hand_built_policy_is_shipped_for_every_robot(name: str) -> None:
    known = robot(name)
    built = balance_policy(known.robot, known.control.gait.walking_height)
    assert load(find_policy(built.name), known.robot.name) == built


def test_stoch3_walks_by_a_policy_that_says_how_it_was_trained() -> None:
    provenance = policy("stoch3").provenance
    assert provenance["made"] == "trotd train"
    assert {"run", "iteration", "versions", "validation"} <= set(provenance)


def test_file_form_reads_back_the_same_and_has_one_line_a_row() -> None:
    data = encode_policy(linear())
    assert decode(data, "stoch3", "x") == linear()
    lines = data.decode().splitlines()
    assert sum(line.strip().startswith("[") and line.count(",") >= 27 for line in lines) == 18
