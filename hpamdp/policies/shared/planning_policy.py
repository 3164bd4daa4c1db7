"""The policy that the model-based learners share, which acts by the first action of a plan, and their settings."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from hpamdp import keys
from hpamdp.acting import is_greedy
from hpamdp.policies.base import check_batch
from hpamdp.policies.masks import random_discrete
from hpamdp.policies.shared.perception import Perception
from hpamdp.specs import PAMDPSpecs


def plan_ends(batch: TensorDictBase) -> Tensor:
    """Return after which steps of a batch `[*B, T]` no plan goes on, bool `[*B, T]`.

    A plan stops where an episode terminates or a trip ends. The next trip begins at random, so no model can predict it.
    """
    ends: Tensor = batch["next", keys.TERMINATED] | batch.get(("next", keys.TRIP_ENDED), False)
    return ends.squeeze(-1)


class PlanningPolicy(TensorDictModuleBase):
    """Takes the first action of a plan; a random one until `is_trained`, and with probability `epsilon` if it explores.

    Nothing is planned for finished episodes, nor where an exploration holds an action: the random action there is
    ignored. The memory, if there is any, sees every step. A subclass implements `first_action`.
    """

    in_keys: list[NestedKey]
    out_keys: list[NestedKey]

    def __init__(self, specs: PAMDPSpecs, epsilon: float, perception: Perception) -> None:
        super().__init__()
        self.in_keys = [keys.DONE, *perception.in_keys]
        self.out_keys = [keys.DISCRETE, keys.PARAMETERS, *perception.out_keys]
        self.perception = perception
        self.specs = specs
        self.epsilon = epsilon
        self.is_trained = nn.Buffer(torch.zeros((), dtype=torch.bool))

    @torch.no_grad()
    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write the discrete action `[*B]`, the parameters `[*B, num_parameters]` and the memory's state, if any.

        Raises:
            ValueError: the step has no batch dimension.
        """
        check_batch(self, td)
        self.perception.see(td)
        observation = td.get(keys.OBSERVATION).flatten(0, -2)
        num, device = len(observation), observation.device
        mask = td.get(keys.ACTION_MASK, None)
        mask = None if mask is None else mask.flatten(0, -2)
        allowed = self.specs.allowed(observation, mask)
        discrete = random_discrete(self.specs, torch.Size([num]), allowed, device)
        unit_parameters = 2.0 * torch.rand(num, self.specs.num_parameters, device=device, dtype=torch.float32) - 1.0
        is_planned = self.is_trained.expand(num)
        done = td.get(keys.DONE, None)
        if done is not None:
            is_planned = is_planned & ~done.flatten()
        is_held = td.get(keys.IS_HELD, None)
        if is_held is not None:
            is_planned = is_planned & ~is_held.flatten()
        if self.epsilon > 0.0 and not is_greedy():
            is_planned = is_planned & (torch.rand(num, device=device, dtype=torch.float32) >= self.epsilon)
        if is_planned.any():
            mask = None if mask is None else mask[is_planned]
            discrete[is_planned], unit_parameters[is_planned] = self.first_action(td, observation, is_planned, mask)
        shape = td.batch_size
        parameters = self.specs.from_unit(unit_parameters.reshape(*shape, self.specs.num_parameters), td)
        discrete = discrete.reshape((*shape, *discrete.shape[1:]))
        return td.update({keys.ACTION: {"discrete": discrete, "parameters": parameters}})

    def remembered(self, td: TensorDictBase, is_planned: Tensor) -> Tensor | None:
        """Return the memory's states `[N, size]` where plans begin, see `first_action`; None without a memory."""
        key = self.perception.memory_key
        return None if key is None else td.get(key).flatten(0, -2)[is_planned]

    def first_action(
        self, td: TensorDictBase, observation: Tensor, is_planned: Tensor, mask: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Return the discrete actions `[N]` and the parameters `[N, num_parameters]` in [-1, 1] of N plans.

        Args:
            td: the step, `[*B]`.
            observation: its observations, one after another, `[prod(B), observation_dim]`.
            is_planned: which of them to plan from, N in all, bool `[prod(B)]`.
            mask: what the environment allows there, bool `[N, num_discrete]`. If None, everything.
        """
        raise NotImplementedError
