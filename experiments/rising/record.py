"""Record the returns of learners over their own practice: one boat each, no selector.

python experiments/rising/record.py LEARNER [SEEDS]    trains the learner and writes recorded/LEARNER.csv

The csv has a row for each bin of practice and each bin of the goal's bearing offset: number, mean and standard
deviation of the exploring returns, and the mean return of the greedy evaluation nearest to the bin's middle.
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np

import hpamdp
from hpamdp import keys
from hpamdp.run.callbacks import Callback
from hpamdp.run.trainer import Trainer

HERE = Path(__file__).resolve().parent
NUM_PRACTICE_BINS = 40
OFFSETS = np.linspace(0.0, 60.0, 7)
# Steps of a run with one boat: those of the whole task, see the learners' recipes.
TOTAL_FRAMES = {"hyar": 120_000, "hppo": 4_000_000, "pdqn": 400_000, "hsac": 200_000, "pets": 512}
GOAL = (14, 15)  # entries of the observation: the goal relative to the boat


def offset_of(bearing: np.ndarray) -> np.ndarray:
    """Return the degrees (0 to 60) between bearings in degrees and the nearest congruent direction."""
    return np.abs((bearing - 30.0 + 60.0) % 120.0 - 60.0)


class Recording(Callback):
    """Keep offset and return of every finished episode, and the greedy returns by offset at every evaluation."""

    def __init__(self) -> None:
        self.offsets: list[np.ndarray] = []
        self.returns: list[np.ndarray] = []
        self.greedy: list[tuple[int, np.ndarray]] = []  # own practice, mean greedy return of each bin of offsets
        self.num_episodes = 0

    def on_start(self, trainer: Trainer) -> None:
        """Listen to what the recorder and the evaluation get."""
        take, measure = trainer.recorder.take, trainer.parts.evaluation.measure

        def taking(batch, scalars):
            if batch is not None:
                self.add(batch)
            take(batch, scalars)

        def measuring(played):
            self.add_evaluation(played)
            return measure(played)

        trainer.recorder.take, trainer.parts.evaluation.measure = taking, measuring

    def add(self, batch) -> None:
        """Add the episodes that ended in a batch `[*B, T]`, oldest first."""
        after = batch.get("next").transpose(0, -1)
        ended = after[after.get(keys.DONE).squeeze(-1)]
        x, y = ended.get(keys.DECISION_OBSERVATION)[:, GOAL].double().numpy().T
        self.offsets.append(offset_of(np.degrees(np.arctan2(y, x))))
        self.returns.append(ended.get(keys.EPISODE_RETURN).squeeze(-1).double().numpy())
        self.num_episodes += len(ended)

    def add_evaluation(self, played: Mapping[str, np.ndarray]) -> None:
        """Add the mean greedy return of each bin of offsets."""
        number = bin_of(played["bearing_offset"], OFFSETS)
        means = np.array([played["return"][number == i].mean() for i in range(len(OFFSETS) - 1)])
        self.greedy.append((self.num_episodes, means))


def bin_of(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return the number of the bin that holds each value."""
    return np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)


def record(learner: str, seed: int) -> Recording:
    """Return the recording of one training."""
    recording = Recording()
    total = TOTAL_FRAMES[learner]
    # PETS plans every action, so its evaluations are few and small.
    plans = learner == "pets"
    sizes = {"eval.every": total // (8 if plans else NUM_PRACTICE_BINS), "eval.layouts": 120 if plans else 1000}
    hpamdp.train(
        "boatdock",
        controller="congruent",
        high="none",
        low=learner,
        seed=seed,
        total_frames=total,
        callbacks=[recording],
        progress=False,
        threads=1,
        **{"eval.seed": 7, **sizes},
    )
    return recording


def rows_of(recordings: list[Recording]) -> list[dict[str, float]]:
    """Return a row for each bin of practice and of offsets; the practice of each run is a fraction of its episodes."""
    practice = np.concatenate([(np.arange(each.num_episodes) + 0.5) / each.num_episodes for each in recordings])
    offsets = np.concatenate([np.concatenate(each.offsets) for each in recordings])
    returns = np.concatenate([np.concatenate(each.returns) for each in recordings])
    num_bins = min(NUM_PRACTICE_BINS, len(returns) // (10 * (len(OFFSETS) - 1)))  # at least 10 returns in a cell
    of_practice = bin_of(practice, np.linspace(0.0, 1.0, num_bins + 1))
    of_offset = bin_of(offsets, OFFSETS)
    episodes = round(np.mean([each.num_episodes for each in recordings]))
    rows = []
    for i in range(num_bins):
        middle = (i + 0.5) / num_bins
        nearest = [min(e.greedy, key=lambda g, e=e: abs(g[0] / e.num_episodes - middle))[1] for e in recordings]
        greedy = np.mean(nearest, 0)
        for j in range(len(OFFSETS) - 1):
            own = returns[(of_practice == i) & (of_offset == j)]
            rows.append(
                {
                    "practice": round(middle, 4),
                    "offset": (OFFSETS[j] + OFFSETS[j + 1]) / 2.0,
                    "num": len(own),
                    "mean": round(own.mean(), 3) if len(own) else "",
                    "deviation": round(own.std(), 3) if len(own) else "",
                    "greedy": round(greedy[j], 3),
                    "episodes": episodes,
                }
            )
    return rows


def main(learner: str, seeds: str = "3") -> None:
    """Train and write the csv."""
    rows = rows_of([record(learner, int(seed)) for seed in seeds.split(",")])
    (HERE / "recorded").mkdir(exist_ok=True)
    with (HERE / "recorded" / f"{learner}.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main(*sys.argv[1:])
