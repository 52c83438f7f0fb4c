from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from gymnasium.utils import seeding
from gymnasium.utils.env_checker import check_env

from runtime import config as configuration
from runtime.control.policy import balance_policy
from training.env import WalkEnv
from training.randomize import TASK, draw
from training.reward import TaskReward
from training.rollout import Setup, Stage, Task

TICKS = 90
CONFIG = configuration.load(configuration.find_robot("stoch3"))


@pytest.fixture(scope="module")
def env() -> Iterator[WalkEnv]:
    env = WalkEnv(CONFIG, ticks=TICKS)
    yield env
    env.close()


@pytest.fixture(scope="module")
def stage() -> Iterator[Stage]:
    policy = balance_policy(CONFIG.robot, CONFIG.control.gait.walking_height)
    stage = Stage(Setup(CONFIG, policy, TaskReward(), TICKS, physics_rate_hz=600.0))
    yield stage
    stage.close()


@pytest.mark.filterwarnings("ignore:.*:UserWarning")
def test_gymnasiums_own_checker_passes(env: WalkEnv) -> None:
    check_env(env, skip_render_check=True)
    assert env.observation_space.contains(env.reset(seed=1)[0]), "and it is left in working order"


def test_the_same_seed_is_the_same_episode(env: WalkEnv) -> None:
    def play() -> tuple[list[float], np.ndarray]:
        first, _ = env.reset(seed=4)
        action = np.zeros(18, dtype=np.float32)
        return [env.step(action)[1] for _ in range(30)], first

    rewards, first = play()
    again, second = play()
    assert rewards == again
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("seed", [2, 3, 4])
def test_an_agent_that_computes_m_s_earns_what_the_policy_does(env: WalkEnv, stage: Stage, seed: int) -> None:
    policy = balance_policy(CONFIG.robot, CONFIG.control.gait.walking_height)
    matrix, total = np.array(policy.matrix), 0.0
    observation, info = env.reset(seed=seed)
    for _ in range(TICKS):
        observation, reward, fallen, _, _ = env.step((matrix @ observation).astype(np.float32))
        total += reward
    assert not fallen
    drawn = draw(TASK, seeding.np_random(seed)[0])
    assert drawn.command == info["command"]
    assert stage.rollout(Task(policy.parameters, drawn)).fitness == pytest.approx(total, rel=0.02)


def test_the_command_can_be_chosen_and_the_episode_is_truncated(env: WalkEnv) -> None:
    _, info = env.reset(seed=2, options={"command": (0.2, 0.0, 0.1)})
    assert info["command"] == (0.2, 0.0, 0.1)
    ends = [env.step(np.zeros(18, dtype=np.float32))[2:4] for _ in range(TICKS)]
    assert [truncated for _, truncated in ends].index(True) == TICKS - 1


def test_terms_in_the_info_add_up_to_the_reward(env: WalkEnv) -> None:
    env.reset(seed=2)
    _, reward, _, _, terms = env.step(np.zeros(18, dtype=np.float32))
    assert sum(terms.values()) == pytest.approx(reward)
