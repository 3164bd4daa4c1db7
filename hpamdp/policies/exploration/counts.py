"""A reward for reaching states that were seldom visited, by counting visits of cells.

Source: Tang, Houthooft, Foote, Stooke, Chen, Duan, Schulman, De Turck and Abbeel, *#Exploration: A Study of Count-Based
Exploration for Deep Reinforcement Learning*, 2017, arXiv 1611.04717, section 2.2: states are hashed, and a state whose
hash was counted n times has the bonus n^-1/2.

Differs from the source:
- a state's cell is its observation, multiplied by `resolution` and rounded. The source's random projections suit
  pictures. Of a vector, they would mix entries of different meaning, such as a place and what the agent holds;
- the bonus of a step is that of the state that it reaches, not of the state that it leaves;
- there is one table. The authors' code takes the lowest count of six tables, so that fewer states share theirs;
- learners with a replay buffer add the bonus when they sample, and learners that plan add it in exploring plans, as
  with `novelty`.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from hpamdp import keys
from hpamdp.devices import Device, checked_device
from hpamdp.policies.base import Bonus, Learner
from hpamdp.policies.exploration.base import Explored
from hpamdp.policies.exploration.new_states import NoveltyPolicy, RewardsNewStates
from hpamdp.policies.exploration.options import CARDS, CountsOptions
from hpamdp.settings import SettingError

_HASH_SEED = 0  # of the factors of the hash, which are the same in every run
_LARGEST_FACTOR = 2**40


class VisitTable(nn.Module):
    """Counts how often cells were visited.

    Args:
        observation_dim: entries of an observation.
        options: the settings.
    """

    def __init__(self, observation_dim: int, options: CountsOptions) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(_HASH_SEED)
        factors = torch.randint(_LARGEST_FACTOR, (observation_dim,), generator=generator)
        self.factors = nn.Buffer(factors, persistent=False)
        resolution = torch.tensor(options.resolution, dtype=torch.float32)
        self.resolution = nn.Buffer(resolution, persistent=False)
        self.counts = nn.Buffer(torch.zeros(options.table_size, dtype=torch.long))

    def places(self, observation: Tensor) -> Tensor:
        """Return the places in the table, int64 `[*B]`, of observations `[*B, observation_dim]`."""
        cell = (self.resolution * observation).round().long()
        return (cell * self.factors).sum(-1).remainder(len(self.counts))

    @torch.no_grad()
    def bonus(self, observation: Tensor) -> Tensor:
        """Return the bonus `[*B]` for reaching observations `[*B, observation_dim]`, in (0, 1]."""
        return self.counts[self.places(observation)].clamp(min=1).float().rsqrt()

    @torch.no_grad()
    def see(self, observation: Tensor) -> None:
        """Count visits of observations `[N, observation_dim]`."""
        places = self.places(observation)
        self.counts.index_add_(0, places, torch.ones_like(places))

    def num_cells(self) -> float:
        """Return an estimate of how many cells were visited, which corrects for cells that share a slot.

        Source: linear counting of Whang, Vander-Zanden and Taylor, *A Linear-Time Probabilistic Counting Algorithm for
        Database Applications*, 1990. If all slots are taken, the number is too low.
        """
        num_slots = len(self.counts)
        num_taken = int(self.counts.count_nonzero())
        estimate = round(num_slots * math.log(num_slots / max(num_slots - num_taken, 1)))
        return float(max(estimate, num_taken))


class Counts(RewardsNewStates):
    """A bonus for states that were seldom visited, from a table of counts."""

    Options = CountsOptions
    card = CARDS["Counts"]

    def __init__(self, learner: Learner, *, device: Device = "cpu", options: Any = None, **settings: Any) -> None:
        options = CountsOptions.of(options, settings)
        if learner.specs.has_pictures:
            raise SettingError("no picture is seen twice; use exploration=novelty")
        num_entries = learner.specs.observation_dim
        if isinstance(options.resolution, tuple) and len(options.resolution) != num_entries:
            given = list(options.resolution)
            raise SettingError(f"resolution={given}: must have a number for each of {num_entries} entries")
        super().__init__(learner, options.weight)
        self.options = options
        self.table = VisitTable(num_entries, self.options)
        self.to(checked_device(self, device))
        learner.take_bonus(Bonus(self.options.weight, self.table.bonus))

    def acting_policy(self, learner: Learner) -> TensorDictModuleBase:
        """Return the learner's policy, with the table if its plans need it."""
        return NoveltyPolicy(learner.policy, self.table) if self.adds_to_plans else learner.policy

    def learn(self, batch: TensorDictBase, mask: Tensor) -> Explored:
        """Count the states that were reached; return the bonus of the steps, if it is due."""
        if not mask.any():
            return Explored(None, {})
        observation = batch.get(("next", keys.OBSERVATION))[mask]
        self.table.see(observation)
        return self.explored(self.table.bonus(observation), mask, {"cells": self.table.num_cells()})
