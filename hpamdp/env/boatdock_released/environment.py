"""The boat-docking environment released with the benchmark's paper. Its rules differ from the paper's.

Source: the code released with *A Benchmark for Hierarchical Parameterized Action Markov Decision Process*. It is kept
to put the paper's table in context. `experiments/released` shows why returns here do not measure skill. It shares no
rules with `BoatDockEnv`.
Differs from the source:
- It simulates many environments at once.
- Layouts come from counters instead of NumPy's global generator.
- Observations may be `scaled`, and each episode may have a new layout.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from hpamdp import keys
from hpamdp.env import counter_rng
from hpamdp.env.base import PAMDPEnv
from hpamdp.env.batched_env import Action, BatchedEnv
from hpamdp.env.boatdock_released import rules as released
from hpamdp.env.boatdock_released.options import CARDS, ReleasedBoatDockOptions
from hpamdp.env.boatdock_released.rules import ReleasedState
from hpamdp.env.counter_rng import RngKey
from hpamdp.env.state_columns import check_range, where


class ReleasedBoatDockEnv(BatchedEnv[ReleasedState]):
    """A batch of environments under the rules of the released code.

    Action leaves:
    - `("action", "discrete")`: the key, in {0, 1, 2}, int64 `[N]`.
    - `("action", "parameters")`: a duration u in [-1, 1] for each key, float32 `[N, 3]`. Only the pressed key's
      duration counts. It is clipped to its bounds. NaN and infinity are errors.

    A press takes 2.5 (u + 1) seconds and burns u units of fuel, so u < 0 *re*fuels.

    Rewards:
    - Docking gives 10 x fuel / 5.
    - An empty tank gives -1.
    - The left wall, the upper wall and the time limit give 0.
    - Any other press gives the decrease of the distance to the goal, as a fraction of the distance at the start.

    The observation after an episode's last step shows the boat and the distance from before that step.

    An environment always keeps its controller, so no selector can be used with it.

    `float_type`, which a subclass may set, is the type of the computation and its results. Durations are always
    rounded in float32. For the constructor's arguments see `BatchedEnv`.

    `reset` also takes layouts, which the environments keep: a tensordict with `start` and `goal` `[N, 2]` in screen px
    and, for the incongruent controller, optionally `keymap` int `[N]`.

    Raises:
        ValueError: an argument, action or layout is invalid; the state is unchanged.
    """

    Options = ReleasedBoatDockOptions
    card = CARDS["ReleasedBoatDockEnv"]
    options: ReleasedBoatDockOptions
    outcomes = released.OUTCOMES
    parameter_dims = (1, 1, 1)
    parameter_low = (-1.0,) * 3
    parameter_high = (1.0,) * 3
    start_keys = frozenset({"start", "goal", "keymap"})
    action_names = ("key", "durations")
    position = None  # evaluations keep no paths

    def _prepare(self) -> None:
        self._is_congruent = self.options.controller == "congruent"
        self._is_scaled = self.options.observation == "scaled"
        self.observation_names = released.SCALED_NAMES if self._is_scaled else released.OBSERVATION_NAMES
        directions = released.DIRECTIONS[self.options.controller]
        self._directions = torch.tensor(directions, dtype=self.float_type, device=self.device)

    def seed_evaluation(self, seed: int) -> None:
        """Seed the key maps of an evaluation. Its layouts come from `fixed_episodes`."""
        PAMDPEnv.seed_evaluation(self, seed)

    def fixed_episodes(self, seed: int) -> TensorDict:
        """Return evaluation layouts for `reset`, one per environment. Their random stream is not that of training."""
        episode = torch.zeros_like(self._environment)
        seed_tensor = counter_rng.seed_tensor(seed, self.device)
        rng = counter_rng.rng_key(seed_tensor, counter_rng.EVALUATION, self._environment, episode)
        points = released.sample_layouts(rng, self.options.test_mode).to(self.float_type)
        layout = {"start": points[:, :2], "goal": points[:, 2:]}
        return TensorDict(layout, batch_size=self.batch_size, device=self.device)

    def describe(self) -> dict[str, Tensor]:
        """Return `start` and `goal` of the episodes, `[N, 2]` screen px."""
        points = torch.stack(self._state[:4], -1)
        return {"start": points[:, :2], "goal": points[:, 2:]}

    def results(self, last: TensorDictBase) -> dict[str, Tensor]:
        """Return `outcome` and `success` `[M]`. There is no score of its own, so the return serves as the score."""
        outcome = last.get(keys.OUTCOME)
        return {"outcome": outcome, "success": outcome == released.SUCCESS}

    def summary_entries(self) -> dict[str, str]:
        """Return the `controller`."""
        return {"controller": self.options.controller}

    def measure(self, played: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Return the fraction of episodes with each outcome but success.

        There is no ceiling, because idling refuels without limit.
        """
        return {
            released.OUTCOMES[code]: float((played["outcome"] == code).mean())
            for code in (released.WALL, released.OUT_OF_FUEL, released.TIME_LIMIT)
        }

    def check_env_state(self, columns: Mapping[str, Tensor]) -> None:
        """Check that key maps, counters and outcomes are valid.

        Raises:
            ValueError: a number is out of range.
        """
        super().check_env_state(columns)
        check_range(columns, {"keymap": (released.NO_KEYMAP, 2)})

    def start(self, episode: Tensor, rng: RngKey) -> ReleasedState:
        """Return the states of environments that have no layout yet."""
        integer_zeros = torch.zeros_like(episode)
        zeros = integer_zeros.to(self.float_type)
        keymap = released.NO_KEYMAP if self._is_congruent else self.options.keymap
        columns = dict.fromkeys(ReleasedState._fields[:9], zeros)
        return ReleasedState(
            **columns, keymap=integer_zeros + keymap, steps=integer_zeros, outcome=integer_zeros, episode=episode
        )

    def restart(self, state: ReleasedState, mask: Tensor) -> ReleasedState:
        """Return the states with new episodes in the rows of `mask` `[N]`.

        As released, boats keep their velocity, a key map of 1, and by default their layout.
        """
        episode = state.episode + 1
        rng = counter_rng.rng_key(self._seed, counter_rng.TRAINING, self._environment, episode)
        points = torch.stack(state[:4], -1)
        is_due = mask & (state.episode == -1) if self.options.frozen_layouts else mask
        if is_due.any():
            due = rng._replace(bits=rng.bits[is_due])
            points[is_due] = released.sample_layouts(due, self.options.test_mode).to(points)
        start_x, start_y, goal_x, goal_y = points.unbind(-1)
        sampled = (counter_rng.uniform(rng, released.INDEX_KEYMAP) < 0.5).to(torch.int32)
        fresh = state._replace(
            start_x=start_x,
            start_y=start_y,
            goal_x=goal_x,
            goal_y=goal_y,
            x=start_x,
            y=start_y,
            # As released, the velocity of the previous episode's last press remains.
            fuel=torch.full_like(state.fuel, released.TANK),
            keymap=torch.where(state.keymap == 0, sampled, state.keymap),
            steps=torch.zeros_like(state.steps),
            outcome=torch.full_like(state.outcome, released.SAILING),
            episode=episode,
        )
        return where(mask, fresh, state)

    def act(self, state: ReleasedState, action: Action, rng: RngKey, is_idle: Tensor) -> tuple[ReleasedState, Tensor]:
        """Return the states after one press, and the rewards `[N]`."""
        direction = self._directions[state.keymap.clamp(min=0).long(), action.discrete]
        return released.press(state, direction, action.parameters.squeeze(-1), self.max_steps)

    def observe(self, state: ReleasedState) -> Tensor:
        """Return the observations, `[N, 15]`, or `[N, 17]` if scaled."""
        return released.observe(state, self._is_congruent, self._is_scaled)

    def start_columns(self, given: Mapping[str, np.ndarray]) -> Mapping[str, np.ndarray]:
        """Check a layout and return the columns of the state that it sets."""
        num, low = self.num_envs, np.array(released.LOW, np.float32)
        points = {}
        for name in ("start", "goal"):
            point = given.get(name)
            if point is None or point.shape != (num, 2):
                shape = None if point is None else list(point.shape)
                raise ValueError(f"reset: {name} has shape {shape}, but must be [{num}, 2] (screen px)")
            points[name] = point.astype(np.float64 if self.float_type == torch.float64 else np.float32)
            if not ((points[name] >= low) & (points[name] < low + released.SIZE)).all():
                bounds = [f"[{corner}, {corner + released.SIZE}]" for corner in released.LOW]
                raise ValueError(f"reset: a {name} lies outside x in {bounds[0]}, y in {bounds[1]} (screen px)")
        if not (np.linalg.norm(points["start"] - points["goal"], axis=-1) >= 1.0).all():
            raise ValueError("reset: a start lies within 1 px of its goal")
        (start_x, start_y), (goal_x, goal_y) = points["start"].T, points["goal"].T
        columns = {"start_x": start_x, "start_y": start_y, "goal_x": goal_x, "goal_y": goal_y}
        columns |= {"x": start_x, "y": start_y}
        keymap = given.get("keymap")
        if keymap is None:
            return columns
        if self._is_congruent:
            raise ValueError("reset: keymap is given, but the congruent controller has none")
        if keymap.shape != (num,) or not ((keymap == 0) | (keymap == 1)).all():
            raise ValueError(f"reset: keymap must be 0 or 1 in shape [{num}]")
        return {**columns, "keymap": keymap.astype(np.int32)}
