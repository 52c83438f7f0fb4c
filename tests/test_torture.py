"""A sample of the fault matrix, and the proof that what watches it sees what it is there to see."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from faults.computer import WildPolicy
from faults.imu import FlippedImu, FrozenImu
from faults.matrix import BY_NAME, ROWS
from faults.motors import FrameLoss
from faults.rig import Fault, Rig
from faults.run import Case, replay
from faults.watch import Outcome, Watch

from drivers.robot import JointCommand
from runtime.reasons import Reason

TORTURE = Path(__file__).parent / "torture.py"
SAMPLE = 200


def torture(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, str(TORTURE), *arguments], capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def outcomes() -> list[Outcome]:
    result = torture("--sample", str(SAMPLE), "--json")
    assert result.stdout, result.stderr
    return msgspec.json.decode(result.stdout, type=list[Outcome])


def test_a_sample_of_the_matrix_holds_its_bounds(outcomes: list[Outcome]) -> None:
    assert len(outcomes) == SAMPLE
    assert {(o.row, o.gait) for o in outcomes} == {(row.name, gait) for row in ROWS for gait in ("stand", "walk")}
    bad = [f"{o.body} {o.gait} {o.row} {o.seed}: {o.violations}" for o in outcomes if o.violations]
    assert not bad, "\n".join(bad)


def test_a_fault_alone_is_bit_for_bit_the_one_of_the_matrix(outcomes: list[Outcome]) -> None:
    for wanted in (("policy_huge", "sim"), ("bus_off", "wire")):
        first = next(o for o in outcomes if (o.row, o.body) == wanted and o.gait == "walk")
        assert replay(Case(first.body, first.gait, first.row, first.seed, brief=True)) == first


def test_bad_arguments_say_what_there_is() -> None:
    result = torture("--row", "gremlins")
    assert result.returncode == 2
    assert "motor_silent" in result.stderr


def suffer(rig: Rig, fault: Fault, ticks: int) -> Outcome:
    outcome = Outcome(row="", gait="walk", seed=0, body="sim", fault=repr(fault), violations=[])
    watch = Watch(rig, outcome)
    rig.inject(fault)
    for _ in range(ticks):
        rig.tick()
        watch.look()
    watch.judge()
    return outcome


@pytest.fixture
def walking() -> Rig:
    rig = Rig("sim", 0)
    rig.stand()
    rig.walk_on()
    return rig


class Passive(Fault):
    """Nothing."""


def spoilt(rig: Rig, name: str, value: float) -> None:
    """The cycle's commands leave with ``value`` in the field ``name``."""
    step = rig.cycle.step

    def wrong(*arguments: Any) -> JointCommand:
        command = step(*arguments)
        getattr(command, name)[1, 1] = value
        return command

    rig.cycle.step = wrong  # type: ignore[method-assign]


def test_the_watch_sees_nothing_where_there_is_nothing(walking: Rig) -> None:
    outcome = suffer(walking, Passive(), 100)
    assert not outcome.violations and outcome.ends == "WALK"
    assert outcome.evidence is outcome.noticed is outcome.answered is None
    assert 10.0 < outcome.torque <= 40.0 and not outcome.fell


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [("torque", 500.0, "past the limit"), ("kp", -1.0, "below zero")],
)
def test_the_watch_sees_a_command_that_must_not_leave(walking: Rig, name: str, value: float, words: str) -> None:
    spoilt(walking, name, value)
    assert words in " ".join(suffer(walking, Passive(), 3).violations)


def test_the_watch_sees_a_number_that_is_none(walking: Rig) -> None:
    watch = Watch(walking, Outcome(row="", gait="walk", seed=0, body="sim", fault="", violations=[]))
    walking.tick()
    walking.command.velocity[0, 0] = np.nan
    watch.look()
    assert "not finite" in " ".join(watch.outcome.violations)


@pytest.mark.parametrize("fault", [FlippedImu(0), FrozenImu(False), FrameLoss(1.0, (4,))], ids=repr)
def test_the_watch_sees_a_guard_that_looks_away(walking: Rig, fault: Fault) -> None:
    walking.cycle.guard.judge = lambda *_: Reason.OK  # type: ignore[method-assign]
    violations = suffer(walking, fault, 30).violations
    assert violations and "evidence" in " ".join(violations)


def test_the_watch_sees_a_robot_that_lies_there_and_walks_on(walking: Rig) -> None:
    for net in ("judge", "judge_plan", "bound"):
        setattr(walking.cycle.guard, net, lambda *_: Reason.OK)
    violations = " ".join(suffer(walking, WildPolicy(1e4, 1), 400).violations)
    assert "lay on the ground" in violations
    assert "past the limit" in violations


def test_every_row_draws_other_numbers_for_other_seeds() -> None:
    for row in ROWS:
        for draw in (row.sim, row.wire):
            if draw is not None:
                faults = {repr(draw(np.random.default_rng(seed))) for seed in range(12)}
                again = {repr(draw(np.random.default_rng(seed))) for seed in range(12)}
                assert faults == again
    assert len(BY_NAME) == len(ROWS)
