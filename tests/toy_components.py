"""One-step problems whose action has two components, with known best actions, and a data set of random ones."""

from __future__ import annotations

from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded
from toy_env import ToyEnv

from hpamdp import keys


class OneStep(ToyEnv):
    """Choose two of two discrete actions with a parameter each, and three without; the observation is one coin.

    The parameter of what the first component chose should be 0.4. How the components pay depends on `pays`:

    - `each`: 0.5 for a first component equal to the coin, and 0.5 for a second one of 2;
    - `climbing`: 1 for the pair (0, 0), but -2 for a first component of 0 with any other second one. On average over
      the other component, 1 pays more than 0 in the first one, and 1 or 2 more than 0 in the second: at most 0.5.

    Args:
        num_envs: number of environments.
        pays: see above.
        forbids_pairs: whether a `pair_mask` forbids what does not match.
        seed: of the coins.
        device: of the tensors.
    """

    parameter_dims = (1, 1, 0, 0, 0)
    component_sizes = (2, 3)
    max_steps = 1

    def __init__(
        self,
        num_envs: int = 1,
        *,
        pays: Literal["each", "climbing"] = "each",
        forbids_pairs: bool = False,
        seed: int = 0,
        device: object = "cpu",
    ) -> None:
        super().__init__(device=device, batch_size=[num_envs])
        n = num_envs
        self.pays = pays
        self.forbids_pairs = forbids_pairs
        self.violations = 0
        observed = {keys.OBSERVATION: Bounded(0.0, 1.0, shape=(n, 2))}
        if forbids_pairs:
            observed[keys.PAIR_MASK] = Binary(5, shape=(n, 5, 5), dtype=torch.bool)
        self.begin(-1.0, 1.0, seed, **observed)

    def _set_seed(self, seed: int | None) -> None:
        self.generator = torch.Generator().manual_seed(seed or 0)
        self.coin = torch.zeros(self.batch_size, dtype=torch.long)

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        drawn = torch.randint(2, self.batch_size, generator=self.generator)
        self.coin = torch.where(self.reset_mask(tensordict), drawn, self.coin)
        return self._read(is_over=False)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.check_action(tensordict)
        discrete = tensordict[keys.DISCRETE]
        own = tensordict[keys.PARAMETERS].gather(-1, discrete[:, :1]).squeeze(-1)
        self.violations += int((self.forbids_pairs & (discrete[:, 0] != discrete[:, 1])).sum())
        td = self._read(is_over=True)
        return td.set(keys.REWARD, self.pay(self.coin, discrete, own).unsqueeze(-1))

    def pay(self, coin: Tensor, discrete: Tensor, own: Tensor) -> Tensor:
        """Return the rewards `[N]`; the best is 1."""
        first, second = discrete.unbind(-1)
        near = -(own - 0.4).square()
        if self.pays == "each":
            return 0.5 * (first == coin) + 0.5 * (second == 2) + near
        return torch.tensor([[1.0, -2.0, -2.0], [-0.5, 0.5, 0.5]])[first, second] + near

    def _read(self, *, is_over: bool) -> TensorDict:
        n = self.batch_size
        td = TensorDict(self.flags(torch.full((*n, 1), is_over)), n)
        td.set(keys.OBSERVATION, torch.nn.functional.one_hot(self.coin, 2).float())
        if self.forbids_pairs:
            pairs = torch.ones(5, 5, dtype=torch.bool)
            pairs[:2, 2:] = torch.eye(2, 3, dtype=torch.bool)
            td.set(keys.PAIR_MASK, pairs.expand(*n, 5, 5).clone())
        return td


def random_steps(env: OneStep, num: int) -> TensorDict:
    """Return `num` episodes of uniformly random actions, `[num, 1]`, for learners from data sets."""
    coin = torch.randint(2, (num,))
    discrete = torch.stack([torch.randint(2, (num,)), torch.randint(3, (num,))], -1)
    parameters = 2.0 * torch.rand(num, 2) - 1.0
    own = parameters.gather(-1, discrete[:, :1]).squeeze(-1)
    observation = torch.nn.functional.one_hot(coin, 2).float()
    done = torch.ones(num, 1, dtype=torch.bool)
    after = {keys.OBSERVATION: observation, keys.REWARD: env.pay(coin, discrete, own).unsqueeze(-1), keys.DONE: done}
    after |= {keys.TERMINATED: done, keys.TRUNCATED: ~done, keys.IS_DECISION: done}
    steps = {keys.OBSERVATION: observation, "next": TensorDict(after, [num]), keys.IS_DECISION: done}
    steps[keys.ACTION] = TensorDict({"discrete": discrete, "parameters": parameters}, [num])
    return TensorDict(steps, [num]).unsqueeze(-1)
