"""Score an agent of any library on Platform: greedy episodes in Gymnasium, the same for all."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import hpamdp

EPISODES = 1000
FIRST_SEED = 1_000_000  # training uses other seeds


def score(act: Callable[[np.ndarray], Any]) -> dict[str, float]:
    """Return the mean return and the fraction of successful episodes."""
    env = hpamdp.make_gymnasium("platform")
    returns, successes = [], []
    for episode in range(EPISODES):
        observation, _ = env.reset(seed=FIRST_SEED + episode)
        total, done = 0.0, False
        while not done:
            observation, reward, terminated, truncated, info = env.step(act(observation))
            total, done = total + reward, terminated or truncated
        returns.append(total)
        successes.append(info["is_success"])
    return {"score": round(float(np.mean(returns)), 4), "success": round(float(np.mean(successes)), 4)}
