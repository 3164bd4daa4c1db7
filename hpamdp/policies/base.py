"""What a selector (the high level) and a learner (the low level) are to the rest of the framework."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type

from hpamdp import keys
from hpamdp.specs import PAMDPSpecs


def is_greedy() -> bool:
    """Return whether policies are to act greedily here; else they explore."""
    return exploration_type() in (ExplorationType.DETERMINISTIC, ExplorationType.MODE)


def option_ends(batch: TensorDictBase) -> Tensor:
    """Return where a batch's episodes or options end, bool `[*B, T, 1]`: another learner's rows can follow."""
    return batch.get(("next", keys.DONE)) | batch.get(("next", keys.IS_DECISION), False)


class Selector(TensorDictModuleBase):
    """Chooses an option where a decision is due and holds it until the next one.

    A subclass writes `select` and, if it learns, `learn`; what it remembers lives in buffers, so that a checkpoint
    holds it. Its `__init__` takes `specs` and its options as keyword arguments, which are the schema of its yaml.
    """

    # What it reads that an environment writes only when asked: `oracle`, `human`.
    needs: ClassVar[tuple[str, ...]] = ()
    needs_values: bool = False  # whether it reads the learners' own values of a state
    gamma: float = 1.0  # discount of a step, where options end before their episode

    def __init__(self, specs: PAMDPSpecs) -> None:
        super().__init__()
        self.in_keys = [keys.OBSERVATION, keys.IS_DECISION]
        self.out_keys = [keys.OPTION]
        self.specs = specs
        # While it is true, exploring choices are uniform, so that every option's learner gets its practice.
        self.register_buffer("is_uniform", torch.zeros((), dtype=torch.bool))

    def select(self, td: TensorDictBase) -> Tensor:
        """Return a fresh choice for every environment, int64 `[*B]`."""
        raise NotImplementedError

    def choose(self, td: TensorDictBase) -> dict[str, Tensor]:
        """Return all `out_keys` of a fresh choice, each `[*B]`; beside the option what `learn` wants to know of it."""
        return {keys.OPTION: self.select(td)}

    def choose_uniformly(self, td: TensorDictBase) -> dict[str, Tensor]:
        """Return all `out_keys` of uniformly random choices, each `[*B]`."""
        return {keys.OPTION: torch.randint(self.specs.num_options, td.batch_size, device=self.is_uniform.device)}

    def learn(self, decisions: TensorDictBase) -> dict[str, float]:
        """Learn from finished decisions `[N]`, oldest first; return scalars to log.

        A decision is its last step: `option`, and under `next` its `option_return`, `option_steps`,
        `decision_observation`, `observation` and `terminated`; with `needs_values`, `option_values` `[N, num_options]`
        at the decision.
        """
        return {}

    def stateful(self) -> dict[str, Any]:
        """Return what a checkpoint must hold beside the module's parameters and buffers: optimisers, replay."""
        return {}

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write `out_keys` `[*B]`: a fresh choice where `is_decision`, the held one elsewhere."""
        is_decision = td.get(keys.IS_DECISION).squeeze(-1)
        held = {key: td.get(key, None) for key in self.out_keys}
        is_new = any(value is None for value in held.values())
        if is_new or is_decision.any():
            is_uniform = bool(self.is_uniform) and not is_greedy()
            fresh = self.choose_uniformly(td) if is_uniform else self.choose(td)
            held = fresh if is_new else {key: torch.where(is_decision, fresh[key], held[key]) for key in held}
        for key, value in held.items():
            td.set(key, value)
        return td


class Learner(nn.Module):
    """Learns which key to press and for how long.

    A subclass gives `policy`, a module that writes the action leaves (`keys.KEY` `[*B]`, `keys.DURATION`
    `[*B, num_parameters]`) greedily or exploring by `is_greedy`, and `learn`. It owns its data and its
    optimisers. Its `__init__` takes `specs`, `device` and its options as keyword arguments, the schema of its yaml.
    """

    needs: ClassVar[tuple[str, ...]] = ()  # as of a selector
    # What it can learn from: `train`, its own presses; `offline`, a data set of others' presses.
    modes: ClassVar[tuple[str, ...]] = ("train",)
    has_value: ClassVar[bool] = False  # whether `value` is there

    policy: TensorDictModuleBase

    def __init__(self, specs: PAMDPSpecs) -> None:
        super().__init__()
        self.specs = specs

    def learn(self, batch: TensorDictBase, mask: Tensor) -> dict[str, float]:
        """Learn from a collected batch `[*B, T]`, of which the transitions in `mask` bool `[*B, T]` are this learner's.

        Return scalars to log, averaged over the updates made.
        """
        return {}

    def add_demonstrations(self, batch: TensorDictBase, mask: Tensor) -> None:
        """Keep those of a data set's transitions `[*B, T]` that are in `mask`, beside what the learner will collect.

        Only for learners with the mode `offline`.
        """
        raise NotImplementedError

    def update(self, num_updates: int) -> dict[str, float]:
        """Make updates from what is remembered; return scalars to log, averaged over them."""
        raise NotImplementedError

    def value(self, observation: Tensor) -> Tensor:
        """Return what the learner expects to earn from observations `[B, observation_dim]` on, `[B]`."""
        raise NotImplementedError

    def stateful(self) -> dict[str, Any]:
        """Return what a checkpoint must hold beside the module's parameters and buffers: optimisers, replay."""
        return {}
