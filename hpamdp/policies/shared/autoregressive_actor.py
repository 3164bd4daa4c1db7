"""A hybrid actor whose components see what was chosen before them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from hpamdp.components import Components
from hpamdp.policies.masks import masked_logits
from hpamdp.policies.shared.hybrid_actor import HybridActor, clipped, make_small
from hpamdp.policies.shared.hybrid_distribution import Draw, HybridDistribution
from hpamdp.policies.shared.networks import OutputLinear
from hpamdp.specs import PAMDPSpecs

# The most probable choice is searched among all if there are at most this many; each costs a row of the network.
_MAX_JOINT = 64


class AutoregressiveActor(HybridActor):
    """One head after another: each component sees the choices of those before it, and the parameters of these choices.

    Independent heads cannot represent that components depend on each other, as where two of them must match.

    Source: Vinyals et al. 2017, *StarCraft II: A New Challenge for Reinforcement Learning*, arXiv 1708.04782, section
    4.2. A head is a hidden layer and an output layer.

    Args:
        args: as for `HybridActor`.
        bound: maps raw parameters to those that are executed, in [-1, 1], which later components see.
        settings: as for `HybridActor`.
    """

    takes_pairs = True

    def __init__(self, *args: Any, bound: Callable[[Tensor], Tensor] = clipped, **settings: Any) -> None:
        super().__init__(*args, **settings)
        self.bound = bound

    def make_heads(self, specs: PAMDPSpecs, width: int, raw_scale: float) -> None:
        """Make a head for each component on the hidden layers; see `HybridActor.make_heads`."""
        self.in_cells = specs.in_cells
        sizes = self.components.sizes
        dims = torch.tensor(specs.parameter_dims).split(sizes)
        self.parameter_sizes = [int(part.sum()) for part in dims]
        self.owners = [torch.arange(len(part)).repeat_interleave(part) for part in dims]
        self.parts = [None] * len(sizes) if self.values is None else self.values.split(self.parameter_sizes)
        self.heads = nn.ModuleList()
        for size, num, part in zip(sizes, self.parameter_sizes, self.parts, strict=True):
            num_values = 0 if part is None else part.num_logits
            last = OutputLinear(width, size + 2 * num + num_values, dtype=torch.float32)
            make_small(last)
            with torch.no_grad():
                last.bias[size + num : size + 2 * num] = raw_scale
            first = nn.Linear(width + specs.num_discrete + specs.num_parameters, width, dtype=torch.float32)
            nn.init.orthogonal_(first.weight, math.sqrt(2.0))
            nn.init.zeros_(first.bias)
            self.heads.append(nn.Sequential(first, nn.ReLU(inplace=True), last))

    def forward(self, observation: Tensor, mask: Tensor | None = None) -> HybridDistribution:
        """Refuse: the distribution of an action needs what was chosen before; see `given` and `act`."""
        raise NotImplementedError("an autoregressive actor has no distribution without the earlier components' choices")

    def given(
        self, observation: Tensor, discrete: Tensor, raw: Tensor, mask: Tensor | None, pair_mask: Tensor | None
    ) -> HybridDistribution:
        """Return each component's distribution given the choices of the components before it.

        `draw` ignores the distribution, and takes the next component's part of the given action.
        """
        chosen = iter(zip(self._choices(discrete), raw.split(self.parameter_sizes, -1), strict=True))
        _, _, distribution = self.act(lambda _: next(chosen), observation, mask, pair_mask)
        return distribution

    def act(
        self, draw: Draw, observation: Tensor, mask: Tensor | None, pair_mask: Tensor | None
    ) -> tuple[Tensor, Tensor, HybridDistribution]:
        """Choose one component after another; `draw` gets the distribution of each."""
        hidden, initial = self.hidden(observation), self.initial(observation)
        is_chosen = hidden.new_zeros(*hidden.shape[:-1], sum(self.components.sizes))
        own = hidden.new_zeros(*hidden.shape[:-1], len(self.owner))
        first, first_parameter = 0, 0
        choices: list[Tensor] = []
        raws: list[Tensor] = []
        distributions: list[HybridDistribution] = []
        for size, num, head, owner, part in zip(
            self.components.sizes, self.parameter_sizes, self.heads, self.owners, self.parts, strict=True
        ):
            allowed = self.components.allowed_next(len(choices), is_chosen > 0.0, mask, pair_mask)
            output = head(torch.cat([hidden, is_chosen, own], -1))
            logits, mean, raw_scale, value_logits = output.split(
                [size, num, num, output.shape[-1] - size - 2 * num], -1
            )
            if isinstance(initial, Tensor):
                mean = mean + initial[..., first_parameter : first_parameter + num]
            distribution = HybridDistribution(
                masked_logits(logits, allowed).log_softmax(-1),
                mean,
                self.log_scale(raw_scale),
                owner.to(mean.device),
                Components((size,)),
                None if part is None else part.distribution(value_logits),
                self.greedy_parameters,
            )
            choice, raw = draw(distribution)
            choices.append(choice)
            raws.append(raw)
            distributions.append(distribution)
            is_own = torch.arange(size, device=choice.device) == choice.unsqueeze(-1)
            is_chosen = _with_part(is_chosen, first, is_own.to(is_chosen.dtype))
            executed = self.in_cells(_with_part(own, first_parameter, self.bound(raw).to(own.dtype)))
            own = executed * is_chosen[..., self.owner]
            first, first_parameter = first + size, first_parameter + num
        discrete = choices[0] if self.components.is_single else torch.stack(choices, -1)
        return discrete, torch.cat(raws, -1), self._joined(distributions)

    def act_from(
        self, number: int, choice: Tensor, discrete: Tensor, raw: Tensor, observation: Tensor, mask: Tensor | None
    ) -> tuple[Tensor, Tensor, HybridDistribution]:
        """Go on from a component, as `act` does: keep those before it, and sample its parameters and the later ones.

        Args:
            number: of the component.
            choice: its discrete actions, `[*B]`.
            discrete: the discrete actions to keep, `[*B, num_components]`.
            raw: their raw parameters, `[*B, num_parameters]`.
            observation: of the states, `[*B, observation_dim]`.
            mask: the discrete actions that may be taken, bool `[*B, num_discrete]`. If None, all.
        """
        kept = enumerate(zip(discrete.unbind(-1), raw.split(self.parameter_sizes, -1), strict=True))

        def follow(part: HybridDistribution) -> tuple[Tensor, Tensor]:
            place, before = next(kept)
            if place < number:
                return before
            sampled, sampled_raw = part.sample()
            return (choice if place == number else sampled), sampled_raw

        return self.act(follow, observation, mask, None)

    def most_probable(
        self, observation: Tensor, mask: Tensor | None, pair_mask: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Return the discrete actions that are most probable together, and their greedy raw parameters.

        With more than 64 combinations, each component takes its own most probable choice, given those before it.
        """
        sizes = self.components.sizes
        if self.components.is_single or math.prod(sizes) > _MAX_JOINT:
            return super().most_probable(observation, mask, pair_mask)
        choices = torch.cartesian_prod(*(torch.arange(size, device=observation.device) for size in sizes))
        num = len(choices)
        following = iter(choices.unbind(-1))

        def follow(part: HybridDistribution) -> tuple[Tensor, Tensor]:
            return next(following).expand(part.mean.shape[:-1]), part.mode()[1]

        def repeated(rows: Tensor | None, num_dims: int) -> Tensor | None:
            return None if rows is None else rows.unsqueeze(-1 - num_dims).repeat_interleave(num, -1 - num_dims)

        observations = observation.unsqueeze(-2).repeat_interleave(num, -2)
        discrete, raw, distribution = self.act(follow, observations, repeated(mask, 1), repeated(pair_mask, 2))
        log_prob = self.components.of_choice(distribution.discrete_log_probs, discrete).sum(-1)
        best = log_prob.argmax(-1)
        raw = raw.gather(-2, best[..., None, None].expand(*best.shape, 1, raw.shape[-1])).squeeze(-2)
        return choices[best], raw

    def _choices(self, discrete: Tensor) -> list[Tensor]:
        return [discrete] if self.components.is_single else list(discrete.unbind(-1))

    def _joined(self, parts: Sequence[HybridDistribution]) -> HybridDistribution:
        """Return the distributions of the components as one."""
        log_probs = torch.cat([part.discrete_log_probs for part in parts], -1)
        mean = torch.cat([part.mean for part in parts], -1)
        log_scale = torch.cat([part.log_scale for part in parts], -1)
        values = None
        if self.values is not None:
            of_parts = [part.values.log_probs for part in parts if part.values is not None]
            values = self.values.joined(torch.cat(of_parts, -2))
        return HybridDistribution(log_probs, mean, log_scale, self.owner, self.components, values)


def _with_part(values: Tensor, start: int, part: Tensor) -> Tensor:
    """Return values `[*B, n]` with a part `[*B, m]` in the places from `start` on."""
    end = start + part.shape[-1]
    return torch.cat([values[..., :start], part, values[..., end:]], -1)
