"""What linear contextual bandits have in common: features of the observation, and a ridge regression an option."""

from __future__ import annotations

import itertools
import math
from typing import Literal

import torch
from pydantic import NonNegativeInt, PositiveFloat, PositiveInt
from tensordict import TensorDictBase
from torch import Tensor, nn

from hpamdp import keys
from hpamdp.policies.base import Selector, is_greedy
from hpamdp.policies.shared.bandit_statistics import Discount, Memory, RewardStatistics
from hpamdp.specs import PAMDPSpecs

Features = Literal["polynomial", "random_fourier"]


class ContextFeatures(nn.Module):
    """Features `[*B, num_features]`, a constant among them, of some entries of the observation.

    Args:
        specs: of the problem.
        inputs: the entries; None: all.
        features: `polynomial`, all monomials up to `degree`, or `random_fourier`, `degree` cosines in random directions
            (Rahimi and Recht 2007), of deviation 1 in the entries' own units.
        degree: of the features.

    Raises:
        ValueError: the observation has no such entry, or there would be more than 2,000 features.
    """

    def __init__(self, specs: PAMDPSpecs, inputs: list[int] | None, features: Features, degree: int) -> None:
        super().__init__()
        inputs = list(range(specs.observation_dim)) if inputs is None else inputs
        if not inputs or not all(0 <= i < specs.observation_dim for i in inputs):
            last = specs.observation_dim - 1
            raise ValueError(f"inputs={inputs}: the observation has entries 0 to {last}; null: all")
        is_polynomial = features == "polynomial"
        self.num_features = math.comb(len(inputs) + degree, degree) if is_polynomial else degree + 1
        if self.num_features > 2000:
            raise ValueError(f"degree={degree}: {self.num_features} features of {len(inputs)} inputs; at most 2000")
        self.register_buffer("inputs", torch.tensor(inputs))
        if is_polynomial:
            # A monomial is a product of `degree` factors, each an input or the constant, which stands last.
            chosen = itertools.combinations_with_replacement(range(len(inputs) + 1), degree)
            self.register_buffer("factors", torch.tensor(list(chosen)))
        else:
            generator = torch.Generator().manual_seed(0)
            self.register_buffer("directions", torch.randn(len(inputs), degree, generator=generator))
            self.register_buffer("phases", 2.0 * math.pi * torch.rand(degree, generator=generator))
        self.is_polynomial = is_polynomial

    def forward(self, observation: Tensor) -> Tensor:
        """Return the features, float64."""
        x = observation[..., self.inputs].double()
        if self.is_polynomial:
            return torch.cat([x, torch.ones_like(x[..., :1])], -1)[..., self.factors].prod(-1)
        cosines = (x @ self.directions.double() + self.phases).cos()
        return torch.cat([cosines, torch.ones_like(x[..., :1])], -1)


class LinearBandit(Selector):
    """A selector that predicts each option's payoff by ridge regression on features of the observation.

    A subclass writes `draw`. Forgetting is as in `Payoffs`: by the age in decisions, whichever option they chose.

    Args:
        specs: of the problem.
        exploration: factor of the deviation in `draw`.
        inputs, features, degree: of `ContextFeatures`.
        ridge: added to the Gram matrices' diagonals.
        memory, discount, window: which decisions count.
    """

    def __init__(
        self,
        specs: PAMDPSpecs,
        *,
        exploration: PositiveFloat,
        inputs: list[NonNegativeInt] | None,
        features: Features,
        degree: PositiveInt,
        ridge: PositiveFloat,
        memory: Memory,
        discount: Discount,
        window: PositiveInt,
    ) -> None:
        super().__init__(specs)
        self.features = ContextFeatures(specs, inputs, features, degree)
        self.exploration, self.ridge = exploration, ridge
        self.rewards = RewardStatistics(specs.num_options, memory, discount, window)
        num, dim = specs.num_options, self.features.num_features
        self.register_buffer("gram", torch.zeros(num, dim, dim, dtype=torch.float64))
        self.register_buffer("moment", torch.zeros(num, dim, dtype=torch.float64))
        size = len(self.rewards.recent_options)
        self.register_buffer("recent_features", torch.zeros(size, dim, dtype=torch.float64))

    def predict(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Return the options' expected payoffs and the deviations of these estimates, `[B, num_options]` each."""
        x = self.features(observation)
        one = torch.eye(self.features.num_features, dtype=x.dtype, device=x.device)
        gram = self.gram + self.ridge * one
        # Each feature in units of its own size, and a trifle on the diagonal: monomials of pixels span many magnitudes,
        # and rounding would leave a matrix that is not positive definite.
        size = gram.diagonal(dim1=-2, dim2=-1).sqrt()
        factor = torch.linalg.cholesky(gram / (size.unsqueeze(-1) * size.unsqueeze(-2)) + 1e-11 * one)
        theta = torch.cholesky_solve((self.moment / size).unsqueeze(-1), factor).squeeze(-1) / size
        # x' A^-1 x is the squared length of L^-1 x.
        spread = torch.linalg.solve_triangular(factor, (x / size.unsqueeze(1)).mT, upper=False)
        total = self.rewards.counts.sum().clamp(min=1.0)
        explained = (theta * self.moment).sum() / total
        noise = (self.rewards.squares.sum() / total - explained).clamp(min=1e-12).sqrt()
        return x @ theta.T, noise * spread.square().sum(1).sqrt().T

    def sample(self, mean: Tensor, deviation: Tensor) -> Tensor:
        """Return what exploring choices go by, `[B, num_options]`, of which the highest is chosen."""
        raise NotImplementedError

    def select(self, td: TensorDictBase) -> Tensor:
        """Return the choices `[*B]`: the best prediction where the policy is greedy, else the best `draw`."""
        observation = td.get(keys.OBSERVATION)
        mean, deviation = self.predict(observation.flatten(0, -2))
        if not is_greedy():
            # Options never chosen come first, in random order.
            mean = torch.where(self.rewards.is_untried, 1e9 + torch.rand_like(mean), self.sample(mean, deviation))
        return mean.argmax(-1).reshape(observation.shape[:-1])

    def learn(self, decisions: TensorDictBase) -> dict[str, float]:
        """Take in the finished decisions, oldest first; return each option's mean payoff among them."""
        options = decisions.get(keys.OPTION)
        rewards = decisions.get(("next", keys.OPTION_RETURN)).squeeze(-1).double()
        x = self.features(decisions.get(("next", keys.DECISION_OBSERVATION)))
        named = enumerate(self.specs.option_names)
        scalars = {f"reward_{n}": rewards[options == i].mean().item() for i, n in named if (options == i).any()}
        self._add(options, rewards, x)
        return scalars

    def _add(self, options: Tensor, rewards: Tensor, x: Tensor) -> None:
        known = self.rewards
        known.add(options, rewards)
        fade = known.discount ** len(options)
        if known.memory == "sliding_window":
            self.recent_features = torch.cat([self.recent_features, x])[-len(known.recent_options) :]
            is_filled, fade = known.recent_options >= 0, 0.0
            options, rewards = known.recent_options[is_filled], known.recent_rewards[is_filled]
            x = self.recent_features[is_filled]
        weights = known.weights(len(options))
        self.gram *= fade
        self.moment *= fade
        for i in range(self.specs.num_options):
            weighted = x * (weights * (options == i)).unsqueeze(-1)
            self.gram[i] += weighted.T @ x
            self.moment[i] += weighted.T @ rewards
