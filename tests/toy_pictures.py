"""Gymnasium environments that observe pictures: alone, and among vectors."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces

ACTIONS = spaces.Tuple([spaces.Discrete(2), spaces.Tuple([spaces.Box(-1.0, 1.0, (1,)), spaces.Box(-1.0, 1.0, (0,))])])
NUM_STEPS = 5


class Camera(gymnasium.Env):
    """A picture with channels last, in which each pixel differs; the reward is the parameter."""

    observation_space: spaces.Space = spaces.Box(0, 255, (36, 40, 3), np.uint8)
    action_space = ACTIONS
    channels_first: ClassVar[bool] = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        self.steps = 0
        self.offset = int(self.np_random.integers(256))
        return self.observation(), {}

    def picture(self) -> np.ndarray:
        """Return the picture of the current step, uint8 `[36, 40, 3]`."""
        return ((np.arange(36 * 40 * 3) + self.offset + 31 * self.steps) % 256).astype(np.uint8).reshape(36, 40, 3)

    def observation(self) -> Any:
        return self.picture()

    def step(self, action: Any):
        self.steps += 1
        return self.observation(), float(action[1][0][0]), self.steps >= NUM_STEPS, False, {}


class Mixed(Camera):
    """A picture with channels first beside a vector, a choice and a small board, which is no picture."""

    observation_space = spaces.Dict(
        camera=spaces.Box(0, 255, (3, 36, 40), np.uint8),
        board=spaces.Box(0, 255, (4, 4), np.uint8),
        gear=spaces.Discrete(3),
        speed=spaces.Box(-2.0, 2.0, (2,)),
    )

    def observation(self) -> Any:
        return {
            "camera": self.picture().transpose(2, 0, 1),
            "board": np.full((4, 4), 51, np.uint8),
            "gear": self.steps % 3,
            "speed": np.array([1.0, -0.5], np.float32),
        }


class TwoOptions(Camera):
    """A picture, and an option that the agent chooses."""

    action_space = spaces.Dict(option=spaces.Discrete(2), action=ACTIONS)

    def step(self, action: Any):
        return super().step(action["action"])
