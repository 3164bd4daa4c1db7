"""What a selector (the high level) and a learner (the low level) are to the rest of the framework."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from hpamdp import keys
from hpamdp.specs import PAMDPSpecs


class Selector(TensorDictModuleBase):
    """Chooses an option where a decision is due and holds it until the next one.

    A subclass writes `select` and, if it learns, `learn`; what it remembers lives in buffers, so that a checkpoint
    holds it. Its `__init__` takes `specs` and its options as keyword arguments, which are the schema of its yaml.
    """

    needs_oracle: ClassVar[bool] = False  # whether it reads what only an environment with a planner writes

    def __init__(self, specs: PAMDPSpecs) -> None:
        super().__init__()
        self.in_keys = [keys.OBSERVATION, keys.IS_DECISION]
        self.out_keys = [keys.OPTION]
        self.specs = specs

    def select(self, td: TensorDictBase) -> Tensor:
        """Return a fresh choice for every environment, int64 `[*B]`."""
        raise NotImplementedError

    def learn(self, decisions: TensorDictBase) -> dict[str, float]:
        """Learn from finished decisions `[N]`, oldest first; return scalars to log.

        A decision is its last step: `option`, and under `next` its `option_return`, `option_steps` and
        `decision_observation`.
        """
        return {}

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write `option` `[*B]`: a fresh choice where `is_decision`, the held one elsewhere."""
        is_decision = td.get(keys.IS_DECISION).squeeze(-1)
        held = td.get(keys.OPTION, None)
        if held is None or is_decision.any():
            fresh = self.select(td)
            held = fresh if held is None else torch.where(is_decision, fresh, held)
        return td.set(keys.OPTION, held)


class Learner(nn.Module):
    """Learns which key to press and for how long.

    A subclass gives `policy`, a module that writes the action leaves (`keys.KEY` `[*B]`, `keys.DURATION`
    `[*B, num_parameters]`) greedily or exploring by `exploration_type()`, and `learn`. It owns its data and its
    optimisers. Its `__init__` takes `specs`, `device` and its options as keyword arguments, the schema of its yaml.
    """

    needs_oracle: ClassVar[bool] = False

    policy: TensorDictModuleBase

    def __init__(self, specs: PAMDPSpecs) -> None:
        super().__init__()
        self.specs = specs

    def learn(self, batch: TensorDictBase, mask: Tensor) -> dict[str, float]:
        """Learn from a collected batch `[*B, T]`, of which the transitions in `mask` bool `[*B, T]` are this learner's.

        Return scalars to log, averaged over the updates made.
        """
        return {}

    def stateful(self) -> dict[str, Any]:
        """Return what a checkpoint must hold beside the module's parameters and buffers: optimisers, replay."""
        return {}
