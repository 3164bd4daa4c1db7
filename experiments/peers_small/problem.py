"""A hybrid problem whose best and random returns are known in closed form, and the way between them.

An episode has six steps and one target, a time from 0 to 2 s. Key 0 holds for at most 1 s and key 1 for at most 2 s,
at half the reward. A press rewards holding for the target's time. Key 2 gives nothing now, but charges the press after
it: fully at 0.4 s. A fully charged press is worth three. The durations of the two other keys have no effect.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, Tuple

STEPS = 6
HIGHS = (1.0, 2.0, 0.5)  # longest duration of each key, seconds
# Key 0 is worth 1 for targets up to 1 s, then 2 - target; key 1 is worth 0.5. The mean of the better one is 0.8125.
# Three charged presses are better than six others, as charging costs a step and adds two presses.
BEST = 9 * 0.8125
# A random press of key 0 is worth 1/3, of key 1 1/6. A random charge is 0.575, and a third of the keys are charges.
RANDOM = (1 / 3 + 1 / 6) / 3 * (1 + (STEPS - 1) * (1 + 2 * 0.575 / 3))
EPISODE_SEEDS = range(7_000_000, 7_000_200)


class Keys(gymnasium.Env):
    """Three keys with a duration each. Durations outside the bounds are clipped, and counted in `outside`."""

    outside = 0

    def __init__(self) -> None:
        self.action_space = Tuple((Discrete(3), Tuple(tuple(Box(0.0, high, (1,)) for high in HIGHS))))
        self.observation_space = Box(np.zeros(3, np.float32), np.array([2.0, 1.0, STEPS], np.float32))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Begin an episode with a new target."""
        super().reset(seed=seed)
        self.target, self.charge, self.time = self.np_random.uniform(0.0, 2.0), 0.0, 0
        return self._observation(), {}

    def _observation(self) -> np.ndarray:
        return np.array([self.target, self.charge, self.time], np.float32)

    def step(self, action: Any):
        """Press a key, or charge."""
        key = int(action[0])
        given = float(np.asarray(action[1][key]).item())
        duration = min(max(given, 0.0), HIGHS[key])
        Keys.outside += abs(given - duration) > 1e-6
        worth = (1.0, 0.5, 0.0)[key] * (1.0 - abs(duration - self.target)) * (1.0 + 2.0 * self.charge)
        self.charge = 1.0 - abs(duration - 0.4) / 0.4 if key == 2 else 0.0
        self.time += 1
        return self._observation(), worth, False, False, {}


def make() -> gymnasium.Env:
    """Return the problem with its time limit, which truncates."""
    return gymnasium.wrappers.TimeLimit(Keys(), STEPS)


class FlatKeys(gymnasium.ActionWrapper):
    """The action as one `Box` in [-1, 1]: a score for each key, of which the largest chooses, beside all durations."""

    def __init__(self, env: gymnasium.Env | None = None) -> None:
        super().__init__(env or make())
        self.action_space = Box(-1.0, 1.0, (6,))

    def action(self, action: np.ndarray):
        """Return the action of the problem."""
        return int(np.argmax(action[:3])), [(x + 1.0) / 2.0 * high for x, high in zip(action[3:], HIGHS, strict=True)]


class DictKeys(gymnasium.ActionWrapper):
    """The action as a `Dict` of a `Discrete` and one `Box` of all durations."""

    def __init__(self, env: gymnasium.Env | None = None) -> None:
        super().__init__(env or make())
        self.action_space = Dict(key=Discrete(3), durations=Box(np.zeros(3, np.float32), np.array(HIGHS, np.float32)))

    def action(self, action: dict[str, Any]):
        """Return the action of the problem."""
        return int(action["key"]), [[duration] for duration in action["durations"]]


@cache
def copies(make_env: Callable[[], gymnasium.Env]) -> list[gymnasium.Env]:
    """Return an environment for each of the fixed episodes."""
    return [make_env() for _ in EPISODE_SEEDS]


def way(act: Callable[[np.ndarray], Sequence[Any]], make_env: Callable[[], gymnasium.Env] = make) -> float:
    """Return how far a player is on the way from random play, 0, to the best policy, 1, in the fixed episodes.

    Args:
        act: returns the actions for observations `[200, 3]`.
        make_env: makes an environment that takes these actions.
    """
    envs = copies(make_env)
    seen = np.stack([env.reset(seed=seed)[0] for env, seed in zip(envs, EPISODE_SEEDS, strict=True)])
    random, best, total = RANDOM, BEST, 0.0
    for _ in range(STEPS):
        results = [env.step(action) for env, action in zip(envs, act(seen), strict=True)]
        seen = np.stack([result[0] for result in results])
        total += sum(result[1] for result in results) / len(envs)
    return (total - random) / (best - random)
