"""Define a Gymnasium environment with parameterised actions, without using hpamdp."""

from __future__ import annotations

import gymnasium
import numpy as np
from gymnasium import spaces


class Thermostat(gymnasium.Env):
    """Keep a room at 20 degrees: wait, heat with some power, or open the window for some time.

    The action is `Tuple(Discrete(3), Tuple(Box(0), Box(1), Box(1)))`: 0 waits, 1 heats with a power in [0, 3] kW, and 2
    airs for [0, 10] minutes. The observation holds the room's and the outside temperature. The reward is minus the
    distance to 20 degrees and minus the cost of heating. An episode lasts 24 hours.
    """

    def __init__(self, outside: float = 5.0) -> None:
        self.outside = outside
        self.observation_space = spaces.Box(np.float32([-20.0, -20.0]), np.float32([50.0, 50.0]))
        parameters = (spaces.Box(0.0, 1.0, (0,)), spaces.Box(0.0, 3.0, (1,)), spaces.Box(0.0, 10.0, (1,)))
        self.action_space = spaces.Tuple((spaces.Discrete(3), spaces.Tuple(parameters)))

    def reset(self, *, seed=None, options=None):
        """Start at midnight, in a room of 10 to 25 degrees."""
        super().reset(seed=seed)
        self.room = self.np_random.uniform(10.0, 25.0)
        self.hour = 0
        return self._observe(), {}

    def step(self, action):
        """Let an hour pass."""
        discrete, parameters = action
        power = float(parameters[1][0]) if discrete == 1 else 0.0
        airing = float(parameters[2][0]) if discrete == 2 else 0.0
        loss = 0.05 + 0.05 * airing
        self.room += 4.0 * power - loss * (self.room - self.outside) + self.np_random.normal(0.0, 0.2)
        self.room = float(np.clip(self.room, -20.0, 50.0))
        self.hour += 1
        error = abs(self.room - 20.0)
        reward = -0.1 * error - 0.02 * power
        return self._observe(), reward, False, self.hour >= 24, {"is_success": error < 1.0}

    def _observe(self) -> np.ndarray:
        return np.array([self.room, self.outside], dtype=np.float32)
