"""Define Crossing, a problem whose best option changes within an episode, and compute the best values of its states."""

from __future__ import annotations

from typing import ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, Unbounded

from hpamdp import keys
from hpamdp.env.base import PAMDPEnv

WALK, SWIM = 0, 1
STEP, REST = 0, 1
LENGTH = 6.0  # of the way
SHORE = 3.0  # where land ends and water begins
SLOW = 0.25  # length of a whole step with the wrong option
NUM_CELLS = int(LENGTH / SLOW) + 1


class Crossing(PAMDPEnv):
    """Walk over land, then swim through water. Only the arrival is rewarded, with 1.

    Discrete action 0 makes a step, and its parameter in [0, 1] is the fraction of a whole step. Action 1 rests, and its
    parameter has no effect. A whole step has length 1 with the option that suits the place and length `SLOW` with the
    other. The observation is the one-hot index of the place, in units of `SLOW`. Episodes start at a random place in
    the first `start` of the way.
    """

    option_names = ("walk", "swim")
    parameter_dims = (1, 1)
    max_steps: int = 30
    result_keys: ClassVar[tuple[str, ...]] = ("place",)

    def __init__(self, num_envs: int = 1, *, start: float = 0.0, seed: int = 0, device: object = "cpu") -> None:
        super().__init__(device=device, batch_size=[num_envs])
        self.start = start
        n = num_envs
        self.observation_spec = Composite(
            observation=Bounded(0.0, 1.0, shape=(n, NUM_CELLS)), place=Bounded(0.0, LENGTH, shape=(n, 1)), shape=(n,)
        )
        action = Composite(discrete=Categorical(2, shape=(n,)), parameters=Bounded(0.0, 1.0, shape=(n, 2)), shape=(n,))
        self.action_spec = Composite(action=action, option=Categorical(2, shape=(n,)), shape=(n,))
        self.reward_spec = Unbounded(shape=(n, 1))
        self.done_spec = self.make_done_spec()
        self._set_seed(seed)

    def results(self, last: TensorDictBase) -> dict[str, Tensor]:
        """Return whether episodes arrived, bool `[M]`."""
        return {"success": last["place"].squeeze(-1) >= LENGTH}

    def _set_seed(self, seed: int | None) -> None:
        self.generator = torch.Generator().manual_seed(seed or 0)
        self.place = torch.zeros(self.batch_size)
        self.steps = torch.zeros(self.batch_size)

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        mask = self.reset_mask(tensordict)
        fresh = torch.rand(self.batch_size, generator=self.generator) * self.start
        self.place = torch.where(mask, (fresh / SLOW).floor() * SLOW, self.place)
        self.steps = torch.where(mask, 0.0, self.steps)
        return self._read()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        fraction = tensordict[keys.PARAMETERS][:, STEP].clamp(0.0, 1.0)
        over = (self.place >= LENGTH) | (self.steps >= self.max_steps)
        whole = torch.where(tensordict[keys.OPTION] == (self.place >= SHORE), 1.0, SLOW)
        way = torch.where((tensordict[keys.DISCRETE] == REST) | over, 0.0, fraction * whole)
        self.place = (self.place + way).clamp(max=LENGTH)
        self.steps = self.steps + ~over
        return self._read().set(keys.REWARD, ((self.place >= LENGTH) & ~over).float().unsqueeze(-1))

    def _read(self) -> TensorDict:
        place = self.place.unsqueeze(-1)
        terminated = place >= LENGTH
        truncated = (self.steps >= self.max_steps).unsqueeze(-1) & ~terminated
        flags = {keys.TERMINATED: terminated, keys.TRUNCATED: truncated, keys.DONE: terminated | truncated}
        return TensorDict({keys.OBSERVATION: observe(cell_of(self.place)), "place": place, **flags}, self.batch_size)


def cell_of(place: Tensor) -> Tensor:
    """Return the cell, int64 `[N]`, of each place `[N]`."""
    return (place / SLOW).floor().long()


def observe(cell: Tensor) -> Tensor:
    """Return the observations `[N, NUM_CELLS]` of cells `[N]`."""
    return (cell.unsqueeze(-1) == torch.arange(NUM_CELLS)).float()


def best_values(gamma: float, option_length: int) -> list[float]:
    """Return the best discounted return from the beginning of every cell, at a decision; 0 for the last cell.

    The values follow by dynamic programming from the end of the way. The best actions are whole steps.

    Args:
        gamma: discount of a step.
        option_length: steps after which an option ends. If 1, options can change at every step.
    """
    quick = round(1.0 / SLOW)
    value = [0.0] * NUM_CELLS

    def of(option: int, cell: int) -> float:
        for step in range(option_length):
            cell += quick if (option == SWIM) == (cell >= round(SHORE / SLOW)) else 1
            if cell >= NUM_CELLS - 1:
                return gamma**step
        return gamma**option_length * value[cell]

    for cell in range(NUM_CELLS - 2, -1, -1):
        value[cell] = max(of(WALK, cell), of(SWIM, cell))
    return value
