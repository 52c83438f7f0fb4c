from __future__ import annotations

import os
import pickle
import signal
from collections.abc import Iterator
from typing import get_args, get_type_hints

import numpy as np
import pytest

from drivers.robot import Array
from runtime import config as configuration
from runtime.config import Config
from runtime.control.policy import Policy, balance_policy
from sim.scenario import Push, Scenario
from training import evaluators
from training.evaluators import InProcess, Processes
from training.plan import StagePlan
from training.randomize import (
    HARD,
    IMITATION,
    NOMINAL,
    ROUGH,
    SETS,
    STANDING_PUSH,
    TASK,
    WEAK,
    WIDE,
    Conditions,
    Randomization,
    draw,
)
from training.reference import make_reference
from training.reward import TableReward, TaskReward
from training.rollout import Episode, Setup, Stage, Task

TICKS = 120


@pytest.fixture(scope="module")
def config() -> Config:
    return configuration.load(configuration.find_robot("stoch3"))


@pytest.fixture(scope="module")
def policy(config: Config) -> Policy:
    return balance_policy(config.robot, config.control.gait.walking_height)


@pytest.fixture(scope="module")
def setup(config: Config, policy: Policy) -> Setup:
    features, commands = make_reference(config, ticks=TICKS).resampled(config.control.rate_hz, TICKS)
    return Setup(config, policy, TableReward(), TICKS, features, commands)


@pytest.fixture(scope="module")
def stage(setup: Setup) -> Iterator[Stage]:
    stage = Stage(setup)
    yield stage
    stage.close()


def tasks(policy: Policy, count: int = 5) -> list[Task]:
    rng = np.random.default_rng(7)
    numbers = policy.parameters
    return [Task(numbers + 0.02 * rng.standard_normal(numbers.size), draw(IMITATION, rng)) for _ in range(count)]


def test_the_same_draws_come_from_the_same_seed() -> None:
    for bounds in (IMITATION, TASK, ROUGH):
        assert draw(bounds, np.random.default_rng(3)) == draw(bounds, np.random.default_rng(3))
        assert draw(bounds, np.random.default_rng(3)) != draw(bounds, np.random.default_rng(4))


def test_draws_stay_inside_their_bounds_and_use_them() -> None:
    rng = np.random.default_rng(0)
    drawn = [draw(TASK, rng) for _ in range(400)]
    friction = np.array([one.scenario.friction for one in drawn])
    assert 0.6 <= friction.min() < 0.65 and 1.15 < friction.max() <= 1.2
    rpy = np.array([one.scenario.rpy for one in drawn])
    assert np.abs(rpy).max() <= 0.2 and rpy.min() < -0.15
    pushes = [one.scenario.pushes[0] for one in drawn if one.scenario.pushes]
    assert 0.7 < len(pushes) / len(drawn) < 0.9
    impulses = np.array([np.hypot(*push.force[:2]) * push.duration for push in pushes])
    assert impulses.min() >= 10 and impulses.max() <= 45
    commands = np.array([one.command for one in drawn])
    assert commands[:, 0].min() >= -0.6 and commands[:, 0].max() <= 1.6
    assert 0.15 < (commands == 0).mean() < 0.35


def test_some_episodes_stand_and_some_motors_are_weak() -> None:
    rng = np.random.default_rng(0)
    drawn = [draw(WIDE, rng) for _ in range(600)]
    standing = [one for one in drawn if one.standing]
    assert 0.08 < len(standing) / len(drawn) < 0.16
    assert {one.command for one in standing} == {(0.0, 0.0, 0.0)}
    pushes = [push for one in standing for push in one.scenario.pushes]
    hardest = max(np.hypot(*push.force[:2]) * push.duration for push in pushes)
    assert 0.9 * STANDING_PUSH * 50 < hardest <= STANDING_PUSH * 50
    strengths = np.array([one.scenario.motor_strength for one in drawn])
    weak = strengths[strengths < 1.0]
    assert 0.2 < weak.size / strengths.size < 0.3
    assert weak.min() < 0.46 and weak.max() > 0.95
    halved = np.array([draw(WEAK, rng).scenario.motor_strength for _ in range(400)])
    assert 0.74 < (halved == 1.0).mean() < 0.86 and halved[halved < 1.0].max() < 0.6


def test_weak_motors_are_pushed_less_where_pushes_are_hard() -> None:
    rng = np.random.default_rng(0)
    drawn = [draw(HARD, rng) for _ in range(600)]

    def hardest(weak: bool) -> float:
        walks = [one.scenario for one in drawn if not one.standing and (one.scenario.motor_strength < 1.0) == weak]
        return float(max(np.hypot(*push.force[:2]) * push.duration for walk in walks for push in walk.pushes))

    assert 60.0 < hardest(weak=False) <= 65.0
    assert hardest(weak=True) == pytest.approx(0.2 * 65.0, rel=0.05)


def test_nominal_conditions_are_the_worlds_own() -> None:
    scenario = draw(NOMINAL, np.random.default_rng(0)).scenario
    assert scenario == Scenario(seed=scenario.seed)


def test_rough_ground_comes_in_all_its_kinds() -> None:
    rng = np.random.default_rng(0)
    kinds = {type(draw(ROUGH, rng).scenario.terrain).__name__ for _ in range(60)}
    assert kinds == {"Plane", "Slope", "HeightField"}


def test_an_episode_is_the_same_bits_again_and_after_another(stage: Stage, policy: Policy) -> None:
    first, second = tasks(policy, 2)
    once = stage.rollout(first)
    stage.rollout(second)
    assert stage.rollout(first) == once
    assert once.steps == TICKS and not once.fell


def test_terms_add_up_to_the_fitness_and_stay_below_their_best(stage: Stage, policy: Policy) -> None:
    episode = stage.rollout(Task(policy.parameters, Conditions(Scenario())))
    assert sum(episode.terms.values()) == pytest.approx(episode.fitness)
    assert 0 < episode.fitness < TableReward().best * TICKS
    best = TableReward().table()[:, 0] * TICKS
    assert all(0 <= value <= bound for value, bound in zip(episode.terms.values(), best, strict=True))


def test_the_direction_the_robot_starts_in_does_not_matter(stage: Stage, policy: Policy) -> None:
    straight = stage.rollout(Task(policy.parameters, Conditions(Scenario())))
    turned = stage.rollout(Task(policy.parameters, Conditions(Scenario(rpy=(0.0, 0.0, 1.0)))))
    assert turned.fitness == pytest.approx(straight.fitness, rel=0.03)


def test_a_push_that_fells_ends_the_episode_and_costs(stage: Stage, policy: Policy) -> None:
    standing = stage.rollout(Task(policy.parameters, Conditions(Scenario())))
    push = Push(start=0.1, duration=0.2, force=(0.0, 3000.0, 0.0))
    felled = stage.rollout(Task(policy.parameters, Conditions(Scenario(pushes=(push,)))))
    assert felled.fell and felled.steps < TICKS
    assert felled.fitness < standing.fitness


def test_the_task_reward_prefers_the_command_that_is_followed(config: Config, policy: Policy) -> None:
    stage = Stage(Setup(config, policy, TaskReward(), 200))
    try:
        walking = stage.rollout(Task(policy.parameters, Conditions(Scenario(), (0.3, 0.0, 0.0))))
        careless = stage.rollout(Task(0 * policy.parameters, Conditions(Scenario(), (0.3, 0.0, 0.0))))
    finally:
        stage.close()
    assert walking.fitness > careless.fitness
    assert walking.terms["alive"] == 200
    assert walking.terms["torque"] < 0 and walking.terms["slip"] < 0


def test_setups_tasks_and_episodes_travel(setup: Setup, policy: Policy) -> None:
    task = tasks(policy, 1)[0]
    again = pickle.loads(pickle.dumps(task))
    np.testing.assert_array_equal(again.parameters, task.parameters)
    assert again.conditions == task.conditions
    assert len(pickle.dumps(task)) < 8_000, "what travels with each task stays small"
    assert pickle.loads(pickle.dumps(setup)).ticks == TICKS
    assert pickle.loads(pickle.dumps(Episode(1.0, 2, False))) == Episode(1.0, 2, False)


def test_any_number_of_workers_gives_the_same_bits(setup: Setup, policy: Policy) -> None:
    asked = tasks(policy)
    alone = InProcess(setup)
    pool = Processes(setup, workers=2)
    try:
        assert pool.evaluate(asked) == alone.evaluate(asked)
    finally:
        pool.close()
        alone.close()


def test_a_worker_that_dies_is_replaced_and_nothing_is_lost(setup: Setup, policy: Policy) -> None:
    asked = tasks(policy, 4)
    alone = InProcess(setup)
    pool = Processes(setup, workers=1)
    try:
        expected = alone.evaluate(asked)
        assert pool.evaluate(asked[:1]) == expected[:1]
        for pid in list(pool._pool._processes):
            os.kill(pid, signal.SIGKILL)
        assert pool.evaluate(asked) == expected
        assert pool.restarts == 1
    finally:
        pool.close()
        alone.close()


class Killer(Stage):
    """Dies with its process on the task whose first number is 666."""

    def rollout(self, task: Task) -> Episode:
        if task.parameters[0] == 666.0:
            os.kill(os.getpid(), signal.SIGKILL)
        return Episode(float(task.parameters[0]), 1, False)


def enter_killer(setup: Setup) -> None:
    evaluators._stage = Killer.__new__(Killer)


def test_a_task_that_kills_every_worker_is_lost_and_the_others_are_not(
    setup: Setup, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluators, "_enter", enter_killer)
    asked = [Task(np.array([float(number)]), Conditions(Scenario())) for number in (1, 2, 666, 4, 5)]
    pool = Processes(setup, workers=2)
    try:
        episodes = pool.evaluate(asked)
    finally:
        pool.close()
    assert [episode.fitness for index, episode in enumerate(episodes) if index != 2] == [1, 2, 4, 5]
    assert np.isnan(episodes[2].fitness) and episodes[2].fell


@pytest.mark.parametrize("numbers", [np.nan, np.inf])
def test_numbers_that_are_not_finite_lose_their_episode_alone(setup: Setup, policy: Policy, numbers: float) -> None:
    broken: Array = np.full_like(policy.parameters, numbers)
    alone = InProcess(setup)
    try:
        lost, kept = alone.evaluate([Task(n, Conditions(Scenario())) for n in (broken, policy.parameters)])
    finally:
        alone.close()
    assert lost.fell and np.isnan(lost.fitness)
    assert not kept.fell and np.isfinite(kept.fitness)


def test_an_unreachable_ray_address_is_a_clear_error(setup: Setup) -> None:
    from training.ray_evaluator import ClusterError, RayCluster

    with pytest.raises(ClusterError, match=r"Ray"):
        RayCluster(setup, "127.0.0.1:1")


def test_bounds_given_by_hand_are_drawn_from() -> None:
    bounds = Randomization(payload=(1.0, 2.0), motor_strength=(0.8, 0.9), extra_delay=(0.001, 0.002))
    scenario = draw(bounds, np.random.default_rng(0)).scenario
    assert 1 <= scenario.payload <= 2 and 0.8 <= scenario.motor_strength <= 0.9
    assert 0.001 <= scenario.extra_delay <= 0.002


def test_every_condition_that_a_plan_may_name_is_a_set() -> None:
    assert set(get_args(get_type_hints(StagePlan)["conditions"])) == set(SETS)
