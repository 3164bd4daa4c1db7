"""What the model-based learners share: a model, a policy that plans in it, and values of the last states of plans."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from hpamdp.policies.base import Bonus, States
from hpamdp.policies.shared.end_values import EndValues
from hpamdp.policies.shared.gradients import adam
from hpamdp.policies.shared.networks import polyak_update
from hpamdp.policies.shared.options import PlanningOptions
from hpamdp.policies.shared.planning_policy import PlanningPolicy, plan_ends
from hpamdp.policies.shared.replay import ReplayLearner


class PlanningLearner(ReplayLearner):
    """A learner of a model in which its policy plans.

    A subclass makes the perception, `model`, `end_values` and `policy` in `make_networks`. It calls `update_end_values`
    in an update.
    """

    catches_up = True
    export_refusal = "plans at every step"
    weight_decay: float | None = None  # of the model, by AdamW; None: Adam

    options: PlanningOptions
    model: Any
    end_values: EndValues | None
    policy: PlanningPolicy

    def make_end_values(self, hidden_dims: Sequence[int]) -> EndValues | None:
        """Return the values of the last states of plans, if the settings ask for them."""
        num_features = self.perception.specs.observation_dim
        return EndValues(num_features, hidden_dims, self.options) if self.options.end_values else None

    def make_optimizers(self) -> dict[str, torch.optim.Optimizer]:
        """Return the optimizers of the model and of the values, if these are learned."""
        model = {"model": adam(self.options.lr, self.model, self.perception, weight_decay=self.weight_decay)}
        return model if self.end_values is None else {**model, "end_values": self.end_values.optimizer()}

    def take_bonus(self, bonus: Bonus) -> None:
        """Add a bonus, scaled as rewards are, to the rewards of exploring plans."""
        super().take_bonus(bonus)
        self.policy.bonus = bonus.scaled(self.options.reward_scale)

    def start(self) -> None:
        """Plan from now on."""
        self.on_progress(0)

    def update_end_values(self, rows: TensorDictBase) -> dict[str, Tensor]:
        """Update the values on stored steps `[B]`, if they are learned, and move the target networks.

        If the model predicts only a part of the observations, `next_observation` has the whole next ones.
        """
        values = self.end_values
        if values is None:
            return {}
        with torch.no_grad():
            memory = self.memory_of(rows, self.perception)
            state = self.perception(rows["state"], memory, has_seen=True)
            next_state = self.perception(rows["next_state"], memory)
            rows.set("next_state", rows.get("next_observation", rows["next_state"]))
            next_value = self.next_value(rows)
        inputs = state, next_state, rows["reward"], rows["discount"], next_value
        scalars = self.gradient_step("end_values", values.loss, *inputs)
        polyak_update(values.target_own, values.own, self.options.end_value_tau)
        polyak_update(self.target_perception, self.perception, self.options.end_value_tau)
        return scalars

    def value(self, states: States, *, is_target: bool = False) -> Tensor:
        """Return the values `[B]` of states that `end_values` has learned.

        Raises:
            NotImplementedError: the settings ask for no such values.
        """
        if self.end_values is None:
            return super().value(states)
        return self.end_values.of_own(self.target_perception.of_states(states))

    def transitions(self, batch: TensorDictBase) -> TensorDict:
        """Return the rows with `terminated` bool `[*B, T]`: no plan goes on after these steps, and nothing counts then.

        A step that ends a trip is one of them.
        """
        rows, ends = super().transitions(batch), plan_ends(batch)
        rows.set("discount", torch.where(ends, 0.0, rows["discount"]))
        return rows.set("terminated", ends)
