"""Score trained agents under noise that they were not, or were, trained with.

python experiments/robustness/study.py FOLDER...   scores the agents of the finished runs in these folders and puts
                                                   them into results.csv, then draws and tabulates
python experiments/robustness/study.py             draws and tabulates what results.csv holds
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from omegaconf import OmegaConf
from tqdm import tqdm

from hpamdp.analysis.study import Rows, Run, finished, groups, read_csv, spread, write_tables
from hpamdp.env.boatdock.reference import HUMAN
from hpamdp.env.decisions import with_decisions
from hpamdp.run import checkpoint
from hpamdp.run.assemble import make_agent, make_env, resolve
from hpamdp.run.evaluate import Evaluation
from hpamdp.specs import PAMDPSpecs

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
COLOURS = ("#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#2b2b2b")
NO_NOISE, PLUS = "no noise", " + "


def score(run: Run, evaluations: dict[str, Evaluation]) -> Iterator[dict[str, float | str]]:
    """Yield a row for each noise and level: the score of a run's agent.

    `evaluations` are kept by the config of their boats: what is known of the layouts takes longer than playing them.
    """
    device = torch.device("cpu")
    with initialize_config_dir(str(HERE.parents[1] / "conf"), version_base="1.3"):
        words = ["mode=eval", f"checkpoint={run.folder}"]
        cfg, settings, source = resolve(compose("config", words), words)
    noisy = [f"{noise} {cfg.env[noise]}" for noise in LEVELS if cfg.env[noise]]
    high, low = run.summary["high"], run.summary["low"]
    who = {"agent": low if high == "none" else f"{high} x {low}", "boat": run.summary["controller"]}
    who |= {"trained_with": PLUS.join(noisy) or NO_NOISE, "seed": cfg.seed}
    agent = make_agent(cfg, settings, PAMDPSpecs.from_env(make_env(cfg, 1, device, 0)), device)
    checkpoint.load(source, agent, device, with_training=False)
    for name, levels in LEVELS.items():
        for level in levels:
            for noise in LEVELS:
                cfg.env[noise] = level if noise == name else 0.0
            boats = OmegaConf.to_yaml(cfg.env)
            if boats not in evaluations:
                env = with_decisions(make_env(cfg, settings.eval.layouts, device, 0))
                evaluations[boats] = Evaluation(env, settings.eval.seed)
            told = evaluations[boats].measure(evaluations[boats].run(agent.policy))
            figures = {key: round(told[key], 4) for key in ("score", "success", "too_fast", "out_of_bounds")}
            yield who | {"noise": name, "level": level} | figures


def add(runs: Sequence[Run]) -> None:
    """Score the runs' agents and put them into results.csv, each as soon as it is done, in the place of its like."""
    file, evaluations = HERE / "results.csv", {}
    for run in tqdm(runs):
        new = list(score(run, evaluations))
        names, old = ("agent", "boat", "trained_with", "seed"), read_csv(file) if file.exists() else []
        kept = [row for row in old if any(row[name] != new[0][name] for name in names)]
        write_tables(HERE, {"results": kept + new})


def table(rows: Rows) -> str:
    """Return a line an agent and noise: the scores at each level, mean and deviation over seeds."""
    lines = ["| agent | boat | trained with | noise | level: score |", "|---|---|---|---|---|"]
    for (*names, noise), of in groups(rows, "agent", "boat", "trained_with", "noise").items():
        levels = groups(of, "level").items()
        said = ", ".join(f"{level:g}: {spread([row['score'] for row in each], 2)}" for (level,), each in levels)
        lines.append(f"| {' | '.join(names)} | {noise} | {said} |")
    return "\n".join(lines)


def draw(rows: Rows, path: Path) -> None:
    """Draw scores on the congruent boat against the level: above without noise in training, below H-PPO with it."""
    figure = Figure(figsize=(12.0, 7.2), layout="constrained")
    above, below = figure.subplots(2, len(LEVELS), sharey=True)
    rows = [row for row in rows if row["boat"] == "congruent"]
    everything = max((row["trained_with"] for row in rows), key=lambda name: name.count(PLUS), default="")
    for upper, lower, noise in zip(above, below, LEVELS, strict=True):
        of = [row for row in rows if row["noise"] == noise]
        calm = groups([row for row in of if row["trained_with"] == NO_NOISE], "agent")
        for colour, ((agent,), each) in zip(COLOURS, calm.items(), strict=False):
            _draw_line(upper, each, colour, agent)
        trained = groups([row for row in of if row["agent"] == "hppo"], "trained_with")
        own = [name for (name,) in trained if name.startswith(noise) and PLUS not in name]
        shown = [name for name in dict.fromkeys((NO_NOISE, *own, everything)) if (name,) in trained]
        for colour, name in zip(COLOURS, shown, strict=False):
            _draw_line(lower, trained[name,], colour, name.replace("_noise", ""))
        upper.set_title(noise, loc="left", fontsize=10, fontweight="bold")
        lower.set_title("H-PPO, trained with", loc="left", fontsize=9)
        lower.set_xlabel(AXES[noise])
        lower.legend(fontsize=8, frameon=False, loc="lower left")
        for axes in (upper, lower):
            axes.axhline(HUMAN["chosen"]["score"], color="#D98200", linestyle="--", linewidth=1.0)
            axes.spines[["top", "right"]].set_visible(False)
    above[0].set_ylabel("score, greedy, 1,000 layouts")
    below[0].set_ylabel("score, greedy, 1,000 layouts")
    above[0].annotate("people 1.97, without noise", (0.4, 2.03), xycoords=("axes fraction", "data"), fontsize=8)
    above[-1].legend(fontsize=8, frameon=False, title="trained with no noise", title_fontsize=8)
    figure.savefig(path, dpi=130)


def _draw_line(axes: Axes, rows: Rows, colour: str, label: str) -> None:
    levels = groups(rows, "level")
    means = [np.mean([row["score"] for row in each]) for each in levels.values()]
    axes.plot([level for (level,) in levels], means, "o-", color=colour, markersize=4, linewidth=1.5, label=label)


def main(folders: Sequence[str]) -> None:
    """Score, draw, tabulate."""
    if folders:
        torch.set_num_threads(1)
        add(finished(folders))
    rows = read_csv(HERE / "results.csv")
    rows.sort(key=lambda row: (row["trained_with"] != NO_NOISE, row["trained_with"].count(PLUS)))
    draw(rows, HERE / "robustness.png")
    print(table(rows))


if __name__ == "__main__":
    main(sys.argv[1:])
