"""The whole step: what it holds in every tick, what a bad tick leaves behind, what a reset forgets, and its bits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import ROBOTS, control, controller, policy, robot, standing, variant

from drivers.robot import JointCommand, Measurement
from runtime.control import solvers
from runtime.control.controller import Controller, carry_out, sense, sense_and_plan
from runtime.control.grf import GrfProblem, accept, clipped_least_squares, well_posed
from runtime.control.policy import GRF_NAMES, SHIFT_NAMES
from runtime.control.records import CONTROL_DTYPE, SolverStatus, VelocityCommand
from runtime.control.state import STATE_DTYPE

FORWARD = VelocityCommand(0.0, np.array([0.4, 0.1]), 0.2)
STILL = VelocityCommand()


def noisy(seed: int, name: str = "stoch3") -> Measurement:
    """Standing, a little disturbed everywhere."""
    rng = np.random.default_rng(seed)
    rest = standing(name)
    joints = replace(
        rest.joints,
        position=rest.joints.position + rng.normal(0, 0.03, (4, 3)),
        velocity=rng.normal(0, 0.3, (4, 3)),
        torque=rest.joints.torque + rng.normal(0, 3, (4, 3)),
    )
    imu = replace(rest.imu, angular_velocity=rng.normal(0, 0.2, 3))
    return Measurement(0.0, imu, joints, 48.0)


WALK = [noisy(seed) for seed in range(60)]


def started(name: str = "stoch3", **changes: Any) -> Controller:
    known = controller(name, **changes)
    known.reset(standing(name))
    return known


def bits(command: JointCommand) -> bytes:
    return b"".join(
        np.ascontiguousarray(part).tobytes()
        for part in (command.position, command.velocity, command.kp, command.kd, command.torque)
    )


@pytest.mark.parametrize("name", ROBOTS)
def test_standing_still_bears_the_weight(name: str) -> None:
    known, rest = started(name), standing(name)
    for _ in range(300):
        known.step(rest, STILL, True)
    mass = robot(name).robot.mass
    np.testing.assert_allclose(known.record["grf"][0].sum(axis=0), [0, 0, mass * 9.81], atol=0.03 * mass * 9.81)
    assert known.record["contacts"].all() and known.record["stance"].all()
    np.testing.assert_allclose(known.record["twist"][0], 0.0, atol=1e-3)
    assert known.record["height"][0] == pytest.approx(robot(name).control.gait.walking_height, abs=1e-6)


def test_every_tick_of_a_walk_keeps_its_promises() -> None:
    known = started()
    limits, config = robot().robot.joints, known.parameters[0]
    for index in range(400):
        command = known.step(WALK[index % 60], FORWARD)
        t = known.record[0]
        assert t["solver_status"] in (SolverStatus.SOLVED, SolverStatus.IDLE)
        assert not t["grf"][t["stance"] == 0].any()
        f = t["grf"][t["stance"] == 1]
        assert (np.abs(f[:, :2]) <= config["friction"] * f[:, 2:] + 1e-6).all()
        assert ((f[:, 2] >= config["min_force"] - 1e-6) & (f[:, 2] <= config["max_force"] + 1e-6)).all()
        assert (command.position >= limits.lower).all() and (command.position <= limits.upper).all()
        assert np.abs(command.velocity).max() <= 15.0
        assert all(np.isfinite(t[name]).all() for name in CONTROL_DTYPE.names or ())


def test_the_record_holds_the_command() -> None:
    known = started()
    command = known.step(WALK[0], FORWARD)
    for part in ("position", "velocity", "kp", "kd", "torque"):
        np.testing.assert_array_equal(getattr(command, part), known.record[f"command_{part}"][0])
    kept = bits(command)
    known.step(WALK[1], FORWARD)
    assert bits(command) == kept, "a command is not changed by the next tick"


def test_results_go_into_the_memory_that_was_given() -> None:
    whole = np.zeros(CONTROL_DTYPE.itemsize + 64, np.uint8)
    record = whole[64:].view(CONTROL_DTYPE)
    known = Controller(robot().robot, control(), policy(), record)
    known.reset(standing())
    known.step(standing(), FORWARD)
    assert not whole[:64].any() and whole[64:].any()
    assert np.shares_memory(known.record, whole)


# --- bits -------------------------------------------------------------------------------------------------------------


def trace(known: Controller, count: int = 150) -> bytes:
    return b"".join(bits(known.step(WALK[i % 60], FORWARD)) + known.state.tobytes() for i in range(count))


def test_same_inputs_same_bits() -> None:
    assert trace(started()) == trace(started())


def test_after_a_reset_nothing_of_the_past_is_left() -> None:
    known = started()
    fresh = trace(known)
    known.reset(standing())
    assert trace(known) == fresh


def test_the_state_alone_carries_a_walk_on() -> None:
    """What a recording's keyframe holds: state copied into a new controller goes on with the same bits."""
    first, second = started(), started()
    trace(first, 77)
    second.state[:] = first.state
    assert trace(first) == trace(second)


def test_another_robots_controller_does_not_disturb() -> None:
    alone, known, other = trace(started(), 60), started(), started("a1")
    mixed = b""
    for i in range(60):
        mixed += bits(known.step(WALK[i], FORWARD)) + known.state.tobytes()
        other.step(noisy(i, "a1"), FORWARD)
    assert mixed == alone


# --- bad ticks --------------------------------------------------------------------------------------------------------

INPUTS: dict[str, tuple[str, str]] = {
    "orientation": ("imu", "orientation"),
    "rate": ("imu", "angular_velocity"),
    "acceleration": ("imu", "linear_acceleration"),
    "position": ("joints", "position"),
    "velocity": ("joints", "velocity"),
    "torque": ("joints", "torque"),
}


def spoilt(measured: Measurement, what: str, value: float, place: int = 1) -> Measurement:
    part, name = INPUTS[what]
    array = getattr(getattr(measured, part), name).copy()
    array.ravel()[place % array.size] = value
    return replace(measured, **{part: replace(getattr(measured, part), **{name: array})})


def assert_only_damps(known: Controller, command: JointCommand) -> None:
    assert known.record["solver_status"][0] == SolverStatus.FAILED
    for part in (command.position, command.velocity, command.kp, command.torque):
        assert not part.any()
    np.testing.assert_array_equal(command.kd, np.tile(control().gains.kd, (4, 1)))


@given(
    what=st.sampled_from(sorted(INPUTS)),
    value=st.sampled_from([np.nan, np.inf, -np.inf]),
    place=st.integers(0, 11),
    before=st.integers(0, 59),
)
def test_a_bad_measurement_never_moves_and_leaves_no_trace(what: str, value: float, place: int, before: int) -> None:
    """The tick after it is bit for bit the tick that would have been without it, or a healthy one where it was used."""
    known, other = started(), started()
    for measured in WALK[:before]:
        known.step(measured, FORWARD)
        other.step(measured, FORWARD)
    command = known.step(spoilt(WALK[before], what, value, place), FORWARD)
    if known.record["solver_status"][0] == SolverStatus.FAILED:
        assert_only_damps(known, command)
        assert bits(known.step(WALK[before], FORWARD)) == bits(other.step(WALK[before], FORWARD))
        assert known.state.tobytes() == other.state.tobytes()
    else:  # a force that cannot be told is no contact; what cannot be used is not used
        assert all(np.isfinite(part).all() for part in (command.position, command.velocity, command.kp, command.torque))
        after = known.step(WALK[before], FORWARD)
        assert known.record["solver_status"][0] != SolverStatus.FAILED
        assert np.isfinite(after.torque).all() and np.isfinite(after.position).all()


@pytest.mark.parametrize("what", ["orientation", "rate", "acceleration", "position"])
def test_not_a_number_is_told(what: str) -> None:
    known = started()
    assert_only_damps(known, known.step(spoilt(WALK[0], what, np.nan), FORWARD))


@pytest.mark.parametrize("command", [(np.nan, 0.0, 0.0), (0.0, np.inf, 0.0), (0.0, 0.0, np.nan)])
def test_a_bad_command_is_told_and_forgotten(command: tuple[float, float, float]) -> None:
    known = started()
    asked = VelocityCommand(0.0, np.array(command[:2]), command[2])
    assert_only_damps(known, known.step(WALK[0], asked))
    known.step(WALK[0], FORWARD)
    assert known.record["solver_status"][0] == SolverStatus.SOLVED
    assert np.isfinite(known.record["velocity_command"]).all()


def test_a_bad_measurement_while_only_estimating_leaves_no_trace() -> None:
    known, other = started(), started()
    for measured in WALK[:5]:
        known.estimate(measured)
        known.estimate(spoilt(measured, "acceleration", np.nan))
        other.estimate(measured)
    assert known.state.tobytes() == other.state.tobytes()


def test_a_quaternion_of_zeros_is_told() -> None:
    known = started()
    measured = WALK[0]
    nothing = replace(measured, imu=replace(measured.imu, orientation=np.zeros(4)))
    assert_only_damps(known, known.step(nothing, FORWARD))


class Stub:
    def __init__(self, answer: Callable[[GrfProblem], Any]) -> None:
        self.answer = answer

    def solve(self, problem: GrfProblem) -> Any:
        return self.answer(problem)


def test_every_step_of_the_ladder_is_named_in_the_record() -> None:
    known = started()
    right, wrong = known.ladder.first, Stub(lambda problem: np.full_like(problem.gradient, np.nan))
    for first, second, status in (
        (right, wrong, SolverStatus.SOLVED),
        (wrong, right, SolverStatus.SECOND),
        (wrong, wrong, SolverStatus.LEAST_SQUARES),
    ):
        known.ladder = solvers.Ladder(first, second)
        known.step(WALK[0], STILL, True)
        assert known.record["solver_status"][0] == status
        assert known.record["grf"][0, :, 2].min() >= 5.0 - 1e-6


def test_a_solvers_wrong_answer_does_not_reach_the_motors() -> None:
    known, other = started(), started()
    known.ladder = solvers.Ladder(Stub(lambda problem: np.full_like(problem.gradient, 50.0)), other.ladder.first)
    for measured in WALK[:10]:
        assert bits(known.step(measured, FORWARD)) == bits(other.step(measured, FORWARD))


def test_bounds_that_leave_nothing_fail_at_once_and_the_ladder_is_not_asked_further() -> None:
    known = started(grf={"min_force": 300.0, "max_force": 100.0})
    known.ladder.second = Stub(lambda problem: pytest.fail("asked"))
    assert_only_damps(known, known.step(WALK[0], STILL, True))


def test_no_leg_in_stance_is_idle_with_zero_force_and_the_next_tick_is_solved() -> None:
    known = started(gait={"name": "pronk"})
    seen = []
    for index in range(200):
        known.step(WALK[index % 60], FORWARD)
        seen.append(int(known.record["solver_status"][0]))
        if not known.record["stance"].any():
            assert seen[-1] == SolverStatus.IDLE and not known.record["grf"].any()
    assert set(seen) == {SolverStatus.IDLE, SolverStatus.SOLVED}


def test_a_direct_policy_needs_no_solver() -> None:
    direct = variant(
        policy(),
        output="grf",
        action_names=SHIFT_NAMES + GRF_NAMES,
        matrix=((0.0,) * 28,) * 24,
        action_scale=(1.0,) * 24,
        action_bound=(1.0,) * 24,
    )
    known = started(chosen=direct)
    known.ladder = solvers.Ladder(Stub(lambda problem: pytest.fail("asked")), Stub(lambda problem: None))
    known.step(standing(), STILL, True)
    np.testing.assert_allclose(known.record["grf"][0, :, 2], robot().robot.mass * 9.81 / 4)


def test_a_policy_taken_between_two_ticks_is_the_one_that_acts() -> None:
    stiff = variant(policy(), name="stiff", matrix=tuple(tuple(3 * x for x in row) for row in policy().matrix))
    known, other = started(), started(chosen=stiff)
    known.step(WALK[0], FORWARD)
    other.step(WALK[0], FORWARD)
    other.state[:] = known.state
    known.policy = stiff
    assert known.policy is stiff
    assert bits(known.step(WALK[1], FORWARD)) == bits(other.step(WALK[1], FORWARD))


def test_unknown_solver_is_refused_when_the_controller_is_built() -> None:
    with pytest.raises(ValueError, match="simplex"):
        controller(grf={"solver": "simplex"})


def test_after_the_warm_up_nothing_compiles_whatever_happens() -> None:
    known = controller()
    known.warm_up(standing())
    assert known.state.dtype == STATE_DTYPE
    functions = (sense, sense_and_plan, carry_out, accept, well_posed, clipped_least_squares)
    before = [len(function.signatures) for function in functions]
    known.step(WALK[0], FORWARD)
    known.step(spoilt(WALK[1], "rate", np.nan), FORWARD)
    known.ladder = solvers.Ladder(Stub(lambda problem: None), Stub(lambda problem: None))
    known.step(WALK[2], FORWARD)
    known.estimate(WALK[3])
    assert [len(function.signatures) for function in functions] == before


def test_warm_up_leaves_a_reset_controller() -> None:
    known, other = controller(), started()
    known.warm_up(standing())
    assert known.state.tobytes() == other.state.tobytes()
    assert trace(known, 30) == trace(other, 30)
