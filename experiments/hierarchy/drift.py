"""Test context-free selectors over frozen learners, with motor noise first on one controller, then on the other.

python experiments/hierarchy/drift.py RUN     plays with the learners of a run's output folder, writes drift.csv, draws
python experiments/hierarchy/drift.py         draws and tabulates the stored drift.csv
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from tqdm import tqdm

from experiments.study_tables import Rows, groups, markdown_table, read_csv, write_tables
from hpamdp import keys
from hpamdp.config.compose import read
from hpamdp.config.outside_jobs import composed
from hpamdp.messages import exit_code
from hpamdp.run.assemble import assemble, env_and_policy, make_env

HERE = Path(__file__).resolve().parent
SELECTORS = ("ucb", "thompson", "epsilon_greedy", "exp3")
MEMORIES = {"all": "#2b2b2b", "discounted": "#0072B2", "sliding_window": "#D55E00"}
SEEDS = range(3)
NUM_ENVS = 20
DECISIONS = 10_000  # in each phase
EVERY = 200  # decisions between two rows
# Motor noise of the incongruent and the congruent controller in each phase. The congruent one is better in the first.
NOISE = ((0.15, 0.0), (0.0, 0.15))
BETTER = (1, 0)  # option, in each phase
RECOVERED = 0.8  # fraction of the last EVERY decisions that choose the better controller


def play(run: str, high: str, memory: str, seed: int) -> Iterator[dict[str, float | str]]:
    """Yield a row every `EVERY` decisions: how often the better boat was chosen, and the mean reward of each boat."""
    overrides = [
        f"high={high}",
        f"high.memory={memory}",
        "low=hppo",
        f"low.checkpoint={run}",
        "low.freeze=true",
        f"seed={seed}",
        f"num_envs={NUM_ENVS}",
        "steps_per_batch=1",
        "eval.layouts=1",
    ]
    phases = []
    for incongruent, congruent in NOISE:
        with composed([*overrides, f"env.motor_noise=[{incongruent},{congruent}]"]) as cfg:
            phases.append(read(cfg))
    torch.manual_seed(seed)
    agent = assemble(phases[0]).agent
    for phase, config in enumerate(phases):
        env, policy = env_and_policy(make_env(config, NUM_ENVS, torch.device("cpu"), seed), agent, config)
        options: list[torch.Tensor] = []
        rewards: list[torch.Tensor] = []
        td = env.reset()
        for _ in range(DECISIONS // NUM_ENVS):
            with torch.no_grad():
                td, following = env.step_and_maybe_reset(policy(td))
            agent.learn(td.unsqueeze(-1))
            options.append(td[keys.OPTION])
            rewards.append(td["next", keys.REWARD].squeeze(-1))
            td = following
            if len(options) * NUM_ENVS >= EVERY:
                option = torch.cat(options)
                reward = torch.cat(rewards)
                options, rewards = [], []
                yield {
                    "high": high,
                    "memory": memory,
                    "seed": seed,
                    "phase": phase,
                    "better": round((option == BETTER[phase]).float().mean().item(), 4),
                    "reward_0": _mean_reward(reward[option == 0]),
                    "reward_1": _mean_reward(reward[option == 1]),
                }


def _mean_reward(rewards: torch.Tensor) -> float | str:
    """Return the mean for the csv file, an empty cell if there are no rewards."""
    return round(rewards.mean().item(), 4) if len(rewards) else ""


def recovery(rows: Rows) -> float:
    """Return the decisions of the second phase until a run chooses the better controller again; infinity if never."""
    fractions = [row["better"] for row in rows if row["phase"] == 1]
    return next((number * EVERY for number, each in enumerate(fractions, start=1) if each >= RECOVERED), np.inf)


def table(rows: Rows) -> str:
    """Return a line for each form: how often it ends a phase with the better controller, and recovery by seed."""
    lines = []
    for (high, memory), of_form in groups(rows, "high", "memory").items():
        runs = list(groups(of_form, "seed").values())
        before = np.mean([_last_fractions(run, phase=0) for run in runs])
        after = np.mean([_last_fractions(run, phase=1) for run in runs])
        times = [recovery(run) for run in runs]
        recovered = ", ".join(f"{time:,.0f}" if np.isfinite(time) else "never" for time in times)
        lines.append([high, memory, f"{before:.1%}", f"{after:.1%}", recovered])
    head = "selector | memory | better controller before the change | at the end | decisions to recover, by seed"
    return markdown_table(head, lines)


def _last_fractions(rows: Rows, phase: int) -> list[float]:
    """Return how often the better controller was chosen, in each of the last five rows of a run's phase."""
    return [row["better"] for row in rows if row["phase"] == phase][-5:]


def draw(rows: Rows, path: Path) -> None:
    """Draw how often the better controller is chosen, over decisions, a panel for each selector."""
    figure = Figure(figsize=(13.0, 3.4), layout="constrained")
    for axes, high in zip(figure.subplots(1, len(SELECTORS), sharey=True), SELECTORS, strict=True):
        for memory, colour in MEMORIES.items():
            of_form = [row for row in rows if row["high"] == high and row["memory"] == memory]
            if not of_form:
                continue
            runs = groups(of_form, "seed").values()
            fractions = np.mean([[row["better"] for row in run] for run in runs], axis=0)
            axes.plot(EVERY * np.arange(1, len(fractions) + 1), fractions, color=colour, linewidth=1.4, label=memory)
        axes.axvline(DECISIONS, color="#8c8c8c", linestyle=":")
        axes.set_title(high, loc="left", fontsize=10, fontweight="bold")
        axes.set_xlabel("decisions")
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[0].set_ylabel("share of the better boat")
    figure.axes[0].legend(fontsize=8, frameon=False)
    figure.savefig(path, dpi=130)


def main(arguments: Sequence[str]) -> None:
    """Play, draw, tabulate."""
    if arguments:
        torch.set_num_threads(1)
        forms = itertools.product(SELECTORS, MEMORIES, SEEDS)
        rows = []
        for high, memory, seed in tqdm(forms, total=len(SELECTORS) * len(MEMORIES) * len(SEEDS)):
            rows.extend(play(arguments[0], high, memory, seed))
        write_tables(HERE, {"drift": rows})
    rows = read_csv(HERE / "drift.csv")
    draw(rows, HERE / "drift.png")
    print(table(rows))


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
