"""Gymnasium environments that forbid actions, and some that have options."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

UNIT = spaces.Box(-1.0, 1.0, (1,))
PAIR = spaces.Tuple([spaces.Discrete(2), spaces.Tuple([UNIT, UNIT])])
SPACES: dict[str, spaces.Space] = {
    "plain": PAIR,
    "dict": spaces.Dict(option=spaces.Discrete(3, start=1), action=PAIR),
    "flat dict": spaces.Dict(
        option=spaces.Discrete(3, start=1), kind=spaces.Discrete(2), by=spaces.Tuple([UNIT, UNIT])
    ),
    "tuple": spaces.Tuple([spaces.Discrete(3, start=1), PAIR]),
    "named option": spaces.Dict(option=spaces.Discrete(2), by=spaces.Tuple([UNIT, UNIT])),
    "one of": spaces.OneOf([UNIT, spaces.Box(0.0, 2.0, (2,))]),
}


class Masked(gymnasium.Env):
    """Record every action; forbid the action that was just taken, and say so in the info or in the observation.

    Args:
        form: of the action space, from SPACES.
        source: `info`, `observation` or `none`: where the mask is.
        mask: what is given instead of it.
    """

    option_names = ("slow", "medium", "fast")

    def __init__(self, form: str = "plain", source: str = "info", mask: Any = None):
        self.action_space = SPACES[form]
        self.observation_space = spaces.Box(0.0, 9.0, (1,))
        if source == "observation":
            masked = {"place": self.observation_space, "action_mask": spaces.MultiBinary(2)}
            self.observation_space = spaces.Dict(masked)
        self.source = source
        self.mask = mask
        self.actions: list[Any] = []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        self.last = 0
        return self._observation(), self._info()

    def step(self, action):
        assert self.action_space.contains(action), action
        self.actions.append(action)
        self.steps += 1
        discrete = action["action"][0] if isinstance(action, dict) and "action" in action else action
        self.last = int(discrete[0]) if isinstance(discrete, tuple) and np.ndim(discrete[0]) == 0 else 0
        return self._observation(), 0.0, False, False, self._info()

    def _mask(self):
        return np.arange(2) != self.last if self.mask is None else self.mask

    def _info(self):
        return {"action_mask": self._mask()} if self.source == "info" else {}

    def _observation(self):
        place = np.float32([self.steps])
        return {"place": place, "action_mask": self._mask()} if self.source == "observation" else place
