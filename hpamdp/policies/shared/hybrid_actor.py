"""Stochastic hybrid policies: a categorical over the discrete actions and a Gaussian for their parameters."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from hpamdp import keys
from hpamdp.acting import is_greedy
from hpamdp.policies.masks import masked_logits
from hpamdp.policies.shared.hybrid_distribution import Draw, HybridDistribution, ValuePlaces
from hpamdp.policies.shared.networks import InitialLayer, OutputLinear, VectorProducts
from hpamdp.policies.shared.options import GreedyParameters, InitialParameters
from hpamdp.policies.shared.perception import Perception
from hpamdp.settings import SettingError
from hpamdp.specs import PAMDPSpecs
from hpamdp.unchecked import unchecked

# The raw sample of the parameters, before clipping, which a learner needs for its likelihood.
RAW = "raw_parameters"


def clipped(raw: Tensor) -> Tensor:
    """Return raw parameters, clipped to [-1, 1]."""
    return raw.clamp(-1.0, 1.0)


class DistributionActor(nn.Module):
    """An actor whose `forward` returns a `HybridDistribution`, given observations and a mask."""

    def act(
        self, draw: Draw, observation: Tensor, mask: Tensor | None, pair_mask: Tensor | None
    ) -> tuple[Tensor, Tensor, HybridDistribution]:
        """Return discrete actions, raw parameters `[*B, num_parameters]` and the distribution that they come from.

        Args:
            draw: maps a distribution to discrete actions and raw parameters.
            observation: of the states, `[*B, observation_dim]`.
            mask: the discrete actions that may be taken, bool `[*B, num_discrete]`. If None, all.
            pair_mask: whether the column's discrete action may follow the row's, bool `[*B, num_discrete,
                num_discrete]`. If None, all pairs. Only an `AutoregressiveActor` takes it.
        """
        distribution: HybridDistribution = self(observation, mask)
        return *draw(distribution), distribution

    def most_probable(
        self, observation: Tensor, mask: Tensor | None, pair_mask: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Return the most probable discrete actions and their greedy raw parameters; arguments as for `act`."""
        discrete, raw, _ = self.act(HybridDistribution.mode, observation, mask, pair_mask)
        return discrete, raw


class HybridActor(DistributionActor):
    """A discrete head and a parameter head on shared hidden layers, nearly uniform and centred at initialisation.

    Given the state, the components of an action are independent.

    Args:
        specs: sizes and bounds of the problem.
        hidden_dims: sizes of the hidden layers.
        scale_range: smallest and largest standard deviation, in units where the bounds are [-1, 1].
        initial_scale: standard deviation at initialisation, strictly within `scale_range`; if None, its geometric mean.
        initial_parameters: `domain`: the means start at the problem's initial parameters, if it has any.
        vector_products: whether the hidden layers also see `VectorProducts`.
        has_values: whether integer parameters with at most `MAX_VALUES` values have a categorical.
        greedy_parameters: see `HybridDistribution`.

    Attributes:
        products: appends vector products to observations; None without `vector_products`.
        num_inputs: how many numbers the hidden layers see.
        encoder: the hidden layers. Unlike `perception.encoder`, they encode no pictures.
        values: places of the parameters with a categorical; None if no parameter has one.
        takes_pairs: whether it follows a `pair_mask`.

    Raises:
        SettingError: the problem has a `pair_mask`, which the actor cannot follow.
    """

    takes_pairs: ClassVar[bool] = False
    added_later: ClassVar[tuple[str, ...]] = ("log_max_scale",)  # files in agents/ lack it

    def __init__(
        self,
        specs: PAMDPSpecs,
        hidden_dims: Sequence[int],
        scale_range: tuple[float, float],
        initial_scale: float | None = None,
        initial_parameters: InitialParameters = "none",
        *,
        vector_products: bool = False,
        has_values: bool = True,
        greedy_parameters: GreedyParameters = "mean",
    ) -> None:
        super().__init__()
        if specs.has_pair_mask and not self.takes_pairs:
            raise SettingError(
                "autoregressive=false: the problem forbids pairs of discrete actions (pair_mask), which independent "
                "heads cannot heed; use autoregressive=true"
            )
        self.components = specs.components
        self.greedy_parameters = greedy_parameters
        self.initial = InitialLayer(specs, initial_parameters, is_squashed=False)
        self.products = VectorProducts(specs) if vector_products else None
        self.num_inputs = specs.observation_dim if self.products is None else self.products.num_outputs
        self.encoder = hidden_layers(self.num_inputs, hidden_dims)
        log_min_scale, log_max_scale = (math.log(scale) for scale in scale_range)
        self.values = ValuePlaces.of(specs) if has_values else None
        if initial_scale is None:
            initial_scale = (scale_range[0] * scale_range[1]) ** 0.5
        fraction = (math.log(initial_scale) - log_min_scale) / (log_max_scale - log_min_scale)
        self.make_heads(specs, hidden_dims[-1], math.log(fraction / (1.0 - fraction)))
        self.log_min_scale = nn.Buffer(torch.tensor(log_min_scale, dtype=torch.float32))
        self.log_max_scale = nn.Buffer(torch.tensor(log_max_scale, dtype=torch.float32))
        self.owner = nn.Buffer(specs.parameter_owner, persistent=False)

    def make_heads(self, specs: PAMDPSpecs, width: int, raw_scale: float) -> None:
        """Make the heads on hidden layers of this width; `log_scale(raw_scale)` is their initial log-scale."""
        self.discrete_head = OutputLinear(width, specs.num_discrete, dtype=torch.float32)
        self.parameter_head = OutputLinear(width, 2 * specs.num_parameters, dtype=torch.float32)
        heads = [self.discrete_head, self.parameter_head]
        if self.values is not None:
            self.value_head = OutputLinear(width, self.values.num_logits, dtype=torch.float32)
            heads.append(self.value_head)
        for head in heads:
            make_small(head)
        with torch.no_grad():
            self.parameter_head.bias[specs.num_parameters :] = raw_scale

    def forward(self, observation: Tensor, mask: Tensor | None = None) -> HybridDistribution:
        """Return the distribution of the action for observations `[*B, observation_dim]`.

        Args:
            observation: of the states.
            mask: the discrete actions that may be taken, bool `[*B, num_discrete]`; if None, all.
        """
        hidden = self.hidden(observation)
        mean, raw_scale = self.parameter_head(hidden).chunk(2, -1)
        mean = mean + self.initial(observation)
        logits = masked_logits(self.discrete_head(hidden), mask)
        values = None if self.values is None else self.values.distribution(self.value_head(hidden))
        log_probs = self.components.log_softmax(logits)
        log_scale, greedy = self.log_scale(raw_scale), self.greedy_parameters
        return HybridDistribution(log_probs, mean, log_scale, self.owner, self.components, values, greedy)

    def hidden(self, observation: Tensor) -> Tensor:
        """Return the output of the hidden layers for observations `[*B, observation_dim]`."""
        return self.encoder(observation if self.products is None else self.products(observation))

    def log_scale(self, raw_scale: Tensor) -> Tensor:
        """Return the logarithms of standard deviations, given a head's outputs."""
        return self.log_min_scale + (self.log_max_scale - self.log_min_scale) * raw_scale.sigmoid()

    def given(
        self, observation: Tensor, discrete: Tensor, raw: Tensor, mask: Tensor | None, pair_mask: Tensor | None
    ) -> HybridDistribution:
        """Return the distribution whose `log_prob` is that of an action in a state.

        Args:
            observation: of the states, `[*B, observation_dim]`.
            discrete: the chosen discrete actions, `[*B]`, or `[*B, num_components]` if there are several components.
            raw: raw parameters, `[*B, num_parameters]`.
            mask: the discrete actions that may be taken, bool `[*B, num_discrete]`.
            pair_mask: the discrete actions that go together, bool `[*B, num_discrete, num_discrete]`.
        """
        return self(observation, mask)

    def set_min_scale(self, min_scale: float) -> None:
        """Set the smallest standard deviation."""
        self.log_min_scale.fill_(math.log(min_scale))

    def set_max_scale(self, max_scale: float) -> None:
        """Set the largest standard deviation."""
        self.log_max_scale.fill_(math.log(max_scale))


class HybridPolicy(TensorDictModuleBase):
    """Samples the action from the actor, or takes the most probable one when greedy.

    Args:
        actor: gives the distribution.
        specs: sizes and bounds of the problem.
        writes_raw: whether to write the raw sample of the parameters as `RAW`, too.
        samples_when_greedy: whether to sample greedy discrete actions as well, but not their parameters.
        bound: maps raw parameters to those that are executed, in [-1, 1].
        perception: what the actor sees of an observation. If None, the observation itself.
    """

    def __init__(
        self,
        actor: DistributionActor,
        specs: PAMDPSpecs,
        *,
        writes_raw: bool = False,
        samples_when_greedy: bool = False,
        bound: Callable[[Tensor], Tensor] = clipped,
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
        self.bound = bound

    @torch.no_grad()
    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write the discrete action `[*B]`, the parameters and maybe their raw sample, `[*B, num_parameters]` each."""
        allowed = self.specs.allowed(td.get(keys.OBSERVATION), td.get(keys.ACTION_MASK, None))
        state = self.perception.see(td), allowed, td.get(keys.PAIR_MASK, None)
        if is_greedy() and not self.samples_when_greedy:
            discrete, raw = self.actor.most_probable(*state)
        else:
            draw = HybridDistribution.sample_discrete if is_greedy() else HybridDistribution.sample
            discrete, raw, _ = self.actor.act(draw, *state)
        if self.writes_raw:
            td.set(RAW, raw)
        parameters = self.specs.from_unit(self.bound(raw), td)
        return td.set(keys.ACTION, unchecked({"discrete": discrete, "parameters": parameters}, td))


def make_small(head: nn.Linear) -> None:
    """Bring a head's outputs near 0."""
    with torch.no_grad():
        head.weight.mul_(0.01)
        head.bias.zero_()


def hidden_layers(in_dim: int, hidden_dims: Sequence[int]) -> nn.Sequential:
    """Return ReLU layers with orthogonal initial weights, for heads to stand on."""
    layers: list[nn.Module] = []
    for layer_in, layer_out in pairwise([in_dim, *hidden_dims]):
        linear = nn.Linear(layer_in, layer_out, dtype=torch.float32)
        nn.init.orthogonal_(linear.weight, math.sqrt(2.0))
        nn.init.zeros_(linear.bias)
        layers += [linear, nn.ReLU(inplace=True)]
    return nn.Sequential(*layers)
