"""The planner of DLPA: model predictive path integral control, extended to parameterised actions.

Source: Zhang, Fu, Miao and Konidaris, 2024, arXiv 2404.03037, section 4; Williams et al. 2015, arXiv 1509.01149. See
`learner.py` for what differs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor

from hpamdp.policies.base import Bonus
from hpamdp.policies.low_level.dlpa.options import DLPAOptions
from hpamdp.policies.shared.gradients import matmul_precision
from hpamdp.policies.shared.planning import Prediction, absolute_temperature, discounted_return, elite_weights
from hpamdp.specs import PAMDPSpecs

_CHUNK_ROWS = 4096  # states predicted at once when planning: fits the cache and bounds the memory


class Plan(NamedTuple):
    """A distribution over action sequences: at each step a categorical and a Gaussian for each parameter."""

    probability: Tensor  # [N, H, num_discrete], of the discrete actions in their component
    mean: Tensor  # [N, H, num_parameters] in [-1, 1]
    deviation: Tensor  # [N, H, num_parameters]


class Planner:
    """Find good action sequences in a model by iterated sampling, weighting the best more.

    Args:
        model: maps features, discrete actions and parameters in [-1, 1] to a `Prediction`.
        specs: of the problem.
        options: the settings; single ones may be given by their names.
        end_value: maps the features of a plan's last state `[B, F]` to its value, `[B]`. If None, the value is 0.
        imagined: maps the features of a step `[B, F]` and the predicted next observations `[B, observation_dim]` to the
            features of these. If None, features are the observations.
    """

    def __init__(
        self,
        model: Callable[[Tensor, Tensor, Tensor], Prediction],
        specs: PAMDPSpecs,
        options: DLPAOptions | None = None,
        end_value: Callable[[Tensor], Tensor] | None = None,
        imagined: Callable[[Tensor, Tensor], Tensor] | None = None,
        **settings: Any,
    ) -> None:
        self.options: DLPAOptions = DLPAOptions.of(options, settings)
        self.model = model
        self.specs = specs
        self.components = specs.components
        self.end_value = end_value
        self.imagined = imagined
        self.precision: torch.dtype = getattr(torch, self.options.planning_precision)

    @torch.no_grad()
    def plan(self, state: Tensor, action_mask: Tensor | None = None, bonus: Bonus | None = None) -> Plan:
        """Return the final distributions for N states.

        Args:
            state: the features of where the plans begin, `[N, F]`. Without a memory they are the observations.
            action_mask: what the environment allows there, bool `[N, num_discrete]`. If None, everything. What it will
                allow in predicted states is unknown, and taken to be everything.
            bonus: a reward for predicted states that are new; None for none.
        """
        size = max(1, _CHUNK_ROWS // self.options.num_samples)
        masks = [None] * len(state) if action_mask is None else action_mask.split(size)
        plans = [self._plan(rows, mask, bonus) for rows, mask in zip(state.split(size), masks, strict=False)]
        return Plan(*(torch.cat(parts) for parts in zip(*plans, strict=True)))

    def _plan(self, state: Tensor, action_mask: Tensor | None, bonus: Bonus | None) -> Plan:
        shape = state.shape[0], self.options.horizon
        sizes = state.new_tensor([1.0 / size for size in self.components.sizes])
        sizes = sizes[self.components.component_of(state.device)]
        probability = sizes.expand(*shape, -1).clone()
        later = self.specs.allowed(state)
        if later is not None:
            probability = probability * later.unsqueeze(1)
        if action_mask is not None:
            probability[:, 0] *= action_mask
        if later is not None or action_mask is not None:
            # The iterations never leave these actions: what is not sampled is no elite.
            parts = probability.split(self.components.sizes, -1)
            probability = torch.cat([part / part.sum(-1, keepdim=True) for part in parts], -1)
        mean = state.new_zeros(*shape, self.specs.num_parameters)
        plan = Plan(probability, mean, torch.ones_like(mean))
        temperature: Tensor | None = None
        for _ in range(self.options.num_iterations):
            discrete, unit_parameters = self.sample(plan)
            returns = self.returns(state, discrete, unit_parameters, bonus)
            if temperature is None:
                temperature = absolute_temperature(self.options.temperature, returns)
            plan = self.re_estimate(plan, discrete, unit_parameters, returns, temperature)
        return plan

    def sample(self, plan: Plan) -> tuple[Tensor, Tensor]:
        """Sample discrete actions `[N, S, H, ...]` and parameters `[N, S, H, num_parameters]` in [-1, 1]."""
        drawn = []
        for part in plan.probability.flatten(0, 1).split(self.components.sizes, -1):
            choice = part.multinomial(self.options.num_samples, replacement=True)
            drawn.append(choice.unflatten(0, plan.probability.shape[:2]).transpose(1, 2))
        discrete = drawn[0] if self.components.is_single else torch.stack(drawn, -1)
        noise = torch.randn(*drawn[0].shape, self.specs.num_parameters, device=discrete.device, dtype=torch.float32)
        unit_parameters = plan.mean.unsqueeze(1) + plan.deviation.unsqueeze(1) * noise
        return discrete, unit_parameters.clamp(-1.0, 1.0)

    def returns(self, state: Tensor, discrete: Tensor, unit_parameters: Tensor, bonus: Bonus | None = None) -> Tensor:
        """Return the predicted returns `[N, S]` of action sequences from the features of states `[N, F]`.

        With a bonus they include that of the predicted states.
        """
        rows = state.repeat_interleave(discrete.shape[1], 0)

        def steps() -> Iterator[Prediction]:
            nonlocal rows
            horizon = discrete.shape[2]
            for h in range(horizon):
                before = rows
                with matmul_precision(rows.device, self.precision):
                    chosen = discrete[:, :, h].flatten(0, 1)
                    predicted = self.model(before, chosen, unit_parameters[:, :, h].flatten(0, 1))
                if bonus is not None:
                    predicted = with_bonus(predicted, bonus)
                rows = predicted.next_state
                if self.imagined is not None and (h < horizon - 1 or self.end_value is not None):
                    rows = self.imagined(before, rows)
                yield predicted._replace(next_state=rows)

        total = discounted_return(steps(), self.options.gamma, self.end_value)
        value = total.mean(0)
        if self.options.pessimism > 0.0:
            value = value - self.options.pessimism * total.std(0, correction=0)
        return value.unflatten(0, discrete.shape[:2])

    def re_estimate(
        self, plan: Plan, discrete: Tensor, unit_parameters: Tensor, returns: Tensor, temperature: Tensor
    ) -> Plan:
        """Return the distribution of the elites.

        The parameters of a discrete action are estimated from the elites that choose it; they stay as they were if
        there are none.

        Args:
            plan: from which the sequences were sampled.
            discrete: as `sample` returns them.
            unit_parameters: as `sample` returns them.
            returns: of the sequences, `[N, S]`.
            temperature: in units of returns, `[N]`.
        """
        options = self.options
        elite, elite_weight = elite_weights(returns, options.num_elites, temperature.unsqueeze(-1))
        discrete = discrete.take_along_dim(elite.reshape(*elite.shape, *[1] * (discrete.ndim - 2)), 1)
        unit_parameters = unit_parameters.take_along_dim(elite[..., None, None], 1)
        discrete_weight = elite_weight[..., None, None] * self.components.is_chosen(discrete)
        parameter_weight = discrete_weight @ self.specs.parameter_mask.to(discrete_weight)
        total = parameter_weight.sum(1)
        parameter_weight = parameter_weight / total.clamp(min=1e-8).unsqueeze(1)
        mean = (parameter_weight * unit_parameters).sum(1)
        variance = (parameter_weight * (unit_parameters - mean.unsqueeze(1)).square()).sum(1)
        deviation = variance.sqrt().clamp(min=options.min_deviation)
        step = 1.0 - options.momentum
        return Plan(
            plan.probability.lerp(discrete_weight.sum(1), step),
            plan.mean.lerp(torch.where(total > 1e-8, mean, plan.mean), step),
            plan.deviation.lerp(torch.where(total > 1e-8, deviation, plan.deviation), step),
        )


def with_bonus(predicted: Prediction, bonus: Bonus) -> Prediction:
    """Return a prediction whose reward, if the step does not terminate, includes the bonus for its next state."""
    assert bonus.of is not None
    return predicted._replace(continuing=predicted.continuing + bonus.weight * bonus.of(predicted.next_state.float()))
