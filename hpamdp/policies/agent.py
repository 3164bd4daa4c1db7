"""The whole agent: a selector over one learner for each option, or over one learner that is told the option."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import nn
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


class HierarchicalAgent(nn.Module):
    """Selector and learners as one policy and one call to learn.

    Args:
        selector: the high level; None where the environment leaves no choice.
        learners: one for each option, or a single one.
        specs: of the problem as the environment states it.
        is_shared: whether the single learner takes the option as input (its own specs then count the one-hot option).
    """

    def __init__(
        self, selector: Selector | None, learners: Sequence[Learner], specs: PAMDPSpecs, is_shared: bool = False
    ) -> None:
        super().__init__()
        self.selector = selector
        self.learners = nn.ModuleList(learners)
        self.specs, self.is_shared = specs, is_shared
        router = OptionRouter(learners, specs, is_shared)
        self.policy = router if selector is None else TensorDictSequential(selector, router)

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Let both levels learn from a collected batch `[*B, T]`; return scalars named `high/...` and `low/...`."""
        scalars: dict[str, float] = {}
        if self.selector is not None:
            is_end = batch.get(("next", keys.IS_DECISION)).squeeze(-1)
            if is_end.any():
                # Time first, so that the selector meets the decisions oldest first.
                decisions = batch.transpose(0, -1)[is_end.transpose(0, -1)]
                scalars |= {f"high/{name}": value for name, value in self.selector.learn(decisions).items()}
        everything = torch.ones(batch.shape, dtype=torch.bool, device=batch.get(keys.OBSERVATION).device)
        if self.is_shared:
            batch = with_option(batch, self.specs.num_options)
        for i, learner in enumerate(self.learners):
            is_own = everything if len(self.learners) == 1 else batch.get(keys.OPTION) == i
            prefix = "low" if len(self.learners) == 1 else f"low/{self.specs.option_names[i]}"
            scalars |= {f"{prefix}/{name}": value for name, value in learner.learn(batch, is_own).items()}
        return scalars

    def stateful(self) -> dict[str, Any]:
        """Return what a checkpoint must hold beside the parameters and buffers."""
        return {
            f"learner{i}_{name}": part
            for i, learner in enumerate(self.learners)
            for name, part in learner.stateful().items()
        }
