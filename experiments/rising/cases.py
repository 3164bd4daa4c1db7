"""Options that improve with their own practice: simulated curves, and recorded curves of real learners.

A case has options, a number of decisions (`horizon`) and contexts. The context is the bearing of the goal in degrees.
As on boats, option 0 is better if the bearing is within 30 degrees of one of three directions, otherwise option 1.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy import stats

HERE = Path(__file__).resolve().parent
BEARINGS = np.arange(0.5, 360.0)  # contexts on which final choices are scored

# Advantage of the better boat by the degrees between the bearing and the border of its sector: measured at 5, 15, 25.
BORDER_DISTANCE = np.array([0.0, 5.0, 15.0, 25.0, 30.0])
ADVANTAGE = np.array([0.0, 0.14, 0.44, 0.86, 1.07])
ONE_BOAT, BEST_OF_BOTH = 3.30, 3.571


def offset_of(bearing: np.ndarray) -> np.ndarray:
    """Return the degrees (0 to 60) between bearings and the nearest direction of option 0."""
    return np.abs((bearing - 30.0 + 60.0) % 120.0 - 60.0)


def half_advantage(bearing: np.ndarray) -> np.ndarray:
    """Return half the advantage of option 0 over option 1, negative where option 1 is better.

    It is scaled so that always choosing the better of two options gains `BEST_OF_BOTH - ONE_BOAT`.
    """

    def unscaled(to_border: np.ndarray) -> np.ndarray:
        return np.sign(to_border) * np.interp(np.abs(to_border), BORDER_DISTANCE, ADVANTAGE)

    mean = np.abs(unscaled(30.0 - offset_of(BEARINGS))).mean()
    return (BEST_OF_BOTH - ONE_BOAT) / mean * unscaled(30.0 - offset_of(bearing))


@dataclass(frozen=True)
class Simulated:
    """Options with values start + (plateau - start) (1 - exp(-practice / time constant)).

    Returns have two values, as of success and failure. Their mean is the option's value. Their standard deviation falls
    from 1 to 0.6 and the probability of success rises from 0.2 to 0.9 while the option learns.

    Attributes:
        constants: time constant of each option in own decisions; 0 if its value does not depend on practice.
        plateaus: mean value of each option after much practice.
        starts: value of each option before practice.
        contrast: factor of the context's effect on the plateaus of options 0 and 1.
        horizon: number of decisions.
    """

    constants: tuple[float, ...]
    plateaus: tuple[float, ...] = (ONE_BOAT, ONE_BOAT)
    starts: tuple[float, ...] = (-1.0, -1.0)
    contrast: float = 1.0
    horizon: int = 3000

    @property
    def num_options(self) -> int:
        """Number of options."""
        return len(self.constants)

    def learned(self, practice: np.ndarray) -> np.ndarray:
        """Return which fraction of the way to their plateaus options `[..., K]` have gone."""
        constants = np.maximum(self.constants, 1e-9)
        return np.where(np.array(self.constants) > 0.0, 1.0 - np.exp(-practice / constants), 1.0)

    def values(self, bearing: np.ndarray, practice: np.ndarray) -> np.ndarray:
        """Return the expected returns `[..., K]` at bearings `[...]` after the options' practice `[..., K]`."""
        half = self.contrast * half_advantage(bearing)[..., None]
        effect = half * np.array([1.0, -1.0, *[0.0] * (self.num_options - 2)])
        start = np.array(self.starts)
        # An option that learns nothing does not depend on the context.
        plateau = np.array(self.plateaus) + effect * (np.array(self.plateaus) != start)
        return start + (plateau - start) * self.learned(practice)

    greedy_values = values

    def sample(
        self, rng: np.random.Generator, bearing: np.ndarray, practice: np.ndarray, option: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the returns `[S]` of the chosen options `[S]`, and their expected values."""
        rows = np.arange(len(option))
        value, learned = self.values(bearing, practice)[rows, option], self.learned(practice)[rows, option]
        success, deviation = 0.2 + 0.7 * learned, 1.0 - 0.4 * learned
        above, below = np.sqrt((1.0 - success) / success), -np.sqrt(success / (1.0 - success))
        return value + deviation * np.where(rng.random(len(option)) < success, above, below), value


@dataclass(frozen=True)
class Recorded:
    """Two options with the recorded curves of a learner; option 1 is the mirror image of option 0.

    Practice counts in fractions of the recorded run: an option that makes all decisions goes through the whole curve.
    Returns are normal, with the recorded mean and standard deviation of the exploring learner. Final choices are scored
    with the recorded greedy returns.
    """

    learner: str
    horizon: int = 3000
    speeds: tuple[float, float] = (1.0, 1.0)  # factors of the options' practice
    num_options: int = 2

    @classmethod
    def of(cls, learner: str, speeds: tuple[float, float] = (1.0, 1.0)) -> Recorded:
        """Return the case of a learner, with the decisions of the recorded run, but at most 3,000."""
        with (HERE / "recorded" / f"{learner}.csv").open() as file:
            return cls(learner, min(3000, int(next(csv.DictReader(file))["episodes"])), speeds)

    @cached_property
    def tables(self) -> dict[str, np.ndarray]:
        """The recorded columns by practice and offset, each `[401, 61]`, interpolated."""
        with (HERE / "recorded" / f"{self.learner}.csv").open() as file:
            rows = list(csv.DictReader(file))
        practice = sorted({float(row["practice"]) for row in rows})
        offset = sorted({float(row["offset"]) for row in rows})
        tables = {}
        for name in ("mean", "deviation", "greedy"):
            bins = np.array([float(row[name] or "nan") for row in rows]).reshape(len(practice), len(offset))
            bins = np.where(np.isnan(bins), np.nanmean(bins, 1, keepdims=True), bins)
            by_offset = np.stack([np.interp(np.arange(61), offset, each) for each in bins])
            tables[name] = np.stack([np.interp(np.linspace(0, 1, 401), practice, each) for each in by_offset.T], 1)
        return tables

    def lookup(self, name: str, bearing: np.ndarray, practice: np.ndarray) -> np.ndarray:
        """Return a column `[..., K]` at bearings `[...]` and the options' practice `[..., K]`."""
        offset = offset_of(bearing)
        offsets = np.rint(np.stack([offset, 60.0 - offset], -1)).astype(int)
        fraction = np.minimum(practice * np.array(self.speeds) / self.horizon, 1.0)
        return self.tables[name][np.rint(400.0 * fraction).astype(int), offsets]

    def greedy_values(self, bearing: np.ndarray, practice: np.ndarray) -> np.ndarray:
        """Return the greedy learners' expected returns `[..., K]`; see `lookup`."""
        return self.lookup("greedy", bearing, practice)

    def sample(
        self, rng: np.random.Generator, bearing: np.ndarray, practice: np.ndarray, option: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the returns `[S]` of the chosen options `[S]`, and their expected values."""
        rows = np.arange(len(option))
        mean = self.lookup("mean", bearing, practice)[rows, option]
        deviation = self.lookup("deviation", bearing, practice)[rows, option]
        return mean + deviation * rng.standard_normal(len(option)), mean


Case = Simulated | Recorded

CASES: dict[str, Case] = {
    "50 and 150": Simulated((50, 150)),
    "200 and 800": Simulated((200, 800)),
    "20 and 60": Simulated((20, 60), horizon=500),
    "50 and 150, short": Simulated((50, 150), horizon=500),
    "2,000 and 8,000": Simulated((2000, 8000), horizon=30_000),
    "equal": Simulated((100, 100)),
    "frozen": Simulated((0, 0)),
    "crossing": Simulated((50, 400), plateaus=(3.0, 3.6), contrast=0.5),
    "fruitless third": Simulated((50, 150, 100), plateaus=(ONE_BOAT, ONE_BOAT, -1.0), starts=(-1.0, -1.0, -1.0)),
    "worsening third": Simulated((50, 150, 300), plateaus=(ONE_BOAT, ONE_BOAT, -1.0), starts=(-1.0, -1.0, 3.0)),
    "no contexts": Simulated((50, 150), plateaus=(3.2, 3.5), contrast=0.0),
}


LEARNERS = ("hyar", "hppo", "pdqn", "hsac", "pets")


def all_cases() -> dict[str, Case]:
    """Return the simulated cases, a recorded one for each learner, and one in which option 1 learns more slowly."""
    unequal = Recorded.of("hyar", (1.0, 1 / 3))
    return {
        **CASES,
        **{name: Recorded.of(name) for name in LEARNERS},
        "hyar, unequal": unequal,
    }


def final_values(case: Case, practice: np.ndarray, choice: np.ndarray | None = None) -> np.ndarray:
    """Return the mean over contexts of the greedy values `[S]` of options with the practice `[S, K]`.

    Args:
        case: the case.
        practice: decisions that each option has had.
        choice: the option chosen at each of `BEARINGS`, `[S, 360]`. If None, the truly better one.
    """
    values = case.greedy_values(np.broadcast_to(BEARINGS, (len(practice), 360)), practice[:, None].astype(float))
    if choice is None:
        return values.max(-1).mean(-1)
    return np.take_along_axis(values, choice[..., None], -1).squeeze(-1).mean(-1)


def best_split(case: Case) -> tuple[np.ndarray, float]:
    """Return the fixed split of the decisions, `[K]`, with the highest final value, and that value, by search.

    Of equally good splits it is the most even one.
    """
    steps = np.linspace(0.0, 1.0, 101)
    splits = np.stack([steps, 1.0 - steps], -1)
    if case.num_options == 3:  # a third option that is not worth practising gets nothing, or a little
        splits = np.concatenate(
            [np.c_[(1.0 - third) * splits, np.full(101, third)] for third in (0.0, 0.02, 0.1, 1 / 3)]
        )
    values = final_values(case, splits * case.horizon)
    best = (values - 1e-6 * splits.max(1)).argmax()
    return splits[best], float(values[best])


def single(case: Case) -> float:
    """Return the final value of option 0 alone, with all decisions."""
    practice = np.zeros((1, case.num_options))
    practice[0, 0] = case.horizon
    return float(final_values(case, practice, np.zeros((1, 360), dtype=int))[0])


def case_row(name: str, case: Case) -> dict[str, float | str]:
    """Return what is known of a case: its length, the value of option 0 alone, and the best split with its value."""
    split, value = best_split(case)
    known = {"case": name, "decisions": case.horizon, "alone": round(single(case), 4), "best": round(value, 4)}
    return known | {f"split_{i}": round(float(split[i]), 3) if i < case.num_options else "" for i in range(3)}


def row(
    name: str, case: Case, policy: str, values: dict[str, np.ndarray], practice: np.ndarray, regret: np.ndarray
) -> dict[str, float | str]:
    """Return the row of a policy in a table: means over seeds, and half the width of their 95 % intervals.

    Args:
        name: of the case.
        case: the case.
        policy: name of the policy.
        values: final values `[S]` by the name of their column. `best_choice` is added, the value if the final choice
            were the truly better option. Each also has a column with its share of the best split's gain over option 0
            alone; empty if there is nothing to gain.
        practice: fraction of the decisions that each option has had, `[S, K]`.
        regret: mean shortfall `[S]` of a decision's expected return from the best split's final value.
    """
    best, alone = best_split(case)[1], single(case)
    entries: dict[str, float | str] = {"case": name, "policy": policy, "seeds": len(practice)}
    for column, each in {**values, "best_choice": final_values(case, practice * case.horizon)}.items():
        half = stats.t.ppf(0.975, len(each) - 1) * each.std(ddof=1) / len(each) ** 0.5
        entries |= {column: round(float(each.mean()), 4), f"{column}_ci": round(float(half), 4)}
        share = (each.mean() - alone) / (best - alone) if best - alone > 0.01 else None
        entries[f"{column}_share"] = "" if share is None else round(float(share), 3)
    entries["regret"] = round(float(regret.mean()), 4)
    for i in range(3):
        entries[f"practice_{i}"] = round(float(practice[:, i].mean()), 3) if i < case.num_options else ""
    return entries
