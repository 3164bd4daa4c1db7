"""The Platform domain as a batched TorchRL environment: over two gaps and two enemies to the end of a course.

Source: Masson, Ranchod & Konidaris 2016, arXiv:1509.01644; see `hpamdp.env.platform.rules`, also for the differences.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Categorical, Composite, Unbounded

from hpamdp import keys
from hpamdp.env import counter_rng
from hpamdp.env.actions import check_action_values
from hpamdp.env.base import PAMDPEnv
from hpamdp.env.columns import restored, where
from hpamdp.env.platform import rules
from hpamdp.env.platform.rules import PlatformState


class PlatformEnv(PAMDPEnv):
    """Cross the platforms in `num_envs` courses at once.

    Action leaves: `("action", "discrete")` int64 `[N]`: 0 run, 1 hop, 2 leap; `("action", "parameters")` float32
    `[N, 3]`: the power of a run in [0, 30] px/s a tick and the distances to hop in [0, 720] px and to leap in
    [0, 430] px. Only the parameter of the chosen action counts; outside its bounds it is clipped, NaN and infinity are
    refused. A run takes a second, a jump lasts until the agent lands.

    The reward is the distance covered as a share of the course, so an agent that arrives has the return 1. An episode
    terminates at the end of the course, in a gap or at an enemy.

    Args:
        num_envs: number of courses.
        max_steps: actions after which an episode is truncated; gym-platform has 200.
        noise: factor on the published noise of jumps, of the agent's speed and of the enemies' speed; 0 is none.
        device: of the tensors.
        seed: of the noise; the global generators are neither read nor moved. Nothing else is random, so
            `fixed_episodes` is None: `set_seed` and `reset` fix the episodes of an evaluation. With the same seed as
            training, these have the noise of training's first episodes, which no observation reveals in advance.
        first_env: number of the first course, where other processes have the courses before it.

    Raises:
        ValueError: an argument or an action is invalid; the state is unchanged.
    """

    discrete_names: ClassVar[tuple[str, ...]] = rules.ACTIONS
    parameter_dims = (1, 1, 1)
    result_keys = (keys.OUTCOME,)
    _state: PlatformState

    def __init__(
        self,
        num_envs: int = 1,
        *,
        max_steps: int = 200,
        noise: float = 1.0,
        device: torch.device | str | None = "cpu",
        seed: int = 0,
        first_env: int = 0,
    ) -> None:
        for name, value in (("num_envs", num_envs), ("max_steps", max_steps)):
            if value < 1:
                raise ValueError(f"PlatformEnv: {name}={value}, but must be at least 1")
        if not 0.0 <= noise < float("inf"):
            raise ValueError(f"PlatformEnv: noise={noise}, but must be a finite number of at least 0")
        super().__init__(device=device, batch_size=[num_envs])
        self.num_envs = num_envs
        self.max_steps = max_steps
        self.noise = noise
        self._environment = torch.arange(first_env, first_env + num_envs, dtype=torch.int32, device=self.device)
        self._parameter_high = torch.tensor(rules.PARAMETER_HIGH, device=self.device)
        self._make_specs()
        self._set_seed(seed)

    def initial_parameters(self) -> tuple[Tensor, Tensor]:
        """Return constants: run 3, hop 10, leap 400."""
        bias = 2.0 * torch.tensor(rules.INITIAL_PARAMETERS) / torch.tensor(rules.PARAMETER_HIGH) - 1.0
        return torch.zeros(len(bias), len(rules.OBSERVATION_NAMES)), bias

    def results(self, last: TensorDictBase) -> dict[str, Tensor]:
        """Return `success` bool `[M]`: whether the agent arrived."""
        return {"success": last.get(keys.OUTCOME) == rules.ARRIVED}

    def measure(self, played: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Return the best possible return as `ceiling`."""
        return {"ceiling": 1.0}

    def env_state(self) -> dict[str, Tensor]:
        """Return the columns of the state, `[N]` each."""
        return self._state._asdict()

    def set_env_state(self, columns: Mapping[str, Tensor]) -> None:
        """Continue from an `env_state`; an empty one starts new episodes.

        Raises:
            ValueError: they are not the columns of a state of this many environments.
        """
        if not columns:
            self._reset()
            return
        self._state = restored(columns, self._state, "PlatformEnv")

    def _make_specs(self) -> None:
        n = self.num_envs
        device = self.device
        self.observation_spec = Composite(
            observation=Unbounded(shape=(n, len(rules.OBSERVATION_NAMES)), device=device),
            outcome=Categorical(len(rules.OUTCOMES), shape=(n,), device=device),
            shape=(n,),
        )
        self.action_spec = self.make_action_spec(torch.zeros_like(self._parameter_high), self._parameter_high)
        self.reward_spec = Unbounded(shape=(n, 1), device=device)
        self.done_spec = self.make_done_spec()

    def _set_seed(self, seed: int | None) -> None:
        self._seed = counter_rng.seed_tensor(0 if seed is None else seed, self.device)
        self._state = rules.start(torch.full_like(self._environment, -1))

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        fresh = rules.start(self._state.episode + 1)
        self._state = fresh if mask is None else where(mask.reshape(self.num_envs), fresh, self._state)
        return self._read()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.check_action(tensordict)
        discrete = tensordict.get(keys.DISCRETE)
        parameters = tensordict.get(keys.PARAMETERS)
        check_action_values(discrete, parameters, self.parameter_dims)
        chosen = discrete.long()
        parameter = parameters.gather(-1, chosen.unsqueeze(-1)).squeeze(-1)
        parameter = parameter.clamp(min=0.0).minimum(self._parameter_high[chosen])
        before = self._state
        is_idle = before.outcome != rules.ON_THE_WAY
        mask = tensordict.get("_step", None)
        if mask is not None:
            is_idle = is_idle | ~mask.reshape(self.num_envs)
        # Rows that do not move simulate a run, which is shorter than a jump.
        simulated = torch.where(is_idle, rules.RUN, discrete)
        rng = counter_rng.key_for(self._seed, counter_rng.NOISE, self._environment, before.episode)
        after = rules.act(before, simulated, parameter, rng, self.noise)
        is_out_of_time = (after.steps >= self.max_steps) & (after.outcome == rules.ON_THE_WAY)
        after = after._replace(outcome=torch.where(is_out_of_time, rules.TIME_LIMIT, after.outcome))
        self._state = where(is_idle, before, after)
        reward = (self._state.x - before.x) / rules.END
        return self._read().set(keys.REWARD, reward.unsqueeze(-1))

    def _read(self) -> TensorDict:
        outcome = self._state.outcome.long()
        done = (outcome != rules.ON_THE_WAY).unsqueeze(-1)
        truncated = (outcome == rules.TIME_LIMIT).unsqueeze(-1)
        leaves = {
            keys.OBSERVATION: rules.observe(self._state),
            keys.OUTCOME: outcome,
            keys.DONE: done,
            keys.TERMINATED: done & ~truncated,
            keys.TRUNCATED: truncated,
        }
        return TensorDict(leaves, batch_size=self.batch_size, device=self.device)
