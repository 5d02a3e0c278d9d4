"""Episodes that `tandem eval` plays, played by a policy in an environment."""

from typing import Any

import gymnasium
import numpy as np
import pytest
import tandem


def check_evaluation(answer: dict[str, Any], env: gymnasium.Env, policy: Any, seed: int, n_episodes: int) -> None:
    """Compares the means of `tandem eval --json` with those of the same episodes."""
    returns, successes = [], []
    for episode in range(n_episodes):
        observation, _ = env.reset(seed=tandem.episode_seed(seed, episode))
        rewards, truncated = [], False
        while not truncated:
            action, _ = policy.predict(observation)
            observation, reward, _, truncated, info = env.step(action)
            rewards.append(reward)
        returns.append(sum(rewards))
        successes.append(info["is_success"])
    assert np.mean(successes) == pytest.approx(answer["success"])
    assert np.mean(returns) == pytest.approx(answer["mean_return"])
