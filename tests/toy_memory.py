"""Cue, a problem that cannot be solved without memory: its first observation says what pays in its last step."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded
from toy_env import ToyEnv

from hpamdp import keys


class Cue(ToyEnv):
    """See a cue of -1 or 1 in the first step, then the time alone; only the last of `length` steps is rewarded.

    The right discrete action, 1 for a positive cue, earns 1 less the distance of its parameter from half the cue. The
    other one earns -1. So the best return is 1, and the best one without memory 0 on average.

    Args:
        num_envs: environments of the batch.
        length: steps of an episode.
        seed: of the cues.
        device: where the tensors live.
    """

    parameter_dims = (1, 1)

    def __init__(self, num_envs: int = 1, *, length: int = 4, seed: int = 0, device: object = "cpu") -> None:
        super().__init__(device=device, batch_size=[num_envs])
        self.max_steps = length
        self.begin(-1.0, 1.0, seed, observation=Bounded(-1.0, 1.0, shape=(num_envs, 2)))

    def _set_seed(self, seed: int | None) -> None:
        self.generator = torch.Generator().manual_seed(seed or 0)
        self.cue = torch.zeros(self.batch_size)
        self.steps = torch.zeros(self.batch_size, dtype=torch.long)

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        mask = self.reset_mask(tensordict)
        cue = torch.randint(2, self.batch_size, generator=self.generator) * 2.0 - 1.0
        self.cue = torch.where(mask, cue, self.cue)
        self.steps = torch.where(mask, 0, self.steps)
        return self._read()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        is_last = self.steps == self.max_steps - 1
        reward = torch.where(is_last, self.earned(tensordict), 0.0)
        self.steps = (self.steps + 1).clamp(max=self.max_steps)
        return self._read().set(keys.REWARD, reward.unsqueeze(-1))

    def earned(self, tensordict: TensorDictBase) -> Tensor:
        """Return what the actions of a last step earn, `[N]`."""
        chosen = (self.cue > 0.0).long()
        parameter = tensordict[keys.PARAMETERS].gather(-1, chosen.unsqueeze(-1)).squeeze(-1)
        return torch.where(tensordict[keys.DISCRETE] == chosen, 1.0 - (parameter - 0.5 * self.cue).abs(), -1.0)

    def _read(self) -> TensorDict:
        cue = torch.where(self.steps == 0, self.cue, 0.0)
        observation = torch.stack([cue, self.steps / self.max_steps], -1)
        terminated = (self.steps >= self.max_steps).unsqueeze(-1)
        return TensorDict({keys.OBSERVATION: observation, **self.flags(terminated)}, self.batch_size)
