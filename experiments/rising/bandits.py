"""Policies that decide which option practises, each for many seeds at once, and a regression that chooses at the end.

A policy has `choose(t, x)`, which returns options `[S]` for the features `[S, F]` of the contexts, `learn`, and
`recommended`, the one option that it recommends for all contexts. None: it has no recommendation of its own.
"""

from __future__ import annotations

import math

import numpy as np
from cases import BEARINGS, Case, best_split


def features(bearing: np.ndarray) -> np.ndarray:
    """Return sines and cosines of the bearing `[..., 11]`: what a polynomial of degree 5 in the unit vector spans."""
    angle = np.radians(bearing)[..., None] * np.arange(1, 6)
    return np.concatenate([np.ones_like(angle[..., :1]), np.cos(angle), np.sin(angle)], -1)


ON_BEARINGS = features(BEARINGS)


class Ridge:
    """For each seed and option, a ridge regression of the return on the context, with a discount for each own decision.

    An option's memory is 1/16 of the run's decisions.
    """

    def __init__(self, num_seeds: int, case: Case) -> None:
        dim = ON_BEARINGS.shape[1]
        self.discount = 1.0 - 16.0 / max(case.horizon, 160)
        self.gram = np.zeros((num_seeds, case.num_options, dim, dim))
        self.moment = np.zeros((num_seeds, case.num_options, dim))
        self.rows = np.arange(num_seeds)

    def learn(self, option: np.ndarray, x: np.ndarray, returns: np.ndarray) -> None:
        """Add a return `[S]` of each seed."""
        own = self.rows, option
        self.gram[own] = self.discount * self.gram[own] + x[:, :, None] * x[:, None]
        self.moment[own] = self.discount * self.moment[own] + x * returns[:, None]

    @property
    def coefficients(self) -> np.ndarray:
        """The regressions' coefficients, `[S, K, F]`; those of an untried option predict the lowest value."""
        theta = np.linalg.solve(self.gram + 0.3 * np.eye(self.gram.shape[-1]), self.moment[..., None])[..., 0]
        untried = self.gram[..., 0, 0] == 0.0
        theta[untried, 0] = -1e9
        return theta

    def choices(self) -> np.ndarray:
        """Return the best option at each of `BEARINGS`, `[S, 360]`."""
        return (self.coefficients @ ON_BEARINGS.T).argmax(1)


class Policy:
    """Choose uniformly; the base of all policies."""

    def __init__(self, num_seeds: int, case: Case, rng: np.random.Generator) -> None:
        self.num_seeds, self.case, self.rng = num_seeds, case, rng
        self.num_options, self.horizon = case.num_options, case.horizon
        self.rows = np.arange(num_seeds)
        self.ridge = Ridge(num_seeds, case)
        self.recommended: np.ndarray | None = None

    def uniform(self) -> np.ndarray:
        """Return uniformly random options `[S]`."""
        return self.rng.integers(self.num_options, size=self.num_seeds)

    def choose(self, t: int, x: np.ndarray) -> np.ndarray:
        """Return the options `[S]` of decision t, counted from 0."""
        return self.uniform()

    def learn(self, t: int, option: np.ndarray, x: np.ndarray, returns: np.ndarray) -> None:
        """Learn from decision t."""
        self.ridge.learn(option, x, returns)


class Single(Policy):
    """Choose option 0."""

    def choose(self, t: int, x: np.ndarray) -> np.ndarray:
        self.recommended = np.zeros(self.num_seeds, dtype=int)
        return self.recommended


class BestSplit(Policy):
    """Choose at random with the probabilities of the best fixed split, which nobody knows."""

    def choose(self, t: int, x: np.ndarray) -> np.ndarray:
        if t == 0:
            self.split, _ = best_split(self.case)
        return self.rng.choice(self.num_options, size=self.num_seeds, p=self.split)


class Contextual(Policy):
    """Choose uniformly with a probability, else by the regression, which is renewed every 16 decisions."""

    def choose(self, t: int, x: np.ndarray) -> np.ndarray:
        if t % 16 == 0:
            self.theta = self.ridge.coefficients
        best = (self.theta @ x[:, :, None])[..., 0].argmax(1)
        is_random = self.rng.random(self.num_seeds) < self.uniform_probability(t / self.horizon)
        return np.where(is_random, self.uniform(), best)

    def uniform_probability(self, fraction: float) -> float:
        """Return the probability of a uniform choice after a fraction of the run."""
        raise NotImplementedError


class ExploreThenCommit(Contextual):
    """Choose uniformly for a third of the run, then by the regression."""

    def uniform_probability(self, fraction: float) -> float:
        return float(fraction < 1 / 3)


class FallingFloor(Contextual):
    """Choose uniformly with a probability that falls linearly from 1 to 0 over the run."""

    def uniform_probability(self, fraction: float) -> float:
        return 1.0 - fraction


class Rising(Policy):
    """The base of rising bandits: means and slopes over the last returns of each option.

    A window holds the last h = floor(n / 4) of an option's n returns. The slope compares it with the window before.
    """

    window = 0.25
    sigma = 1.0

    def __init__(self, num_seeds: int, case: Case, rng: np.random.Generator) -> None:
        super().__init__(num_seeds, case, rng)
        shape = num_seeds, self.num_options, self.horizon + 1
        self.sums, self.weighted = np.zeros(shape), np.zeros(shape)  # of returns x_l, and of l x_l, up to pull l
        self.pulls = np.zeros(shape[:2], dtype=int)

    def learn(self, t: int, option: np.ndarray, x: np.ndarray, returns: np.ndarray) -> None:
        super().learn(t, option, x, returns)
        last = self.rows, option, self.pulls[self.rows, option]
        self.pulls[self.rows, option] += 1
        new = self.rows, option, self.pulls[self.rows, option]
        self.sums[new] = self.sums[last] + returns
        self.weighted[new] = self.weighted[last] + new[-1] * returns

    def windows(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return h, the mean of the last window, of the one before, and the sum of l (x_l - x_(l-h)) / h^2."""
        h = np.floor(self.window * self.pulls).astype(int)
        ends = [(self.pulls - back * h)[..., None] for back in range(3)]
        s0, s1, s2 = (np.take_along_axis(self.sums, end, -1)[..., 0] for end in ends)
        w0, w1, w2 = (np.take_along_axis(self.weighted, end, -1)[..., 0] for end in ends)
        size = np.maximum(h, 1)
        last, before = (s0 - s1) / size, (s1 - s2) / size
        return h, last, before, (w0 - w1 - (w1 - w2)) / size**2 - before

    def bounds(self, target: np.ndarray | float, factor: float) -> np.ndarray:
        """Return optimistic values `[S, K]` of the options at pull number `target`, infinite for fewer than 4 pulls.

        Args:
            target: pull number to which the slope is continued.
            factor: squared width of the bonus in standard deviations.
        """
        h, last, before, moved = self.windows()
        size = np.maximum(h, 1)
        estimate = last + target * (last - before) / size - moved
        bonus = self.sigma * (target - self.pulls + h - 1) * np.sqrt(factor / size**3)
        return np.where(h < 1, np.inf, estimate + np.maximum(bonus, 0.0))

    def highest(self, bounds: np.ndarray) -> np.ndarray:
        """Return the options with the highest bounds, ties broken at random."""
        return np.where(bounds == bounds.max(1, keepdims=True), self.rng.random(bounds.shape), -1.0).argmax(1)


class RedUCB(Rising):
    """R-ed-UCB: the optimistic value at the current round t (Metelli et al. 2022)."""

    def choose(self, t: int, x: np.ndarray) -> np.ndarray:
        self.recommended = self.windows()[1].argmax(1)
        return self.highest(self.bounds(t + 1, 10.0 * 3.0 * math.log(t + 2)))


class RUCBE(Rising):
    """R-UCBE: the optimistic value at the end of the run, T (Mussi et al. 2023, algorithm 1).

    It recommends the highest value without the bonus, as the authors' code does. The paper keeps the bonus.
    """

    exploration = 2.65  # a; in the authors' configuration for a standard deviation of 0.5 and T = 3,200

    def choose(self, t: int, x: np.ndarray) -> np.ndarray:
        self.recommended = self.bounds(self.horizon, 0.0).argmax(1)
        return self.highest(self.bounds(self.horizon, self.exploration))


class CautiousRUCBE(RUCBE):
    """R-UCBE with the least a for which the paper's bound of the error probability, 2TK exp(-a / 10), is below 1."""

    def __init__(self, num_seeds: int, case: Case, rng: np.random.Generator) -> None:
        super().__init__(num_seeds, case, rng)
        self.exploration = 10.0 * math.log(2 * self.horizon * self.num_options)


class CureUCB(Rising):
    """CURE-UCB, as its abstract describes it: the mean optimistic value over the rest of the run.

    With a straight line that is the value in the middle of the remaining decisions.
    """

    def choose(self, t: int, x: np.ndarray) -> np.ndarray:
        self.recommended = self.windows()[1].argmax(1)
        return self.highest(self.bounds(self.pulls + (self.horizon - t) / 2.0, 10.0 * 3.0 * math.log(t + 2)))


class RSR(Rising):
    """R-SR: successive rejects by the mean of the last window (Mussi et al. 2023, algorithm 2)."""

    def choose(self, t: int, x: np.ndarray) -> np.ndarray:
        if t == 0:
            k = self.num_options
            scale = 0.5 + sum(1.0 / i for i in range(2, k + 1))
            lengths = [math.ceil((self.horizon - k) / (k + 1 - j) / scale) for j in range(1, k)]
            self.ends = [0, *lengths]
            self.phase = 1
            self.active = np.ones((self.num_seeds, k), dtype=bool)
        if self.phase < self.num_options and (self.pulls[self.active] >= self.ends[self.phase]).all():
            mean = np.where(self.active, self.windows()[1], np.inf)
            self.active[self.rows, mean.argmin(1)] = False
            self.phase += 1
        self.recommended = self.active.argmax(1)
        return np.where(self.active, self.pulls, self.horizon + 1).argmin(1)


POLICIES = {
    "option 0 alone": Single,
    "uniform": Policy,
    "best split": BestSplit,
    "explore, then commit": ExploreThenCommit,
    "falling floor": FallingFloor,
    "R-ed-UCB": RedUCB,
    "R-UCBE": RUCBE,
    "R-UCBE, cautious": CautiousRUCBE,
    "R-SR": RSR,
    "CURE-UCB": CureUCB,
}
