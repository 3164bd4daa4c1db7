"""Distributions of hybrid actions: categoricals over discrete actions, Gaussians and categoricals of parameters."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor
from torch.nn import functional as F

from hpamdp.components import Components
from hpamdp.policies.masks import masked_logits, sample_index
from hpamdp.policies.shared.options import GreedyParameters
from hpamdp.specs import PAMDPSpecs

# An integer parameter with at most this many values has a categorical. With more it has a Gaussian, and is rounded.
MAX_VALUES = 32


class HybridDistribution(NamedTuple):
    """A categorical over the discrete actions of each component and a Gaussian for all their parameters.

    Raw parameters are samples of the Gaussian in units where the bounds are [-1, 1]. There are two ways to bring them
    within the bounds:

    - clipped: the learner keeps the raw sample, whose likelihood is `log_prob`, and clips it only for execution;
    - squashed by tanh: `sample_squashed` returns parameters within the bounds and their log-densities, and gradients
      flow through both.

    Attributes:
        discrete_log_probs: log-probabilities of the discrete actions in their component, `[*B, num_discrete]`.
        mean: of the raw parameters, `[*B, num_parameters]`.
        log_scale: logarithm of their standard deviation, `[*B, num_parameters]`.
        owner: the discrete action that each parameter belongs to, int64 `[num_parameters]`.
        components: of the action.
        values: categoricals of the integer parameters with few values; None if no parameter has one.
        greedy_parameters: `mean`, or `clipped_mean`, that of the clipped samples.
    """

    discrete_log_probs: Tensor
    mean: Tensor
    log_scale: Tensor
    owner: Tensor
    components: Components
    values: ValueDistribution | None = None
    greedy_parameters: GreedyParameters = "mean"

    def sample(self) -> tuple[Tensor, Tensor]:
        """Sample discrete actions `[*B]` and the raw parameters of all of them, `[*B, num_parameters]`.

        With several components the discrete actions are `[*B, num_components]`.
        """
        discrete = self._sampled_discrete()
        raw = self.mean + self.log_scale.exp() * torch.randn_like(self.mean)
        return discrete, raw if self.values is None else self.values.sampled(raw)

    def mode(self) -> tuple[Tensor, Tensor]:
        """Return the most probable discrete action `[*B]` and the greedy raw parameters `[*B, num_parameters]`.

        Parameters with a categorical take the most probable value.
        """
        return self.components.best(self.discrete_log_probs), self._greedy()

    def sample_discrete(self) -> tuple[Tensor, Tensor]:
        """Sample discrete actions `[*B]`, with the greedy raw parameters `[*B, num_parameters]`."""
        return self._sampled_discrete(), self._greedy()

    def sample_squashed(self) -> tuple[Tensor, Tensor]:
        """Sample squashed parameters in [-1, 1]; return them and their log-densities, each `[*B, num_parameters]`.

        The density is computed from the sample before squashing, which keeps it exact at the bounds.
        """
        scale = self.log_scale.exp()
        noise = torch.randn_like(self.mean)
        raw = self.mean + scale * noise
        squashed = raw.tanh()
        log_slope = log_slope_of_tanh(raw)
        # scale.log(), not log_scale: the density of the scale as it was rounded for the sample.
        return squashed, gaussian_log_density(noise, scale.log()) - log_slope

    def log_prob(self, discrete: Tensor, raw: Tensor) -> tuple[Tensor, Tensor]:
        """Return the log-likelihoods of the discrete actions and of their own raw parameters.

        Args:
            discrete: `[*B]`, or `[*B, num_components]`.
            raw: `[*B, num_parameters]`; the parameters of the other discrete actions are ignored.

        Returns:
            Two tensors of the shape of `discrete`; the second is 0 for a discrete action without parameters.
        """
        discrete_log_prob = self.components.of_choice(self.discrete_log_probs, discrete)
        log_density = gaussian_log_density((raw - self.mean) / self.log_scale.exp(), self.log_scale)
        if self.values is not None:
            log_density = self.values.with_log_probs(log_density, raw)
        if self.components.is_single:
            return discrete_log_prob, (log_density * (self.owner == discrete.unsqueeze(-1))).sum(-1)
        return discrete_log_prob, self.components.of_choice(self.sum_of_own(log_density), discrete)

    def entropy(self) -> tuple[Tensor, Tensor]:
        """Return the entropy of the discrete actions and the expected entropy of their own raw parameters, `[*B]` each.

        Both are sums over the components.
        """
        probs = self.discrete_log_probs.exp()
        discrete_entropy = -(probs * self.discrete_log_probs).sum(-1)
        parameter_entropy = self.log_scale + 0.5 * math.log(2 * math.pi * math.e)
        if self.values is not None:
            parameter_entropy = self.values.with_entropies(parameter_entropy)
        return discrete_entropy, (probs.index_select(-1, self.owner) * parameter_entropy).sum(-1)

    def sum_of_own(self, values: Tensor) -> Tensor:
        """Return the sum of the numbers of each discrete action's own parameters, `[*B, num_discrete]`.

        Args:
            values: a number for each parameter, `[*B, num_parameters]`.
        """
        return torch.zeros_like(self.discrete_log_probs).index_add(-1, self.owner, values)

    def _sampled_discrete(self) -> Tensor:
        if self.components.is_single:
            return sample_index(self.discrete_log_probs)
        parts = self.discrete_log_probs.split(self.components.sizes, -1)
        return torch.stack([sample_index(part) for part in parts], -1)

    def _greedy(self) -> Tensor:
        is_clipped = self.greedy_parameters == "clipped_mean"
        raw = clipped_mean(self.mean, self.log_scale.exp()) if is_clipped else self.mean
        return raw if self.values is None else self.values.most_probable(raw)


class ValueDistribution(NamedTuple):
    """Categoricals over the values of the integer parameters with few values.

    A raw parameter is the middle of its value's cell in [-1, 1], see `PAMDPSpecs.from_unit`.

    Attributes:
        log_probs: log-probabilities of the values of these I parameters, `[*B, I, V]`, with V the largest number of
            values. If a parameter has fewer, the last entries have probability 0.
        places: places of the I parameters among all, int64 `[I]`.
        counts: numbers of values of the I parameters, `[I]`.
    """

    log_probs: Tensor
    places: Tensor
    counts: Tensor

    def sampled(self, raw: Tensor) -> Tensor:
        """Return raw parameters `[*B, num_parameters]`, in which integer parameters have sampled values."""
        return raw.index_copy(-1, self.places, self._middle(sample_index(self.log_probs)))

    def most_probable(self, raw: Tensor) -> Tensor:
        """Return raw parameters `[*B, num_parameters]`, in which integer parameters have their most probable values."""
        return raw.index_copy(-1, self.places, self._middle(self.log_probs.argmax(-1)))

    def with_log_probs(self, log_density: Tensor, raw: Tensor) -> Tensor:
        """Return log-densities `[*B, num_parameters]`, in which integer parameters have log-probabilities instead."""
        cell = (0.5 * (raw.index_select(-1, self.places) + 1.0) * self.counts).floor().long()
        value = cell.clamp(min=0).minimum(self.counts - 1)
        log_prob = self.log_probs.gather(-1, value.unsqueeze(-1)).squeeze(-1)
        return log_density.index_copy(-1, self.places, log_prob)

    def with_entropies(self, entropy: Tensor) -> Tensor:
        """Return entropies `[*B, num_parameters]`, in which integer parameters have those of the categoricals."""
        return entropy.index_copy(-1, self.places, -(self.log_probs.exp() * self.log_probs).sum(-1))

    def _middle(self, value: Tensor) -> Tensor:
        return (2 * value + 1) / self.counts - 1.0


class ValuePlaces(NamedTuple):
    """Which parameters are integers with at most `MAX_VALUES` values.

    Attributes:
        places: places of these I parameters among all.
        counts: numbers of values of these parameters.
        most: the largest number of values, V.
    """

    places: tuple[int, ...]
    counts: tuple[int, ...]
    most: int

    @classmethod
    def of(cls, specs: PAMDPSpecs) -> ValuePlaces | None:
        """Return the places in a problem; None if no parameter is such an integer, or if bounds depend on the state."""
        if specs.has_parameter_bounds:
            return None
        bounds = zip(specs.integer_parameters, specs.parameter_low, specs.parameter_high, strict=False)
        counts = {place: round(high - low) + 1 for place, (is_whole, low, high) in enumerate(bounds) if is_whole}
        few = {place: count for place, count in counts.items() if count <= MAX_VALUES}
        return cls(tuple(few), tuple(few.values()), max(few.values())) if few else None

    @property
    def num_logits(self) -> int:
        """Number of network outputs that the distributions need."""
        return len(self.places) * self.most

    def split(self, sizes: Sequence[int]) -> list[ValuePlaces | None]:
        """Return the places for each of several groups of parameters of these sizes, counted within the group."""
        groups: list[ValuePlaces | None] = []
        start = 0
        for size in sizes:
            own = [i for i, place in enumerate(self.places) if start <= place < start + size]
            places = tuple(self.places[i] - start for i in own)
            groups.append(ValuePlaces(places, tuple(self.counts[i] for i in own), self.most) if own else None)
            start += size
        return groups

    def distribution(self, logits: Tensor) -> ValueDistribution:
        """Return the distribution of the values, given logits `[*B, num_logits]`."""
        logits = logits.unflatten(-1, (len(self.places), self.most))
        counts = torch.tensor(self.counts, device=logits.device)
        exists = torch.arange(self.most, device=logits.device) < counts.unsqueeze(-1)
        return self.joined(masked_logits(logits, exists).log_softmax(-1))

    def joined(self, log_probs: Tensor) -> ValueDistribution:
        """Return the distribution of the values, given log-probabilities `[*B, I, V]`."""
        places, counts = (torch.tensor(each, device=log_probs.device) for each in (self.places, self.counts))
        return ValueDistribution(log_probs, places, counts)


# Chooses discrete actions and raw parameters from a distribution.
Draw: TypeAlias = Callable[[HybridDistribution], tuple[Tensor, Tensor]]


def log_slope_of_tanh(raw: Tensor) -> Tensor:
    """Return log(1 - tanh(raw)^2), without loss of precision for large |raw|."""
    return 2.0 * (math.log(2.0) - raw - F.softplus(-2.0 * raw))


def clipped_mean(mean: Tensor, scale: Tensor) -> Tensor:
    """Return the means `[*B]` of Gaussian samples that are clipped to [-1, 1], given means and deviations `[*B]`."""
    low, high = (-1.0 - mean) / scale, (1.0 - mean) / scale
    below, above = (0.5 + 0.5 * torch.erf(end / math.sqrt(2.0)) for end in (low, -high))
    density_low, density_high = (torch.exp(-0.5 * end.square()) / math.sqrt(2.0 * math.pi) for end in (low, high))
    return above - below + mean * (1.0 - below - above) + scale * (density_low - density_high)


def gaussian_log_density(standardised: Tensor, log_scale: Tensor) -> Tensor:
    """Return the log-density of Gaussian samples, given (x - mean) / scale and log(scale)."""
    return -0.5 * standardised.square() - log_scale - 0.5 * math.log(2 * math.pi)
