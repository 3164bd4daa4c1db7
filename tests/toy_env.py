"""What the toy problems share: their specs, and the flags of ended episodes."""

from __future__ import annotations

import torch
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded

from hpamdp import keys
from hpamdp.env.base import PAMDPEnv


class ToyEnv(PAMDPEnv):
    """A problem on the CPU whose parameters all have the same bounds."""

    def begin(self, low: float, high: float, seed: int, *, has_option: bool = False, **observed: TensorSpec) -> None:
        """Make the specs, given those of the observation, and set the seed."""
        self.observation_spec = Composite(observed, shape=self.batch_size)
        ones = torch.ones(sum(self.parameter_dims))
        self.action_spec = self.make_action_spec(low * ones, high * ones, has_option=has_option)
        self.reward_spec = Unbounded(shape=(*self.batch_size, 1))
        self.done_spec = self.make_done_spec()
        self._set_seed(seed)

    def flags(self, terminated: Tensor, truncated: Tensor | None = None) -> dict[str, Tensor]:
        """Return the leaves of a reading that say where episodes are over, bool `[N, 1]`; truncated ones are rare."""
        truncated = torch.zeros_like(terminated) if truncated is None else truncated
        return {keys.TERMINATED: terminated, keys.TRUNCATED: truncated, keys.DONE: terminated | truncated}
