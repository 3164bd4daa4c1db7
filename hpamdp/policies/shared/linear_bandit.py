"""The base of linear contextual bandits: features of the observation, and a ridge regression for each option."""

from __future__ import annotations

import itertools
import math
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from hpamdp import keys
from hpamdp.acting import is_greedy
from hpamdp.policies.base import Selector
from hpamdp.policies.masks import masked_values
from hpamdp.policies.shared.bandit import RewardStatistics, above_all
from hpamdp.policies.shared.bandit_options import LINEAR_BANDIT_CARD, LinearBanditOptions
from hpamdp.settings import SettingError
from hpamdp.specs import PAMDPSpecs


def make_features(specs: PAMDPSpecs, options: LinearBanditOptions) -> ProjectionFeatures | ContextFeatures:
    """Return the features that the settings name.

    Raises:
        ValueError: the problem declares no directions, or see `ContextFeatures`.
    """
    geometry = specs.geometry
    has_directions = (
        geometry is not None and geometry.directions is not None and geometry.num_contexts == specs.num_options
    )
    is_given = options.inputs is not None or options.degree != 1
    if options.features == "projections":
        if not has_directions:
            raise SettingError("features=projections: the problem does not declare where each option's actions point")
        if is_given:
            raise SettingError("features=projections: takes neither inputs nor degree; features=polynomial does")
        return ProjectionFeatures(specs)
    if options.features == "auto" and has_directions and not is_given:
        return ProjectionFeatures(specs)
    return ContextFeatures(specs, options)


class ProjectionFeatures(nn.Module):
    """Features `[*B, num_options, num_features]` that do not change if the plane is turned with an option's actions.

    They are the projections of the declared vectors on the directions of an option's actions, and a constant 1, which
    comes last. Of actions of one kind the largest projection comes first, since they differ only in their directions.
    Vectors that are redundant are left out.
    """

    def __init__(self, specs: PAMDPSpecs) -> None:
        super().__init__()
        geometry = specs.geometry
        assert geometry is not None and geometry.directions is not None
        origins = geometry.origins or ((0.0, 0.0),) * len(geometry.vectors)
        kept = [number for number, (x, _) in enumerate(geometry.vectors) if x not in geometry.redundant]
        self.vectors = nn.Buffer(torch.tensor([geometry.vectors[number] for number in kept]))
        self.origins = nn.Buffer(torch.tensor([origins[number] for number in kept], dtype=torch.float64))
        self.directions = nn.Buffer(geometry.directions.double())
        num_actions = self.directions.shape[1]
        kinds = geometry.kinds or range(num_actions)
        self.kinds = [[action for action in range(num_actions) if kinds[action] == kind] for kind in sorted({*kinds})]
        self.num_features = len(kept) * num_actions + 1

    def forward(self, observation: Tensor) -> Tensor:
        """Return the features of observations `[*B, observation_dim]`, float64."""
        vectors = observation[..., self.vectors].double() - self.origins
        projections = torch.einsum("...vd,oad->...ova", vectors, self.directions)
        parts = [projections[..., actions].sort(-1, descending=True).values for actions in self.kinds]
        features = torch.cat(parts, -1).flatten(-2)
        return torch.cat([features, torch.ones_like(features[..., :1])], -1)

    def exported(self) -> dict[str, Any] | None:
        """Return their form, see `hpamdp.policies.shared.exported_policy`."""
        tables = {name: getattr(self, name).tolist() for name in ("vectors", "origins", "directions")}
        return {"kind": "projections", **tables, "kinds": self.kinds}


class ContextFeatures(nn.Module):
    """Features `[*B, num_options, num_features]` of some entries of the observation, the same for each option.

    A constant 1 comes last.

    The directions of random Fourier features are standard normal in the units of the entries, and the same in every
    run. Source: Rahimi and Recht 2007, *Random Features for Large-Scale Kernel Machines*.

    Raises:
        ValueError: the observation has no such entry, or there would be more than 2,000 features.
    """

    def __init__(self, specs: PAMDPSpecs, options: LinearBanditOptions) -> None:
        super().__init__()
        inputs = list(range(specs.observation_dim) if options.inputs is None else options.inputs)
        degree = options.degree
        if not inputs or not all(0 <= i < specs.observation_dim for i in inputs):
            last = specs.observation_dim - 1
            raise SettingError(f"inputs={inputs}: the observation has entries 0 to {last}; null: all")
        if len(set(inputs)) < len(inputs):
            raise SettingError(f"inputs={inputs}: names an entry twice")
        self.is_polynomial = options.features != "random_fourier"
        self.num_features = math.comb(len(inputs) + degree, degree) if self.is_polynomial else degree + 1
        if self.num_features > 2000:
            raise SettingError(f"degree={degree}: {self.num_features} features of {len(inputs)} inputs; at most 2000")
        self.inputs = nn.Buffer(torch.tensor(inputs))
        self.num_options = specs.num_options
        if self.is_polynomial:
            # A monomial is a product of `degree` factors, each an input or the constant 1, which comes last.
            monomials = itertools.combinations_with_replacement(range(len(inputs) + 1), degree)
            self.factors = nn.Buffer(torch.tensor(list(monomials)))
        else:
            generator = torch.Generator().manual_seed(0)
            self.directions = nn.Buffer(torch.randn(len(inputs), degree, generator=generator, dtype=torch.float32))
            self.phases = nn.Buffer(2.0 * math.pi * torch.rand(degree, generator=generator, dtype=torch.float32))

    def forward(self, observation: Tensor) -> Tensor:
        """Return the features of observations `[*B, observation_dim]`, float64."""
        x = observation[..., self.inputs].double()
        one = torch.ones_like(x[..., :1])
        if self.is_polynomial:
            features = torch.cat([x, one], -1)[..., self.factors].prod(-1)
        else:
            features = torch.cat([(x @ self.directions.double() + self.phases).cos(), one], -1)
        return features.unsqueeze(-2).expand(*features.shape[:-1], self.num_options, -1)

    def exported(self) -> dict[str, Any] | None:
        """Return the polynomial's form, see `hpamdp.policies.shared.exported_policy`; None for cosines."""
        if not self.is_polynomial:
            return None
        return {"kind": "polynomial", "inputs": self.inputs.tolist(), "factors": self.factors.tolist()}


class LinearBandit(Selector):
    """A selector that predicts the reward of each option by ridge regression on features of the observation.

    A subclass writes `sample`. Old decisions are forgotten as in `RewardStatistics`: by their age in decisions of any
    option.

    Attributes:
        gram: sum of the features' outer products for each option, float64 `[num_options, num_features, num_features]`.
        moment: sum of features times reward for each option, float64 `[num_options, num_features]`.
        recent_features: of the decisions in `statistics.recent_options`, float64 `[window, num_features]`.
    """

    Options: ClassVar[type[LinearBanditOptions]] = LinearBanditOptions
    card = LINEAR_BANDIT_CARD
    options: LinearBanditOptions

    def __init__(self, specs: PAMDPSpecs, options: LinearBanditOptions | None = None, **settings: Any) -> None:
        super().__init__(specs)
        self.options = self.Options.of(options, settings)
        self.features = make_features(specs, self.options)
        self.statistics = RewardStatistics(specs.num_options, self.options)
        num, dim = specs.num_options, self.features.num_features
        self.gram: Tensor = nn.Buffer(torch.zeros(num, dim, dim, dtype=torch.float64))
        self.moment: Tensor = nn.Buffer(torch.zeros(num, dim, dtype=torch.float64))
        size = len(self.statistics.recent_options)
        self.recent_features: Tensor = nn.Buffer(torch.zeros(size, dim, dtype=torch.float64))

    def predict(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Return each option's expected reward at observations `[B, observation_dim]`, and its standard deviation.

        Both are `[B, num_options]`. The deviation is that of the estimate, not of a single reward.
        """
        x = self.features(observation)
        theta, factor, size = self._regression()
        # x' A^-1 x is the squared length of L^-1 x.
        spread = torch.linalg.solve_triangular(factor, (x / size).permute(1, 2, 0), upper=False)
        total = self.statistics.counts.sum().clamp(min=1.0)
        explained = (theta * self.moment).sum() / total
        noise = (self.statistics.squares.sum() / total - explained).clamp(min=1e-12).sqrt()
        return (x * theta).sum(-1), noise * spread.square().sum(1).sqrt().T

    def _regression(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return each option's coefficients, the Cholesky factor of its scaled Gram matrix, and the features' scales.

        Coefficients and scales are `[num_options, num_features]`.
        """
        identity = torch.eye(self.features.num_features, dtype=self.gram.dtype, device=self.gram.device)
        gram = self.gram + self.options.ridge * identity
        # The magnitudes of monomials may differ so much that rounding leaves a matrix that is not positive definite.
        # Therefore each feature is scaled by its own size, and a little is added to the diagonal.
        size = gram.diagonal(dim1=-2, dim2=-1).sqrt()
        factor = torch.linalg.cholesky(gram / (size.unsqueeze(-1) * size.unsqueeze(-2)) + 1e-11 * identity)
        theta = torch.cholesky_solve((self.moment / size).unsqueeze(-1), factor).squeeze(-1) / size
        return theta, factor, size

    def exported(self) -> dict[str, Any] | None:
        """Return features and coefficients, see `hpamdp.policies.shared.exported_policy`; None with random features."""
        form = self.features.exported()
        return None if form is None else {**form, "coefficients": self._greedy_coefficients().tolist()}

    def _greedy_coefficients(self) -> Tensor:
        """Return the coefficients of the greedy choice, `[num_options, num_features]`.

        The coefficients of an untried option predict the lowest finite number everywhere, because its regression would
        predict 0, which is more than negative rewards.
        """
        theta, _, _ = self._regression()
        lowest = torch.zeros_like(theta)
        lowest[:, -1] = torch.finfo(theta.dtype).min  # of the constant feature, which comes last
        return torch.where(self.statistics.is_untried.unsqueeze(-1), lowest, theta)

    @abstractmethod
    def sample(self, mean: Tensor, deviation: Tensor) -> Tensor:
        """Return a score of each option, `[B, num_options]`. Exploring choices take the highest.

        Args:
            mean: expected reward of each option, `[B, num_options]`.
            deviation: its standard deviation, `[B, num_options]`.
        """
        raise NotImplementedError

    def select(self, td: TensorDictBase) -> Tensor:
        """Return the choices `[*B]`: the highest expected reward if the policy is greedy, else the highest sample."""
        if is_greedy():
            return self.greedy_choice()(td)
        observation = td.get(keys.OBSERVATION)
        mean, deviation = self.predict(observation.flatten(0, -2))
        # Untried options come first, in random order.
        first = above_all(torch.rand_like(mean))
        score = torch.where(self.statistics.is_untried, first, self.sample(mean, deviation))
        score = score.reshape(*observation.shape[:-1], -1)
        return masked_values(score, td.get(keys.OPTION_MASK, None)).argmax(-1)

    def greedy_choice(self) -> Callable[[TensorDictBase], Tensor]:
        """Return the choice of the allowed option with the highest expected reward, an untried one only if all are."""
        coefficients = self._greedy_coefficients()

        def choice(td: TensorDictBase) -> Tensor:
            mean = (self.features(td.get(keys.OBSERVATION)) * coefficients).sum(-1)
            return masked_values(mean, td.get(keys.OPTION_MASK, None)).argmax(-1)

        return choice

    def has_updated(self) -> bool:
        """Return whether any reward is known."""
        return bool(self.statistics.counts.any())

    def learn(self, decisions: TensorDictBase) -> dict[str, float]:
        """Add finished decisions, oldest first; return the mean reward of each option among them."""
        options = decisions.get(keys.OPTION)
        rewards = decisions.get(("next", keys.OPTION_RETURN)).squeeze(-1).double()
        features = self.features(decisions.get(("next", keys.DECISION_OBSERVATION)))
        scalars = {}
        for i, name in enumerate(self.specs.option_names):
            own = options == i
            if own.any():
                scalars[f"reward_{name}"] = rewards[own].mean().item()
        self._add(options, rewards, features[torch.arange(len(options), device=options.device), options])
        return scalars

    def _add(self, options: Tensor, rewards: Tensor, features: Tensor) -> None:
        statistics = self.statistics
        statistics.add(options, rewards)
        fade = statistics.discount ** len(options)
        if statistics.memory == "sliding_window":
            size = len(statistics.recent_options)
            self.recent_features = torch.cat([self.recent_features, features])[-size:]
            is_filled = statistics.recent_options >= 0
            options = statistics.recent_options[is_filled]
            rewards = statistics.recent_rewards[is_filled]
            features = self.recent_features[is_filled]
            fade = 0.0
        weights = statistics.weights(len(options))
        self.gram *= fade
        self.moment *= fade
        for i in range(self.specs.num_options):
            weighted = features * (weights * (options == i)).unsqueeze(-1)
            self.gram[i] += weighted.T @ features
            self.moment[i] += weighted.T @ rewards
