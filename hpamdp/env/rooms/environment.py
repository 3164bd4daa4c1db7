"""Rooms as a batched TorchRL environment: options that suit a room each, and a way through three of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from hpamdp.env.batched_env import Action, BatchedEnv
from hpamdp.env.counter_rng import RngKey
from hpamdp.env.rooms import rendering, rules
from hpamdp.env.rooms.options import CARDS, RoomsOptions
from hpamdp.env.rooms.rules import RoomsState


class RoomsEnv(BatchedEnv[RoomsState]):
    """Find the goal in `num_envs` houses of four rooms at once.

    Action leaves: `option` int64 `[N]`: 0 skates, 1 boots; `("action", "discrete")` int64 `[N]`: up, right, down, left;
    `("action", "parameters")` float32 `[N, 4]`: how far, as a fraction of the reach, in [0, 1]. The reach is three
    cells with the option that suits the floor, else one. The option may change at every step.

    The reward is -0.02 a step, and 1 at the goal, which ends the episode. It begins anywhere in the first room.

    Only the start is random. For the constructor's arguments and errors see `BatchedEnv`.
    """

    Options = RoomsOptions
    card = CARDS["RoomsEnv"]
    options: RoomsOptions
    outcomes: ClassVar[tuple[str, ...]] = rules.OUTCOMES
    observation_names = (
        "x",
        "y",
        *(f"x_{i}" for i in range(rules.SIZE)),
        *(f"y_{i}" for i in range(rules.SIZE)),
    )
    discrete_names = ("up", "right", "down", "left")
    parameter_dims = (1, 1, 1, 1)
    parameter_low = (0.0,) * 4
    parameter_high = (1.0,) * 4

    @property
    def observation_bounds(self) -> tuple[Sequence[float], Sequence[float]]:
        """The lowest and the highest observation, `[24]` each."""
        return [-1.0] * 2 + [0.0] * 2 * rules.SIZE, [1.0] * (2 + 2 * rules.SIZE)

    @property
    def position(self) -> Tensor:
        """The cells of the agents, `[N, 2]`."""
        return torch.stack([self.state.x, self.state.y], -1).float()

    def start(self, episode: Tensor, rng: RngKey) -> RoomsState:
        """Return states with the agent anywhere in the first room."""
        return rules.start(episode, rng)

    def act(self, state: RoomsState, action: Action, rng: RngKey, is_idle: Tensor) -> tuple[RoomsState, Tensor]:
        """Return the states after one move and the rewards `[N]`."""
        assert action.option is not None
        return rules.act(state, action.option, action.discrete, action.parameters.squeeze(-1))

    def observe(self, state: RoomsState) -> Tensor:
        """Return the observations `[N, 24]`."""
        return rules.observe(state)

    def describe(self) -> dict[str, Tensor]:
        """Return the best possible return from where the episodes begin, `best_return` `[N]`."""
        best = rules.best_values(1.0, 1).to(self.device)
        return {"best_return": best[self.state.x.long(), self.state.y.long()]}

    def measure(self, played: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Return the mean of the best possible returns, with options that may change at every step, as `ceiling`."""
        return {"ceiling": float(played["best_return"].mean())} if "best_return" in played else {}

    def draw(self, track: Sequence[RoomsState]) -> np.ndarray:
        """Return a picture of the rooms and the way so far, uint8 `[480, 480, 3]`."""
        path = [(int(state.x), int(state.y)) for state in track]
        return rendering.draw(path, int(track[-1].outcome))
