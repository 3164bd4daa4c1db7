"""A problem in which some actions, and some options, are forbidden at times; the forbidden ones would pay best."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded
from toy_env import ToyEnv

from hpamdp import keys

NUM_DISCRETE = 3
NUM_OPTIONS = 3


class Forbidden(ToyEnv):
    """Four steps, at each of which one of three actions is forbidden; the observation is its one-hot number.

    An allowed action pays 0.1 times the mean of its parameter's distance from -1; a forbidden one pays 100. The same
    holds for the options, of which the same number is forbidden. Violations are counted.
    """

    option_names = ("first", "second", "third")
    parameter_dims = (1, 1, 1)
    max_steps = 4

    def __init__(
        self,
        num_envs: int = 1,
        *,
        has_option: bool = False,
        is_empty: bool = False,
        seed: int = 0,
        device: object = "cpu",
    ) -> None:
        super().__init__(device=device, batch_size=[num_envs])
        n = num_envs
        self.has_option = has_option
        self.is_empty = is_empty
        self.violations = 0
        leaves = {
            keys.OBSERVATION: Bounded(0.0, 1.0, shape=(n, NUM_DISCRETE)),
            keys.ACTION_MASK: Binary(NUM_DISCRETE, shape=(n, NUM_DISCRETE), dtype=torch.bool),
        }
        if has_option:
            leaves[keys.OPTION_MASK] = Binary(NUM_OPTIONS, shape=(n, NUM_OPTIONS), dtype=torch.bool)
        self.begin(-1.0, 1.0, seed, has_option=has_option, **leaves)

    def _set_seed(self, seed: int | None) -> None:
        self.generator = torch.Generator().manual_seed(seed or 0)
        self.forbidden = torch.zeros(self.batch_size, dtype=torch.long)
        self.steps = torch.zeros(self.batch_size, dtype=torch.long)

    def _draw(self) -> Tensor:
        return torch.randint(NUM_DISCRETE, self.batch_size, generator=self.generator)

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        mask = self.reset_mask(tensordict)
        self.forbidden = torch.where(mask, self._draw(), self.forbidden)
        self.steps = torch.where(mask, 0, self.steps)
        return self._read()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        discrete = tensordict[keys.DISCRETE]
        over = self.steps >= self.max_steps
        is_forbidden = discrete == self.forbidden
        if self.has_option and (self.steps == 0).any():
            is_forbidden = is_forbidden | ((tensordict[keys.OPTION] == self.forbidden) & (self.steps == 0))
        is_forbidden = is_forbidden & ~over
        self.violations += int(is_forbidden.sum())
        own = tensordict[keys.PARAMETERS].gather(-1, discrete.unsqueeze(-1)).squeeze(-1)
        reward = torch.where(is_forbidden, 100.0, 0.05 * (1.0 + own))
        self.steps = self.steps + ~over
        self.forbidden = torch.where(over, self.forbidden, self._draw())
        return self._read().set(keys.REWARD, torch.where(over, 0.0, reward).unsqueeze(-1))

    def _read(self) -> TensorDict:
        one_hot = torch.nn.functional.one_hot(self.forbidden, NUM_DISCRETE)
        terminated = (self.steps >= self.max_steps).unsqueeze(-1)
        leaves = {
            keys.OBSERVATION: one_hot.float(),
            # Where the episode is over, nothing is allowed, as in some problems.
            keys.ACTION_MASK: (one_hot == 0) & ~terminated & (not self.is_empty),
            **self.flags(terminated),
        }
        if self.has_option:
            leaves[keys.OPTION_MASK] = (one_hot == 0) & ~terminated
        return TensorDict(leaves, self.batch_size)
