"""Score trained agents under noise that they were not, or were, trained with.

python experiments/robustness/study.py RUN...   scores the agents in these folders, writes results.csv, then draws
python experiments/robustness/study.py          draws and tabulates what results.csv holds
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from matplotlib.figure import Figure
from tqdm import tqdm

from hpamdp import checkpoint
from hpamdp.assemble import make_agent, make_env, resolve
from hpamdp.env.decisions import with_decisions
from hpamdp.evaluate import Evaluation
from hpamdp.specs import PAMDPSpecs
from hpamdp.study import Rows, groups, read_csv, spread, write_csv

HERE = Path(__file__).resolve().parent
LEVELS = {
    "motor_noise": (0.0, 0.05, 0.1, 0.2, 0.3),
    "sensor_noise": (0.0, 2.0, 5.0, 10.0, 20.0),
    "slip": (0.0, 0.05, 0.1, 0.2, 0.4),
}
AXES = {
    "motor_noise": "deviation of the log of the duration",
    "sensor_noise": "deviation of positions, px",
    "slip": "probability of a random key",
}
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")


def score(folder: str) -> Iterator[dict[str, float | str]]:
    """Yield a row for each noise and level: the score of the agent in a run's output folder."""
    device = torch.device("cpu")
    with initialize_config_dir(str(HERE.parents[1] / "conf"), version_base="1.3"):
        words = ["mode=eval", f"checkpoint={folder}"]
        cfg, settings, source = resolve(compose("config", words), words)
    trained = {name: cfg.env[name] for name in LEVELS}
    noisy = [f"{name} {value}" for name, value in trained.items() if value]
    low = {"agent": f"{cfg.high._target_ and cfg.high._target_.split('.')[-2]} x {cfg.low._target_.split('.')[-2]}"}
    agent = make_agent(cfg, settings, PAMDPSpecs.from_env(make_env(cfg, 1, device, 0)), device)
    checkpoint.load(source, agent, device, with_training=False)
    for name, levels in LEVELS.items():
        for level in levels:
            noise = {other: 0.0 for other in LEVELS} | {name: level}
            for other, value in noise.items():
                cfg.env[other] = value
            evaluation = Evaluation(with_decisions(make_env(cfg, settings.eval.layouts, device, 0)), settings.eval.seed)
            told = evaluation.measure(evaluation.run(agent.policy))
            row = low | {
                "trained_with": ", ".join(noisy) or "no noise",
                "seed": cfg.seed,
                "noise": name,
                "level": level,
            }
            yield row | {key: round(told[key], 4) for key in ("score", "success", "too_fast", "out_of_bounds")}


def table(rows: Rows) -> str:
    """Return a line an agent and noise: the scores at each level, mean and deviation over seeds."""
    lines = ["| agent | trained with | noise | level: score |", "|---|---|---|---|"]
    for (agent, trained, noise), of in groups(rows, "agent", "trained_with", "noise").items():
        levels = groups(of, "level").items()
        said = ", ".join(f"{level:g}: {spread([row['score'] for row in each], 2)}" for (level,), each in levels)
        lines.append(f"| {agent} | {trained} | {noise} | {said} |")
    return "\n".join(lines)


def draw(rows: Rows, path: Path) -> None:
    """Draw the scores against the level, a panel a noise."""
    figure = Figure(figsize=(12.0, 3.6), layout="constrained")
    panels = figure.subplots(1, len(LEVELS), sharey=True)
    for axes, noise in zip(panels, LEVELS, strict=True):
        agents = groups([row for row in rows if row["noise"] == noise], "agent", "trained_with")
        for colour, ((agent, trained), of) in zip(COLOURS, agents.items(), strict=False):
            levels = groups(of, "level")
            means = [np.mean([row["score"] for row in each]) for each in levels.values()]
            axes.plot([level for (level,) in levels], means, "o-", color=colour, label=f"{agent}, {trained}")
        axes.axhline(1.97, color="#D98200", linestyle="--", linewidth=1.0)
        axes.set_title(noise, loc="left", fontsize=10, fontweight="bold")
        axes.set_xlabel(AXES[noise])
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("score, greedy, 1,000 layouts")
    panels[0].annotate("people 1.97", (0.5, 2.03), xycoords=("axes fraction", "data"), fontsize=8)
    panels[-1].legend(fontsize=8, frameon=False)
    figure.savefig(path, dpi=130)


def main(folders: Sequence[str]) -> None:
    """Score, draw, tabulate."""
    if folders:
        torch.set_num_threads(1)
        write_csv(HERE / "results.csv", [row for folder in tqdm(folders) for row in score(folder)])
    rows = read_csv(HERE / "results.csv")
    draw(rows, HERE / "robustness.png")
    print(table(rows))


if __name__ == "__main__":
    main(sys.argv[1:])
