"""Play a million episodes of each problem, and ten million boats at once.

python experiments/large/study.py episodes [PROBLEM...]   adds rows to episodes.csv
python experiments/large/study.py boats NUMBER            prints time and memory of 10^7 boats
python experiments/large/study.py                         prints the table
"""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

import hpamdp
from experiments.study_tables import Rows, markdown_table, read_csv, write_tables
from hpamdp import keys
from hpamdp.env.decisions import with_decisions
from hpamdp.messages import exit_code

HERE = Path(__file__).resolve().parent
PROBLEMS = ["boatdock", "boatdock_unseen", "goal", "hard_goal", "platform", "catch_point", "hard_move", "moving"]
NUM_ENVS = 4_096
NUM_EPISODES = 1_000_000
SEED = 601


def played(problem: str) -> dict[str, float | str]:
    """Play random episodes of a problem, and compare the second tenth with the last one.

    The first tenth holds more short episodes than long ones, since only ended episodes count.
    """
    torch.manual_seed(SEED)
    env = with_decisions(hpamdp.make(problem, num_envs=NUM_ENVS, seed=SEED))
    began = time.process_time()
    td = env.reset()
    starts, returns, lengths = [td["observation"].numpy().copy()], [], []
    num = num_steps = num_unusual = 0
    while num < NUM_EPISODES:
        step, following = env.step_and_maybe_reset(env.rand_action(td))
        end = step["next"]
        is_finite = end["observation"].isfinite().all(-1) & end["reward"].squeeze(-1).isfinite()
        num_unusual += int((~is_finite).sum())
        done = end["done"].squeeze(-1)
        returns.append(end[keys.EPISODE_RETURN][done].squeeze(-1).numpy())
        lengths.append(end[keys.EPISODE_STEPS][done].squeeze(-1).numpy())
        starts.append(following["observation"][done].numpy())
        num, num_steps = num + int(done.sum()), num_steps + NUM_ENVS
        td = following
    seconds = time.process_time() - began
    scores, counts, first = (np.concatenate(each)[:NUM_EPISODES] for each in (returns, lengths, starts))
    rows = np.ascontiguousarray(first).view([("row", np.void, first.dtype.itemsize * first.shape[1])])
    tenth = NUM_EPISODES // 10
    return {
        "problem": problem,
        "episodes": NUM_EPISODES,
        "steps": num_steps,
        "not_finite": num_unusual,
        "equal_starts": NUM_EPISODES - len(np.unique(rows)),
        "return_early": round(float(scores[tenth : 2 * tenth].mean()), 4),
        "return_late": round(float(scores[-tenth:].mean()), 4),
        "error": round(float(scores.std() / np.sqrt(tenth) * np.sqrt(2)), 4),
        "length_early": round(float(counts[tenth : 2 * tenth].mean()), 3),
        "length_late": round(float(counts[-tenth:].mean()), 3),
        "cpu_s": round(seconds, 1),
    }


def table(rows: Rows) -> str:
    """Return a line for each problem."""
    head = "problem | steps | not finite | equal starts | return, second tenth | last tenth | standard error of the "
    head += "difference | steps an episode, second tenth | last tenth | CPU"
    lines = []
    for row in rows:
        means = (row[name] for name in ("return_early", "return_late", "error", "length_early", "length_late"))
        counts = (f"{row['steps']:,}", row["not_finite"], f"{row['equal_starts']:,}")
        lines.append([row["problem"], *counts, *means, f"{row['cpu_s']:.0f} s"])
    return markdown_table(head, lines)


def boats(num_envs: int) -> None:
    """Step many boats ten times, and compare the first thousand with a batch of a thousand."""
    torch.manual_seed(SEED)
    few, many = (hpamdp.make("boatdock", num_envs=num, seed=SEED) for num in (1_000, num_envs))
    began = time.process_time()
    one, other = few.reset(), many.reset()
    for _ in range(10):
        other = many.rand_action(other)
        one["action"], one["option"] = other["action"][:1_000], other["option"][:1_000]
        (_, one), (_, other) = few.step_and_maybe_reset(one), many.step_and_maybe_reset(other)
        assert torch.equal(one["observation"], other["observation"][:1_000])
    seconds = time.process_time() - began
    gib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    of = f"{num_envs:,} boats: 10 steps in {seconds:.1f} CPU s, at most {gib:.1f} GiB"
    print(f"{of}; the first 1,000 are as in a batch of their own")


def main(words: Sequence[str]) -> None:
    """Play if asked, tabulate."""
    torch.set_num_threads(1)
    if words[:1] == ["boats"]:
        boats(int(words[1]))
        return
    file = HERE / "episodes.csv"
    rows = {row["problem"]: row for row in read_csv(file)} if file.exists() else {}
    if words:
        for problem in words[1:] or PROBLEMS:
            rows[problem] = played(problem)
            write_tables(HERE, {"episodes": [rows[each] for each in PROBLEMS if each in rows]})
    print(table([*rows.values()]))


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
