"""Context-free selectors over frozen learners, one boat handicapped by motor noise, the other one half-way on.

python experiments/hierarchy/drift.py RUN     plays with the learners of a run's output folder, writes drift.csv, draws
python experiments/hierarchy/drift.py         draws and tabulates what drift.csv holds
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from matplotlib.figure import Figure
from tqdm import tqdm

from hpamdp import keys
from hpamdp.analysis.study import Rows, groups, read_csv, write_tables
from hpamdp.config import run_config
from hpamdp.run.assemble import acting, assemble, make_env

HERE = Path(__file__).resolve().parent
SELECTORS = ("ucb", "thompson", "epsilon_greedy", "exp3")
MEMORIES = {"all": "#2b2b2b", "discounted": "#0072B2", "sliding_window": "#D55E00"}
SEEDS = range(3)
NUM_ENVS, DECISIONS, EVERY = 20, 10_000, 200
# Of the incongruent and of the congruent boat: the congruent one is the better one first, then the other.
NOISE = ((0.15, 0.0), (0.0, 0.15))
RECOVERED = 0.8  # share of the better boat among the last EVERY decisions


def play(run: str, high: str, memory: str, seed: int) -> Iterator[dict[str, float | str]]:
    """Yield a row every `EVERY` decisions: the share of the better boat, and its mean payoff less that earned."""
    words = [f"high={high}", f"high.memory={memory}", "low=hppo", f"low.checkpoint={run}", "low.freeze=true"]
    words += [f"seed={seed}", f"num_envs={NUM_ENVS}", "steps_per_batch=1", "eval.layouts=1"]
    with initialize_config_dir(str(HERE.parents[1] / "conf"), version_base="1.3"):
        phases = [compose("config", [*words, f"env.motor_noise=[{a},{b}]"]) for a, b in NOISE]
    settings = run_config(phases[0])
    torch.manual_seed(seed)
    agent = assemble(phases[0], settings, Path(tempfile.gettempdir())).agent
    for phase, cfg in enumerate(phases):
        env, policy = acting(make_env(cfg, NUM_ENVS, torch.device("cpu"), seed), agent, settings)
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
            if sum(map(len, options)) >= EVERY:
                option, reward = torch.cat(options), torch.cat(rewards)
                options, rewards = [], []
                row = {"high": high, "memory": memory, "seed": seed, "phase": phase}
                yield (
                    row
                    | {"better": round((option == 1 - phase).float().mean().item(), 4)}
                    | {
                        f"reward_{i}": round(reward[option == i].mean().item(), 4) if (option == i).any() else ""
                        for i in range(2)
                    }
                )


def recovery(rows: Rows) -> float:
    """Return after how many decisions of the second phase the better boat has its share; inf if never."""
    after = [row["better"] for row in rows if row["phase"] == 1]
    return next(((i + 1) * EVERY for i, share in enumerate(after) if share >= RECOVERED), np.inf)


def table(rows: Rows) -> str:
    """Return a line a form: the share of the better boat at the phases' ends, and the decisions to recover."""
    lines = [
        "| selector | memory | better boat before the change | at the end | decisions to recover, by seed |",
        "|---|---|---|---|---|",
    ]
    for (high, memory), of in groups(rows, "high", "memory").items():
        ends = []
        for phase in range(2):
            shares = [[r["better"] for r in one if r["phase"] == phase][-5:] for one in groups(of, "seed").values()]
            ends.append(np.mean(shares))
        times = [recovery(one) for one in groups(of, "seed").values()]
        said = ", ".join(f"{time:,.0f}" if np.isfinite(time) else "never" for time in times)
        lines.append(f"| {high} | {memory} | {ends[0]:.1%} | {ends[1]:.1%} | {said} |")
    return "\n".join(lines)


def draw(rows: Rows, path: Path) -> None:
    """Draw the share of the better boat over decisions, a panel a selector."""
    figure = Figure(figsize=(13.0, 3.4), layout="constrained")
    for axes, high in zip(figure.subplots(1, len(SELECTORS), sharey=True), SELECTORS, strict=True):
        for memory, colour in MEMORIES.items():
            of = [row for row in rows if row["high"] == high and row["memory"] == memory]
            if of:
                shares = np.mean([[row["better"] for row in one] for one in groups(of, "seed").values()], 0)
                axes.plot(EVERY * np.arange(1, len(shares) + 1), shares, color=colour, linewidth=1.4, label=memory)
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
        forms = [(high, memory, seed) for high in SELECTORS for memory in MEMORIES for seed in SEEDS]
        write_tables(HERE, {"drift": [row for form in tqdm(forms) for row in play(arguments[0], *form)]})
    rows = read_csv(HERE / "drift.csv")
    draw(rows, HERE / "drift.png")
    print(table(rows))


if __name__ == "__main__":
    main(sys.argv[1:])
