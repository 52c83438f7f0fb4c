"""The environment trains with a well-known library. Needs the extra ``[rl]``: ``make test-extras``."""

from __future__ import annotations

import numpy as np
import pytest

from runtime import config as configuration
from training.env import WalkEnv

stable_baselines3 = pytest.importorskip("stable_baselines3", reason="the extra [rl] is not installed: make test-extras")
pytestmark = [pytest.mark.filterwarnings("ignore"), pytest.mark.timeout(300)]


def test_ppo_learns_on_it() -> None:
    env = WalkEnv(configuration.load(configuration.find_robot("stoch3")), ticks=60)
    model = stable_baselines3.PPO("MlpPolicy", env, n_steps=256, batch_size=64, n_epochs=4, seed=1, device="cpu")
    before = np.concatenate([p.detach().numpy().ravel() for p in model.policy.parameters()])
    model.learn(1024)
    after = np.concatenate([p.detach().numpy().ravel() for p in model.policy.parameters()])
    assert np.isfinite(after).all()
    assert not np.array_equal(before, after)
    rewards = [info["r"] for info in model.ep_info_buffer]
    assert len(rewards) >= 1024 // 60, "episodes ended and were told to the library"
    assert np.isfinite(rewards).all()
    observation, _ = env.reset(seed=5)
    for _ in range(20):
        action, _ = model.predict(observation, deterministic=True)
        observation, reward, terminated, truncated, _ = env.step(action)
        assert env.observation_space.contains(observation)
        assert np.isfinite(reward)
        if terminated or truncated:
            break
    env.close()
