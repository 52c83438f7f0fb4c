from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from runtime import config as configuration
from runtime.policies import SHIPPED as POLICIES
from runtime.policies import PolicyError, find_policy
from sim.scenario import Push, Scenario
from sim.world import World
from training import table
from training.contest import (
    BUILT_IN,
    Contender,
    Outcome,
    Trial,
    ablated,
    find_contender,
    find_contenders,
    run_trial,
)
from training.evaluation import Report
from training.mpc_controller import MpcController, centre_state, put_forces
from training.plan import make_plan
from training.randomize import SENSORS, Conditions
from training.robot_reference import record_reference
from training.rollout import walk
from training.walks import Walks

SHIPPED = sorted(path.stem for path in POLICIES.glob("*.json") if json.loads(path.read_text())["robot"] == "stoch3")
CONFIG = configuration.load(configuration.find_robot("stoch3"))


@pytest.fixture(scope="module")
def world() -> World:
    control = CONFIG.control
    return World(CONFIG.robot, control.rate_hz, control.gait.walking_height)


@pytest.mark.parametrize("name", ["mpc", "mpc-tuned", "balance"])
def test_every_built_in_contender_follows_a_command(name: str, world: World) -> None:
    walker = find_contender(name).walker(CONFIG)
    outcome = run_trial(CONFIG, world, walker, Trial(Conditions(Scenario(noise=SENSORS), (0.5, 0.0, 0.0)), 4.0))
    assert not outcome.fell
    assert outcome.velocity == pytest.approx((0.5, 0.0, 0.0), abs=0.08)
    assert outcome.height == pytest.approx(CONFIG.control.gait.walking_height, abs=0.03)


@pytest.mark.parametrize("name", ["mpc", "mpc-tuned", "balance"])
def test_every_built_in_contender_stands(name: str, world: World) -> None:
    walker = find_contender(name).walker(CONFIG)
    stances = []

    def watch(tick: int, _: object) -> bool:
        stances.append(walker.record["stance"][0].copy())
        return True

    conditions = Conditions(Scenario(noise=SENSORS), (0.0, 0.0, 0.0), standing=True)
    _, fell = walk(world, walker, conditions, np.zeros((300, 3)), watch)
    assert not fell and np.all(stances)
    assert world.truth.position[2] == pytest.approx(CONFIG.control.gait.walking_height, abs=0.01)


@pytest.mark.parametrize("name", SHIPPED)
def test_every_shipped_policy_stands_for_as_long_as_one_likes(name: str, world: World) -> None:
    """A lean that grows by half each second is nothing in a walk, whose steps catch it, and a fall for who stands."""
    worst = 0.0

    def watch(tick: int, _: object) -> bool:
        nonlocal worst
        worst = max(worst, float(np.abs(walker.record["rpy"][0, :2]).max())) if tick > 400 else worst
        return True

    walker = Contender(name, "policy", str(find_policy(name))).walker(CONFIG)
    conditions = Conditions(Scenario(seed=31_000, noise=SENSORS), (0.0, 0.0, 0.0), standing=True)
    _, fell = walk(world, walker, conditions, np.zeros((4000, 3)), watch)
    assert not fell and worst < 0.15
    assert world.truth.position[2] == pytest.approx(CONFIG.control.gait.walking_height, abs=0.01)


def test_the_table_says_how_far_from_its_height_a_contender_stands() -> None:
    class Low:
        walking_height = 0.5

        def play(self, who: Contender, trials: Sequence[Trial]) -> list[Outcome]:
            assert all(trial.conditions.standing for trial in trials)
            return [replace(outcome(False), height=0.5 + error) for error in (0.001, -0.022, 0.004)]

    cells = table._stand(Low(), Contender("x", "zero"), table.FULL)  # type: ignore[arg-type]
    assert cells == {"height error mm": pytest.approx(22.0), "falls": 0.0}


def test_the_teacher_turns_and_sidesteps(world: World) -> None:
    walker = MpcController(CONFIG)
    outcome = run_trial(CONFIG, world, walker, Trial(Conditions(Scenario(), (0.0, 0.2, 0.4)), 4.0))
    assert outcome.velocity == pytest.approx((0.0, 0.2, 0.4), abs=0.1)


def test_the_teachers_forces_are_what_the_motors_get(world: World) -> None:
    walker = MpcController(CONFIG)
    seen = []

    def watch(tick: int, _: object) -> bool:
        record = walker.record[0]
        seen.append((record["grf"].copy(), record["command_torque"].copy(), record["stance"].copy()))
        return True

    walk(world, walker, Conditions(Scenario()), np.tile([0.3, 0.0, 0.0], (60, 1)), watch)
    for grf, torque, stance in seen:
        assert (grf[stance == 0] == 0).all() and (torque[stance == 0] == 0).all()
        assert (np.abs(torque[stance == 1]).max(axis=1) > 0).all()


def test_forces_become_torques_by_virtual_work() -> None:
    rng = np.random.default_rng(0)
    walker = MpcController(CONFIG)
    q, rpy, forces = rng.normal(0, 0.3, (4, 3)), rng.normal(0, 0.2, 3), rng.normal(0, 50, (4, 3))
    q[:, 2] -= 1.0
    torque = np.empty((4, 3))
    put_forces(walker.geometry, q, rpy, forces, torque)
    from runtime.control.kinematics import forward
    from training.rigid_body import rotation_from_rpy

    rotation = np.empty((3, 3))
    rotation_from_rpy(np.array([rpy[0], rpy[1], 0.0]), rotation)
    for leg in range(4):
        for joint in range(3):
            moved = [q.copy(), q.copy()]
            moved[0][leg, joint] += 1e-6
            moved[1][leg, joint] -= 1e-6
            slope = (forward(walker.geometry, moved[0]) - forward(walker.geometry, moved[1]))[leg] / 2e-6
            assert torque[leg, joint] == pytest.approx(-float(rotation @ slope @ forces[leg]), abs=1e-4)


def test_the_rigid_bodys_state_is_the_centre_of_masss() -> None:
    com = np.array([-0.02, 0.0, -0.04])
    state = centre_state(np.array([0.1, -0.1, 2.0]), 0.5, np.array([0.3, 0, 0, 0.0, 0.0, 1.0]), com)
    assert state[8] == 0.0
    assert state[2] < 0.5 and state[2] == pytest.approx(0.46, abs=0.005)
    assert state[4] == pytest.approx(state[0] * 1.0, abs=1e-9)


def test_the_teachers_walk_on_the_robot_is_a_reference() -> None:
    reference = record_reference(CONFIG, ticks=200)
    assert reference.source == "robot"
    assert reference.features[150:, 18:].reshape(-1, 4, 3)[:, :, 2].sum(axis=1).mean() == pytest.approx(1.0, abs=0.15)
    assert reference.features[-1, 3] > 0.4


def test_a_hard_push_fells_and_the_outcome_says_when(world: World) -> None:
    push = Push(1.0, 0.2, (0.0, 3000.0, 0.0))
    walker = find_contender("balance").walker(CONFIG)
    outcome = run_trial(CONFIG, world, walker, Trial(Conditions(Scenario(pushes=(push,)), (0.0, 0.0, 0.0)), 4.0))
    assert outcome.fell and 1.0 < outcome.seconds < 2.5


def test_contenders_are_found_or_refused_by_name() -> None:
    for name in BUILT_IN:
        assert find_contender(name).kind == name
    assert find_contender("balance.json").kind == "policy"
    with pytest.raises(PolicyError, match="no-such"):
        find_contender("no-such")


def test_policies_that_are_called_alike_keep_a_column_each(tmp_path: Path) -> None:
    mine = tmp_path / "trot.json"
    mine.write_bytes(find_policy("balance").read_bytes())
    names = [contender.name for contender in find_contenders([str(mine), "mpc", "trot", "mpc", "balance"])]
    assert names == [str(mine), "mpc", "trot", "balance"]


def test_a_policy_walks_without_a_fixed_term(world: World) -> None:
    trot = find_contender("trot")
    columns = ablated(trot, ["slope", "velocity_integral"])
    assert [one.name for one in columns] == ["no velocity_integral", "no slope"]
    trial = Trial(Conditions(Scenario(), (0.8, 0.0, 0.0)), 6.0)
    whole, without = (run_trial(CONFIG, world, one.walker(CONFIG), trial).velocity[0] for one in (trot, columns[0]))
    assert abs(whole - 0.8) < 0.01 < 0.03 < abs(without - 0.8)
    assert [one.name for one in ablated(trot, ["all"])][-1] == "no term"
    assert ablated(trot, ["all"])[-1].walker(CONFIG).policy.terms.capture_point == 0.0  # type: ignore[attr-defined]
    assert ablated(find_contender("mpc"), ()) == []


def test_a_term_that_is_none_or_of_no_policy_is_refused() -> None:
    with pytest.raises(PolicyError, match=r"no fixed term 'speed': there are velocity_integral, .*slope"):
        ablated(find_contender("trot"), ["speed"])
    with pytest.raises(PolicyError, match="mpc is no policy file"):
        ablated(find_contender("mpc"), ["slope"])
    with pytest.raises(PolicyError, match="no fixed term 'speed'"):
        make_plan("tried", "stoch3", "0" * 16, without=["speed"])


class Threshold:
    """Falls above a known impulse, so that only the search is tested."""

    def __init__(self, limit: float) -> None:
        self.limit = limit

    def play(self, who: Contender, trials: Sequence[Trial]) -> list[Outcome]:
        impulses = [float(np.linalg.norm(t.conditions.scenario.pushes[0].force)) * 0.1 for t in trials]
        return [outcome(impulse > self.limit) for impulse in impulses]


def outcome(fell: bool) -> Outcome:
    return Outcome(fell, 1.0, (0.0, 0.0, 0.0), 0.5, 1.0, 1.0, 1.0, 1e-5)


@pytest.mark.parametrize(("limit", "found"), [(33.0, 32.5), (45.0, 45.0), (0.0, 0.0), (1e9, 97.5)])
def test_the_push_search_finds_the_largest_that_all_survive(limit: float, found: float) -> None:
    cells = table._push(Threshold(limit), Contender("x", "zero"), table.FULL, 0.0)  # type: ignore[arg-type]
    assert cells["N·s"] == found


def test_pushes_come_at_eight_phases_with_both_signs() -> None:
    trials = Walks(7).pushed(np.pi / 2, 40.0, phases=8)
    assert len(trials) == 16
    starts = sorted({trial.conditions.scenario.pushes[0].start for trial in trials})
    np.testing.assert_allclose(np.diff(starts), 0.05)
    forces = np.array([trial.conditions.scenario.pushes[0].force for trial in trials])
    assert set(np.sign(forces[:, 1]).tolist()) == {-1.0, 1.0}
    np.testing.assert_allclose(np.abs(forces[:, 1]), 400.0)


def test_the_table_puts_contenders_side_by_side() -> None:
    report = Report("stoch3", "0" * 16, ["one", "two"])
    report.results["push sideways"] = {"one": {"N·s": 45.0}, "two": {"N·s": 30.0}}
    report.results["motors at 80 %"] = {"one": {"stood": 20.0, "of": 20.0}, "two": {"stood": 7.0, "of": 20.0}}
    lines = report.to_text().splitlines()
    assert lines[2].split() == ["push", "sideways:", "N·s", "45", "30"]
    assert lines[3].split()[-5:] == ["stood", "of", "20", "20", "7"] or lines[3].endswith(" 7")
    assert json.loads(report.to_json())["results"]["push sideways"]["two"]["N·s"] == 30.0
