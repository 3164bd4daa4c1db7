"""Play other libraries' bandits in all cases: SMPyBandits and Vowpal Wabbit's cover. Writes peers.csv.

pip install vowpalwabbit==9.11.9 SMPyBandits==0.9.7 "numpy<2" "scipy<1.12" tqdm    in an environment of its own
python experiments/rising/peers.py
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Callable

import numpy as np
import vowpalwabbit
from bandits import ON_BEARINGS, Ridge, features
from cases import BEARINGS, HERE, Case, all_cases, best_split, final_values, row
from SMPyBandits.Policies import SWUCB, UCB

NUM_SEEDS = 10
LOWEST, HIGHEST = -4.0, 6.0  # of returns, which these libraries want in [0, 1]


class Peer:
    """A bandit without contexts, from SMPyBandits; its final choice is the highest mean of the last quarter."""

    def __init__(self, policy: object, case: Case) -> None:
        self.policy = policy
        self.policy.startGame()
        self.last: list[tuple[int, float]] = []
        self.keep = case.horizon // 4

    def choose(self, x: np.ndarray) -> int:
        """Return an option."""
        return int(self.policy.choice())

    def learn(self, x: np.ndarray, option: int, reward: float) -> None:
        """Learn from a reward in [0, 1]."""
        self.policy.getReward(option, reward)
        self.last.append((option, reward))

    def choices(self) -> np.ndarray:
        """Return the option at each of `BEARINGS`."""
        options, rewards = map(np.array, zip(*self.last[-self.keep :], strict=True))
        means = [rewards[options == i].mean() if (options == i).any() else -1.0 for i in range(self.policy.nbArms)]
        return np.full(len(BEARINGS), int(np.argmax(means)))


class Cover:
    """Vowpal Wabbit's cover of four policies, on the features of the regressions of `bandits`."""

    def __init__(self, case: Case, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.workspace = vowpalwabbit.Workspace(
            f"--cb_explore {case.num_options} --cover 4 --quiet --random_seed {seed + 1}"
        )

    @staticmethod
    def text(x: np.ndarray) -> str:
        """Return the features as Vowpal Wabbit reads them."""
        return "| " + " ".join(f"f{i}:{each:.4f}" for i, each in enumerate(x) if i)

    def probabilities(self, x: np.ndarray) -> np.ndarray:
        """Return the options' probabilities."""
        p = np.array(self.workspace.predict(self.text(x)))
        return p / p.sum()

    def choose(self, x: np.ndarray) -> int:
        """Return an option."""
        self.p = self.probabilities(x)
        return int(self.rng.choice(len(self.p), p=self.p))

    def learn(self, x: np.ndarray, option: int, reward: float) -> None:
        """Learn from a reward in [0, 1]."""
        self.workspace.learn(f"{option + 1}:{1.0 - reward:.4f}:{self.p[option]:.4f} {self.text(x)}")

    def choices(self) -> np.ndarray:
        """Return the option at each of `BEARINGS`."""
        return np.array([self.probabilities(x).argmax() for x in ON_BEARINGS])


PEERS: dict[str, Callable[[Case, int], Peer | Cover]] = {
    "SMPyBandits UCB": lambda case, seed: Peer(UCB(case.num_options), case),
    "SMPyBandits sliding-window UCB": lambda case, seed: Peer(SWUCB(case.num_options, tau=500), case),
    "Vowpal Wabbit cover": Cover,
}


def play(case: Case, build: Callable[[Case, int], Peer | Cover], seed: int) -> tuple[float, float, np.ndarray, float]:
    """Return the final value by its own choice and by the regression, the practice and the regret."""
    np.random.seed(seed)  # SMPyBandits uses the global generator
    rng, peer, ridge = np.random.default_rng(seed), build(case, seed), Ridge(1, case)
    practice, earned = np.zeros((1, case.num_options)), 0.0
    for _ in range(case.horizon):
        bearing = rng.uniform(0.0, 360.0, 1)
        x = features(bearing)
        option = np.array([peer.choose(x[0])])
        returns, mean = case.sample(rng, bearing, practice, option)
        practice[0, option] += 1
        earned += mean[0]
        ridge.learn(option, x, returns)
        peer.learn(x[0], int(option[0]), float(np.clip((returns[0] - LOWEST) / (HIGHEST - LOWEST), 0.0, 1.0)))
    own, by_context = (final_values(case, practice, choice)[0] for choice in (peer.choices()[None], ridge.choices()))
    return own, by_context, practice[0] / case.horizon, best_split(case)[1] - earned / case.horizon


def main(names: list[str]) -> None:
    """Play the cases, by default all, and write the table."""
    cases, rows = all_cases(), []
    for name in names or [name for name, case in cases.items() if case.horizon <= 3000]:  # others take minutes
        case = cases[name]
        for peer, build in PEERS.items():
            own, by_context, practice, regret = map(
                np.array, zip(*(play(case, build, seed) for seed in range(NUM_SEEDS)), strict=True)
            )
            rows.append(row(name, case, peer, {"value": own, "by_context": by_context}, practice, regret))
        with (HERE / "peers.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, rows[0], lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    main(sys.argv[1:])
