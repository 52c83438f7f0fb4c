"""One tick after another without a loop: expiry, refusals, faults, and what each leaves in the record."""

from __future__ import annotations

import asyncio
import math
from dataclasses import replace

import numpy as np
import pytest
from daemons import Probe, is_damp, make_config, make_policy, wake

from drivers.robot import JointCommand, Measurement, damp_command
from runtime.control.records import Clamp, VelocityCommand
from runtime.cycle import Cycle
from runtime.messages.mode import Mode, Request
from runtime.reasons import Reason


class Bench:
    """A cycle on the null body, tick by tick."""

    def __init__(self, **changes: object) -> None:
        self.config = make_config(**{"command__stand_after": 2.0} | changes)
        self.cycle = Cycle(self.config, make_policy(self.config.robot.name))
        self.body = Probe(self.config)
        self.command = damp_command(1.0)
        self.index = 0
        self.lateness, self.overruns, self.elapsed = 0.0, 0, 0.005
        asyncio.run(self.body.connect())
        self.measurement = asyncio.run(self.body.exchange(self.command))
        self.cycle.warm_up(self.measurement)

    @property
    def now(self) -> float:
        return self.index / 200.0

    def tick(self, count: int = 1) -> JointCommand:
        for _ in range(count):
            self.index += 1
            exchange = self.body.exchange(self.command)
            try:
                exchange.send(None)
            except StopIteration as done:
                self.measurement = done.value
            due = replace(wake(self.index), lateness=self.lateness, overruns=self.overruns, elapsed=self.elapsed)
            self.command = self.cycle.step(due, self.measurement)
        return self.command

    def ask(self, wish: Request) -> tuple[bool, str]:
        answer, words = self.cycle.request(wish, self.measurement)
        return answer.accepted, words

    def reach(self, mode: Mode) -> None:
        for _ in range(2000):
            if self.cycle.state.mode is mode:
                return
            self.tick()
        raise AssertionError(f"never reached {mode.name}: {self.cycle.state}")

    def walk(self) -> None:
        self.tick()
        for wish in (Request.ARM, Request.STAND):
            assert self.ask(wish) == (True, "armed" if wish is Request.ARM else "asked for")
        self.reach(Mode.STAND)
        assert self.ask(Request.WALK)[0]
        self.tick()

    def stand(self) -> None:
        self.tick()
        assert self.ask(Request.ARM)[0] and self.ask(Request.STAND)[0]
        self.reach(Mode.STAND)
        self.tick(20)

    def velocity(self, x: float) -> None:
        self.cycle.command_velocity(VelocityCommand(self.now, np.array([x, 0.0]), 0.0))


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_start_damps_and_goes_on_damping(bench: Bench) -> None:
    for _ in range(50):
        assert is_damp(bench.tick())
    assert bench.cycle.state.mode is Mode.DAMP and not bench.cycle.state.armed


@pytest.mark.parametrize("wish", [Request.STAND, Request.WALK, Request.SIT])
def test_an_unarmed_robot_refuses_to_move_and_says_why(bench: Bench, wish: Request) -> None:
    bench.tick()
    accepted, words = bench.ask(wish)
    assert not accepted and words
    assert all(is_damp(bench.tick()) for _ in range(20))
    assert [event.kind for event in bench.cycle.events] == ["refused"]
    assert wish.value in bench.cycle.events[0].text


def test_nothing_is_accepted_before_the_first_measurement_was_judged(bench: Bench) -> None:
    assert not bench.ask(Request.ARM)[0]


def test_a_stop_damps_for_a_tick_however_soon_somebody_arms_again(bench: Bench) -> None:
    bench.walk()
    assert bench.ask(Request.DAMP)[0]
    accepted, words = bench.ask(Request.ARM)
    assert not accepted and "not been damped" in words
    assert not bench.ask(Request.STAND)[0]
    assert is_damp(bench.tick())
    assert bench.ask(Request.ARM)[0] and bench.ask(Request.STAND)[0]


def test_up_walk_and_down(bench: Bench) -> None:
    bench.walk()
    assert bench.cycle.tick["mode"][0] == Mode.WALK
    assert not is_damp(bench.command)
    assert bench.ask(Request.STAND)[0]
    bench.tick(200)
    assert bench.ask(Request.SIT)[0]
    bench.reach(Mode.DAMP)
    assert is_damp(bench.command)
    assert not bench.cycle.state.armed and bench.cycle.state.fault is Reason.OK


def test_a_velocity_command_is_followed_expires_and_then_the_robot_stands(bench: Bench) -> None:
    bench.walk()
    bench.velocity(0.4)
    bench.tick(30)
    assert bench.cycle.tick["velocity_command"][0, 0] > 0.1
    assert not bench.cycle.tick["clamps"][0] & Clamp.EXPIRED
    bench.tick(11)  # 41 ticks of 5 ms: just past 0.2 s
    assert bench.cycle.tick["clamps"][0] & Clamp.EXPIRED
    assert bench.cycle.state.mode is Mode.WALK
    bench.tick(300)
    assert bench.cycle.tick["asked_velocity"][0, 0] == 0.0
    bench.tick(60)  # 401 ticks: just past 2 s
    assert bench.cycle.state.mode is Mode.STAND
    assert bench.cycle.state.reason is Reason.COMMAND_LOST


def test_a_command_from_before_the_walk_does_not_start_it(bench: Bench) -> None:
    bench.tick()
    bench.ask(Request.ARM)
    bench.ask(Request.STAND)
    bench.reach(Mode.STAND)
    bench.velocity(0.4)
    assert bench.ask(Request.WALK)[0]
    bench.tick(20)
    assert bench.cycle.tick["velocity_command"][0, 0] < 0.05


def spoil(measurement: Measurement, **joints: object) -> Measurement:
    return replace(measurement, joints=replace(measurement.joints, **joints))  # type: ignore[arg-type]


@pytest.mark.parametrize("stage", ["armed", Mode.STAND_UP, Mode.STAND, Mode.WALK, Mode.SIT_DOWN])
def test_a_fault_damps_from_anywhere_and_stays_until_cleared(bench: Bench, stage: object) -> None:
    bench.tick()
    bench.ask(Request.ARM)
    if stage != "armed":
        bench.ask(Request.STAND)
        bench.tick(3)
    if stage in (Mode.STAND, Mode.WALK, Mode.SIT_DOWN):
        bench.reach(Mode.STAND)
        bench.tick(3)
    if stage is Mode.WALK:
        bench.ask(Request.WALK)
    if stage is Mode.SIT_DOWN:
        bench.ask(Request.SIT)
    bench.tick()
    good = bench.body.change
    bench.body.change = lambda m: spoil(m, position=np.full((4, 3), math.nan))
    assert is_damp(bench.tick())
    state = bench.cycle.state
    assert state.mode is Mode.DAMP and not state.armed and state.fault is Reason.NOT_FINITE
    bench.body.change = good
    bench.tick()
    for wish in (Request.ARM, Request.STAND):
        assert bench.ask(wish) == (False, Reason.FAULT_STANDS.words)
    assert bench.ask(Request.CLEAR)[0]
    assert bench.ask(Request.ARM)[0]
    assert np.isfinite(bench.cycle.tick["height"][0]), "the estimate did not keep the fault"


def test_a_silent_body_damps(bench: Bench) -> None:
    bench.walk()
    bench.index += 1
    assert is_damp(bench.cycle.silent(wake(bench.index), "no reply within 5 ms"))
    assert bench.cycle.state.fault is Reason.BODY_SILENT
    assert any("no reply" in event.text for event in bench.cycle.events)


def break_controller(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    nan = np.full((4, 3), math.nan)
    monkeypatch.setattr(bench.cycle.controller, "step", lambda *_: JointCommand(nan, nan, nan, nan, nan))


def test_a_controller_that_finds_nothing_sits_a_standing_robot_down(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.stand()
    break_controller(bench, monkeypatch)
    command = bench.tick()
    assert bench.cycle.state.mode is Mode.SIT_DOWN and bench.cycle.state.fault is Reason.BAD_COMMAND
    assert all(np.isfinite(getattr(command, name)).all() for name in ("position", "velocity", "kp", "kd", "torque"))
    assert bench.ask(Request.STAND) == (False, Reason.FAULT_STANDS.words)
    bench.reach(Mode.DAMP)
    assert is_damp(bench.command) and not bench.cycle.state.armed
    assert bench.cycle.state.fault is Reason.BAD_COMMAND, "it stays until it is cleared"


def test_a_controller_that_finds_nothing_folds_a_walking_robots_legs(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.walk()
    break_controller(bench, monkeypatch)
    command = bench.tick()
    assert bench.cycle.state.mode is Mode.SIT_DOWN and bench.cycle.state.fault is Reason.BAD_COMMAND
    assert all(np.isfinite(getattr(command, name)).all() for name in ("position", "velocity", "kp", "kd", "torque"))
    share = bench.cycle.config.posture.brace_gain
    np.testing.assert_allclose(command.kp, share * np.tile(bench.cycle.config.control.gains.kp, (4, 1)))
    bench.reach(Mode.DAMP)
    assert is_damp(bench.command) and not bench.cycle.state.armed
    assert bench.cycle.state.fault is Reason.BAD_COMMAND


def test_a_fault_that_leaves_the_controller_whole_stops_a_walking_robot_before_it_sits(bench: Bench) -> None:
    bench.walk()
    bench.body.change = lambda m: spoil(m, temperature=np.full((4, 3), 90.0))
    bench.tick()
    assert bench.cycle.state.mode is Mode.STAND, "the null body is never fast"
    assert bench.cycle.state.fault is Reason.HOT_MOTOR
    assert bench.ask(Request.WALK) == (False, Reason.FAULT_STANDS.words)
    bench.reach(Mode.SIT_DOWN)
    bench.reach(Mode.DAMP)
    assert bench.cycle.state.fault is Reason.HOT_MOTOR


def test_a_controller_that_finds_nothing_damps_where_sitting_down_is_off(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(limits__sit_down=False)
    bench.stand()
    break_controller(bench, monkeypatch)
    assert is_damp(bench.tick())
    assert bench.cycle.state.fault is Reason.BAD_COMMAND


def test_what_leaves_is_what_the_record_says(bench: Bench) -> None:
    bench.walk()
    for _ in range(50):
        command = bench.tick()
        for name in ("position", "velocity", "kp", "kd", "torque"):
            np.testing.assert_array_equal(bench.cycle.tick[f"command_{name}"][0], getattr(command, name))
        np.testing.assert_array_equal(bench.cycle.tick["joint_position"][0], bench.measurement.joints.position)


def test_no_command_jumps_when_the_source_changes(bench: Bench) -> None:
    bench.tick()
    bench.ask(Request.ARM)
    bench.ask(Request.STAND)
    before = bench.tick()
    for _ in range(400):
        after = bench.tick()
        assert np.abs(after.position - before.position).max() < 0.5
        assert np.abs(after.kp - before.kp).max() < 0.5 * 150.0
        before = after


def test_a_policy_is_swapped_between_ticks(bench: Bench) -> None:
    bench.walk()
    bench.cycle.swap_policy(bench.cycle.policy)
    bench.tick()
    assert bench.cycle.tick["policy"][0] == 2
    assert bench.cycle.events[-1].kind == "policy"
