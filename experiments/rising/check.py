"""Compare the rising bandits of this study with numbers and claims of their papers.

python experiments/rising/check.py
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from bandits import RSR, RUCBE, Policy, RedUCB, Rising, features

from hpamdp.messages import exit_code

Curve = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Curves:
    """Options with given curves and normal noise, without contexts; what a policy needs to know of a case."""

    curves: Sequence[Curve]
    deviation: float
    horizon: int

    @property
    def num_options(self) -> int:
        """Number of options."""
        return len(self.curves)

    def play(self, build: type[Policy], num_seeds: int) -> Policy:
        """Return a policy that has made all decisions; its numbers are those of its `pulls`."""
        rng = np.random.default_rng(0)
        policy, practice = build(num_seeds, self, rng), np.zeros((num_seeds, self.num_options))
        rows, x = np.arange(num_seeds), features(np.zeros(num_seeds))
        for t in range(self.horizon):
            option = policy.choose(t, x)
            mean = np.stack([curve(practice[:, i]) for i, curve in enumerate(self.curves)], -1)[rows, option]
            policy.learn(t, option, x, mean + self.deviation * rng.standard_normal(num_seeds))
            practice[rows, option] += 1
        return policy


def saturating(level: float, scale: float) -> Curve:
    """Return the curve level (1 - scale / (scale + n))."""
    return lambda n: level * n / (scale + n)


# Mussi et al. 2023, section 7: five options, standard deviation 0.01. Option 0 is best for budgets above 185.
FIVE = (saturating(1, 37), saturating(0.88, 10), saturating(0.78, 1), saturating(0.7, 10), saturating(0.5, 20))
# Error probabilities of figure 3, from the authors' repository MontenegroAlessandro/BestArmIdSRB.
FIGURE_3 = {RUCBE: {150: 0.65, 200: 0.0, 500: 0.0}, RSR: {700: 1.0, 800: 1.0, 900: 0.06, 1000: 0.0}}
# Metelli et al. 2022: the instance with two options, from the authors' repository stochastic-rising-bandits.
TWO = (saturating(0.4, 500), lambda n: np.minimum(n / 25_000, 1.0))


class ExactRUCBE(RUCBE):
    """R-UCBE with the settings of the figure: a is 222 in the authors' configuration."""

    sigma, exploration = 0.01, 222.4


class ExactRedUCB(RedUCB):
    """R-ed-UCB with the noise of the figure."""

    sigma = 0.1


def main() -> None:
    """Print measured and published numbers."""
    print("| policy | budget | error, published | error, measured |\n|---|---|---|---|")
    for build, published in FIGURE_3.items():
        for budget, error in published.items():
            policy = Curves(FIVE, 0.01, budget).play(ExactRUCBE if build is RUCBE else build, 100)
            assert policy.recommended is not None
            print(f"| {build.__name__} | {budget:,} | {error:.2f} | {(policy.recommended != 0).mean():.2f} |")
    for horizon in (10_000, 50_000):
        policy = Curves(TWO, 0.1, horizon).play(ExactRedUCB, 10)
        assert isinstance(policy, Rising)
        late = policy.pulls[:, 1].mean() / horizon
        print(f"R-ed-UCB, two options, {horizon:,} decisions: the late option has {late:.1%} of them")


if __name__ == "__main__":
    sys.exit(exit_code(main))
