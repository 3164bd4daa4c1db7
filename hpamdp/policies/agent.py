"""The whole agent: a selector over one learner for each option, or over one learner that is told the option."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torch.nn import functional as F

from hpamdp import keys
from hpamdp.policies.base import Learner, Selector
from hpamdp.specs import PAMDPSpecs


def with_option(rows: TensorDictBase, num_options: int) -> TensorDictBase:
    """Return a shallow copy whose observations (under `next` too) end in the one-hot option."""
    rows = rows.copy()
    one_hot = F.one_hot(rows.get(keys.OPTION), num_options).float()
    for name in (keys.OBSERVATION, ("next", keys.OBSERVATION)):
        observation = rows.get(name, None)
        if observation is not None:
            rows.set(name, torch.cat([observation, one_hot], -1))
    return rows


class OptionRouter(TensorDictModuleBase):
    """Has each environment's press chosen by the learner of the option it holds."""

    def __init__(self, learners: Sequence[Learner], specs: PAMDPSpecs, is_shared: bool) -> None:
        super().__init__()
        self.policies = nn.ModuleList(learner.policy for learner in learners)
        self.specs, self.is_shared = specs, is_shared
        in_keys = {key for policy in self.policies for key in policy.in_keys}
        self.in_keys = [*in_keys, *([keys.OPTION] if specs.num_options else [])]
        self.out_keys = list(self.policies[0].out_keys)

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write the action leaves and whatever else the learners' policies keep."""
        if self.is_shared:
            acted = self.policies[0](with_option(td.select(*self.in_keys), self.specs.num_options))
            return td.update(acted.select(*self.out_keys))
        if len(self.policies) == 1:
            return self.policies[0](td)
        option = td.get(keys.OPTION)
        seen = td.select(*self.in_keys)
        for i, policy in enumerate(self.policies):
            rows = option == i
            if not rows.any():
                continue
            acted = policy(seen[rows])
            for key in self.out_keys:
                value = acted.get(key)
                written = td.get(key, None)
                if written is None:
                    written = value.new_zeros(*td.batch_size, *value.shape[1:])
                written = written.clone()
                written[rows] = value
                td.set(key, written)
        return td


class HeldOption(TensorDictModuleBase):
    """The same option everywhere."""

    def __init__(self, option: int) -> None:
        super().__init__()
        self.in_keys, self.out_keys, self.option = [keys.OBSERVATION], [keys.OPTION], option

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write `option` `[*B]`."""
        observation = td.get(keys.OBSERVATION)
        return td.set(keys.OPTION, torch.full(td.batch_size, self.option, device=observation.device))


class HierarchicalAgent(nn.Module):
    """Selector and learners as one policy and one call to learn.

    Args:
        selector: the high level; None where the environment leaves no choice.
        learners: one for each option, or a single one.
        specs: of the problem as the environment states it.
        is_shared: whether the single learner takes the option as input (its own specs then count the one-hot option).
        is_frozen: whether the learners stay as they are.
        uniform_option_frames: presses (decisions, where the learners are frozen) at the start for which the selector's
            exploring choices are uniform; it learns from them.
    """

    def __init__(
        self,
        selector: Selector | None,
        learners: Sequence[Learner],
        specs: PAMDPSpecs,
        is_shared: bool = False,
        is_frozen: bool = False,
        uniform_option_frames: int = 0,
    ) -> None:
        super().__init__()
        self.selector = selector
        self.learners = nn.ModuleList(learners)
        self.specs, self.is_shared, self.is_frozen = specs, is_shared, is_frozen
        self.uniform_option_frames = uniform_option_frames
        self.register_buffer("frames", torch.zeros((), dtype=torch.long))
        self._set_is_uniform()
        self.router = OptionRouter(learners, specs, is_shared)
        self.policy = self.router if selector is None else TensorDictSequential(selector, self.router)

    def policy_of(self, option: int) -> TensorDictModuleBase:
        """Return the policy that presses as this agent but holds one option."""
        return TensorDictSequential(HeldOption(option), self.router)

    @torch.no_grad()
    def option_values(self, observation: Tensor) -> Tensor:
        """Return what each option's learner expects from observations `[B, observation_dim]` on, `[B, num_options]`."""
        num = self.specs.num_options
        if not self.is_shared:
            return torch.stack([learner.value(observation) for learner in self.learners], -1)
        told = [F.one_hot(torch.tensor(i), num).to(observation).expand(len(observation), -1) for i in range(num)]
        return torch.stack([self.learners[0].value(torch.cat([observation, option], -1)) for option in told], -1)

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Let both levels learn from a collected batch `[*B, T]`; return scalars named `high/...` and `low/...`."""
        scalars: dict[str, float] = {}
        self.frames += batch.numel()
        if self.selector is not None:
            self._set_is_uniform()
            scalars |= {f"high/{name}": value for name, value in self._teach_selector(batch).items()}
        if self.is_frozen:
            return scalars
        everything = torch.ones(batch.shape, dtype=torch.bool, device=batch.get(keys.OBSERVATION).device)
        if self.is_shared:
            batch = with_option(batch, self.specs.num_options)
        for i, learner in enumerate(self.learners):
            is_own = everything if len(self.learners) == 1 else batch.get(keys.OPTION) == i
            scalars |= {f"{self._name_of(i)}/{name}": value for name, value in learner.learn(batch, is_own).items()}
        return scalars

    def _name_of(self, learner: int) -> str:
        return "low" if len(self.learners) == 1 else f"low/{self.specs.option_names[learner]}"

    def _set_is_uniform(self) -> None:
        if self.selector is not None:
            self.selector.is_uniform.fill_(self.frames < self.uniform_option_frames)

    def _teach_selector(self, batch: TensorDictBase) -> dict[str, float]:
        is_end = batch.get(("next", keys.IS_DECISION)).squeeze(-1)
        if not is_end.any():
            return {}
        # Time first, so that the selector meets the decisions oldest first.
        decisions = batch.transpose(0, -1)[is_end.transpose(0, -1)]
        if self.selector.needs_values:
            decided_at = decisions.get(("next", keys.DECISION_OBSERVATION))
            decisions.set(keys.OPTION_VALUES, self.option_values(decided_at))
        return self.selector.learn(decisions)

    def add_demonstrations(self, batch: TensorDictBase) -> None:
        """Let the learners keep a data set's transitions `[*B, T]`, each its own option's; the selector learns."""
        if self.selector is not None:
            self._teach_selector(batch)
        everything = torch.ones(batch.shape, dtype=torch.bool, device=batch.get(keys.OBSERVATION).device)
        if self.is_shared:
            batch = with_option(batch, self.specs.num_options)
        for i, learner in enumerate(self.learners):
            learner.add_demonstrations(batch, everything if len(self.learners) == 1 else batch.get(keys.OPTION) == i)

    def update(self, num_updates: int) -> dict[str, float]:
        """Let each learner make updates from what it remembers; return scalars named `low/...`."""
        scalars: dict[str, float] = {}
        for i, learner in enumerate(self.learners):
            made = learner.update(num_updates)
            scalars |= {f"{self._name_of(i)}/{name}": value for name, value in made.items()}
        return scalars

    def stateful(self) -> dict[str, Any]:
        """Return what a checkpoint must hold beside the parameters and buffers."""
        levels = {f"learner{i}": learner for i, learner in enumerate(self.learners)}
        if self.selector is not None:
            levels["selector"] = self.selector
        return {f"{level}_{name}": part for level, module in levels.items() for name, part in module.stateful().items()}
