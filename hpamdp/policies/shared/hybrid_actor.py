"""Stochastic hybrid policies: a categorical over the discrete actions and a Gaussian for their parameters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from pydantic import PositiveFloat, model_validator
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.nn import functional as F
from typing_extensions import Self

from hpamdp import keys
from hpamdp.policies.base import is_greedy
from hpamdp.policies.masks import masked_logits, sample_index
from hpamdp.policies.shared.networks import InitialLayer, InitialParameters, VectorProducts
from hpamdp.policies.shared.perception import Perception
from hpamdp.settings import Settings
from hpamdp.specs import PAMDPSpecs

# The raw sample of the parameters, which a learner needs for its likelihood.
RAW = "raw_parameters"


class HybridDistribution(NamedTuple):
    """A categorical over the discrete actions and a Gaussian for all their parameters.

    Raw parameters are samples of the Gaussian in units where the bounds are [-1, 1]. There are two ways to bring them
    within the bounds:

    - clipped: the learner keeps the raw sample, whose likelihood is `log_prob`, and clips it only for execution;
    - squashed by tanh: `sample_squashed` returns parameters within the bounds and their log-densities, and gradients
      flow through both.

    Attributes:
        discrete_log_probs: log-probabilities of the discrete actions, `[*B, num_discrete]`.
        mean: of the raw parameters, `[*B, num_parameters]`.
        log_scale: logarithm of their standard deviation, `[*B, num_parameters]`.
        owner: the discrete action that each parameter belongs to, int64 `[num_parameters]`.
    """

    discrete_log_probs: Tensor
    mean: Tensor
    log_scale: Tensor
    owner: Tensor

    def sample(self) -> tuple[Tensor, Tensor]:
        """Sample discrete actions `[*B]` and the raw parameters of all of them, `[*B, num_parameters]`."""
        discrete = sample_index(self.discrete_log_probs)
        return discrete, self.mean + self.log_scale.exp() * torch.randn_like(self.mean)

    def mode(self) -> tuple[Tensor, Tensor]:
        """Return the most probable discrete action `[*B]` and the mean raw parameters `[*B, num_parameters]`."""
        return self.discrete_log_probs.argmax(-1), self.mean

    def sample_discrete(self) -> tuple[Tensor, Tensor]:
        """Sample discrete actions `[*B]`, with the mean raw parameters `[*B, num_parameters]`."""
        return sample_index(self.discrete_log_probs), self.mean

    def sample_squashed(self) -> tuple[Tensor, Tensor]:
        """Sample squashed parameters in [-1, 1]; return them and their log-densities, each `[*B, num_parameters]`.

        The density is computed from the sample before squashing, which keeps it exact at the bounds.
        """
        scale = self.log_scale.exp()
        noise = torch.randn_like(self.mean)
        raw = self.mean + scale * noise
        squashed = raw.tanh()
        # log(1 - tanh(raw)^2), without loss of precision for large |raw|.
        log_slope = 2.0 * (math.log(2.0) - raw - F.softplus(-2.0 * raw))
        # scale.log(), not log_scale: the density of the scale as it was rounded for the sample.
        return squashed, gaussian_log_density(noise, scale.log()) - log_slope

    def log_prob(self, discrete: Tensor, raw: Tensor) -> tuple[Tensor, Tensor]:
        """Return the log-likelihoods of the discrete actions and of their own raw parameters.

        Args:
            discrete: `[*B]`.
            raw: `[*B, num_parameters]`; the parameters of the other discrete actions are ignored.

        Returns:
            Two tensors `[*B]`; the second is 0 for a discrete action without parameters.
        """
        discrete_log_prob = self.discrete_log_probs.gather(-1, discrete.unsqueeze(-1)).squeeze(-1)
        log_density = gaussian_log_density((raw - self.mean) / self.log_scale.exp(), self.log_scale)
        return discrete_log_prob, (log_density * (self.owner == discrete.unsqueeze(-1))).sum(-1)

    def entropy(self) -> tuple[Tensor, Tensor]:
        """Return the entropy of the discrete action and the expected entropy of its own raw parameters, each `[*B]`."""
        probs = self.discrete_log_probs.exp()
        discrete_entropy = -(probs * self.discrete_log_probs).sum(-1)
        gaussian_entropy = self.log_scale + 0.5 * math.log(2 * math.pi * math.e)
        return discrete_entropy, (probs.index_select(-1, self.owner) * gaussian_entropy).sum(-1)

    def sum_of_own(self, values: Tensor) -> Tensor:
        """Return the sums over each discrete action's own parameters, `[*B, num_discrete]`, of values of all of them.

        Args:
            values: `[*B, num_parameters]`.
        """
        return torch.zeros_like(self.discrete_log_probs).index_add(-1, self.owner, values)


class ScaleOptions(Settings):
    """The range in which the standard deviation of the parameters is learned."""

    min_scale: PositiveFloat = 0.02
    """Smallest standard deviation of the parameters, in units where their bounds are [-1, 1]."""
    max_scale: PositiveFloat = 1.0
    """Largest standard deviation of the parameters."""

    @model_validator(mode="after")
    def _check_scale(self) -> Self:
        if not self.min_scale < self.max_scale:
            raise ValueError(f"min_scale={self.min_scale}: must be less than max_scale={self.max_scale}")
        return self

    @property
    def scale_range(self) -> tuple[float, float]:
        """Smallest and largest standard deviation."""
        return self.min_scale, self.max_scale


class HybridActor(nn.Module):
    """A discrete head and a parameter head on one encoder, nearly uniform and centred at initialisation.

    Args:
        specs: sizes and bounds of the problem.
        hidden_dims: sizes of the encoder's layers.
        scale_range: smallest and largest standard deviation, in units where the bounds are [-1, 1].
        initial_scale: standard deviation at initialisation, strictly within `scale_range`; if None, its geometric mean.
        initial_parameters: `domain`: the means start at the problem's initial parameters, if it has any.
        vector_products: whether the encoder also sees `VectorProducts`.

    Attributes:
        products: appends these products to observations; None if there are none.
        num_inputs: how many numbers the encoder sees.
    """

    log_min_scale: Tensor
    owner: Tensor

    def __init__(
        self,
        specs: PAMDPSpecs,
        hidden_dims: Sequence[int],
        scale_range: tuple[float, float],
        initial_scale: float | None = None,
        initial_parameters: InitialParameters = "none",
        *,
        vector_products: bool = False,
    ) -> None:
        super().__init__()
        self.initial = InitialLayer(specs, initial_parameters, is_squashed=False)
        self.products = VectorProducts(specs) if vector_products else None
        self.num_inputs = specs.observation_dim if self.products is None else self.products.num_outputs
        self.encoder = encoder(self.num_inputs, hidden_dims)
        self.discrete_head = nn.Linear(hidden_dims[-1], specs.num_discrete, dtype=torch.float32)
        self.parameter_head = nn.Linear(hidden_dims[-1], 2 * specs.num_parameters, dtype=torch.float32)
        log_min_scale, log_max_scale = (math.log(scale) for scale in scale_range)
        self.register_buffer("log_min_scale", torch.tensor(log_min_scale, dtype=torch.float32))
        self.log_max_scale = log_max_scale
        if initial_scale is None:
            initial_scale = (scale_range[0] * scale_range[1]) ** 0.5
        fraction = (math.log(initial_scale) - log_min_scale) / (log_max_scale - log_min_scale)
        with torch.no_grad():
            for head in (self.discrete_head, self.parameter_head):
                head.weight.mul_(0.01)
                head.bias.zero_()
            self.parameter_head.bias[specs.num_parameters :] = math.log(fraction / (1.0 - fraction))
        self.register_buffer("owner", specs.parameter_owner, persistent=False)

    def forward(self, observation: Tensor, mask: Tensor | None = None) -> HybridDistribution:
        """Return the distribution of the action for observations `[*B, observation_dim]`.

        Args:
            observation: of the states.
            mask: the discrete actions that may be taken, bool `[*B, num_discrete]`; if None, all.
        """
        hidden = self.encoder(observation if self.products is None else self.products(observation))
        mean, raw_scale = self.parameter_head(hidden).chunk(2, -1)
        mean = mean + self.initial(observation)
        log_scale = self.log_min_scale + (self.log_max_scale - self.log_min_scale) * raw_scale.sigmoid()
        logits = masked_logits(self.discrete_head(hidden), mask)
        return HybridDistribution(logits.log_softmax(-1), mean, log_scale, self.owner)

    def set_min_scale(self, min_scale: float) -> None:
        """Set the smallest standard deviation."""
        self.log_min_scale.fill_(math.log(min_scale))


class HybridPolicy(TensorDictModuleBase):
    """Samples the action from the actor, or takes the most probable one when greedy.

    Args:
        actor: gives the distribution.
        specs: sizes and bounds of the problem.
        writes_raw: whether to write the raw sample of the parameters as `RAW`, too.
        samples_when_greedy: whether to sample greedy discrete actions as well; their parameters are the means.
        perception: what the actor sees of an observation. If None, the observation itself.
    """

    def __init__(
        self,
        actor: HybridActor,
        specs: PAMDPSpecs,
        *,
        writes_raw: bool = False,
        samples_when_greedy: bool = False,
        perception: Perception | None = None,
    ) -> None:
        super().__init__()
        self.perception = Perception(specs) if perception is None else perception
        self.in_keys = self.perception.in_keys
        self.out_keys = [keys.DISCRETE, keys.PARAMETERS, *([RAW] if writes_raw else []), *self.perception.out_keys]
        self.actor = actor
        self.specs = specs
        self.writes_raw = writes_raw
        self.samples_when_greedy = samples_when_greedy

    @torch.no_grad()
    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write the discrete action `[*B]`, the parameters and maybe their raw sample, `[*B, num_parameters]` each."""
        allowed = self.specs.allowed(td.get(keys.OBSERVATION), td.get(keys.ACTION_MASK, None))
        distribution: HybridDistribution = self.actor(self.perception.see(td), allowed)
        if not is_greedy():
            discrete, raw = distribution.sample()
        elif self.samples_when_greedy:
            discrete, raw = distribution.sample_discrete()
        else:
            discrete, raw = distribution.mode()
        if self.writes_raw:
            td.set(RAW, raw)
        parameters = self.specs.from_unit(raw.clamp(-1.0, 1.0))
        return td.update({keys.ACTION: {"discrete": discrete, "parameters": parameters}})


def encoder(in_dim: int, hidden_dims: Sequence[int]) -> nn.Sequential:
    """Return ReLU layers with orthogonal initial weights, for heads to stand on."""
    layers: list[nn.Module] = []
    for layer_in, layer_out in pairwise([in_dim, *hidden_dims]):
        linear = nn.Linear(layer_in, layer_out, dtype=torch.float32)
        nn.init.orthogonal_(linear.weight, math.sqrt(2.0))
        nn.init.zeros_(linear.bias)
        layers += [linear, nn.ReLU(inplace=True)]
    return nn.Sequential(*layers)


def gaussian_log_density(standardised: Tensor, log_scale: Tensor) -> Tensor:
    """Return the log-density of Gaussian samples, given (x - mean) / scale and log(scale)."""
    return -0.5 * standardised.square() - log_scale - 0.5 * math.log(2 * math.pi)
