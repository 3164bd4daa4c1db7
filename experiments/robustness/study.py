"""Score trained agents under noise, whether or not they were trained with it.

python experiments/robustness/study.py FOLDER...   scores the agents of the finished runs in these folders and puts
                                                   them into results.csv, then draws and tabulates
python experiments/robustness/study.py             draws and tabulates the stored results.csv
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from tqdm import tqdm

from experiments.study_tables import (
    Rows,
    Run,
    difference,
    gathered,
    groups,
    markdown_table,
    read_csv,
    refuse_repeats,
    write_tables,
)
from hpamdp.analysis.statistics import spread
from hpamdp.config.compose import conf_dir
from hpamdp.env.boatdock.reference import HUMAN
from hpamdp.messages import exit_code
from hpamdp.run import checkpoint
from hpamdp.run.assemble import make_agent, make_env, make_evaluation
from hpamdp.run.evaluate import Evaluation
from hpamdp.run.resume import resolve
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
FIGURES = ("score", "success", "too_fast", "out_of_bounds")
AGENT_COLUMNS = ("agent", "boat", "trained_with", "seed")


def name_of(run: Run) -> dict[str, Any]:
    """Return the columns that name a run's agent."""
    high, low, env = run.summary["high"], run.summary["low"], run.config["env"]
    trained_with = [f"{noise} {env[noise]:g}" for noise in LEVELS if env[noise]]
    return {
        "agent": low if high == "none" else f"{high} x {low}",
        "boat": run.summary["controller"],
        "trained_with": PLUS.join(trained_with) or NO_NOISE,
        "seed": run.summary["seed"],
    }


def with_names(runs: Sequence[Run]) -> list[tuple[Run, dict[str, Any]]]:
    """Return each run with the columns that name its agent."""
    return [(run, name_of(run)) for run in runs]


def score(run: Run, evaluations: dict[str, Evaluation]) -> Iterator[dict[str, float | str]]:
    """Yield a row with the score of a run's agent for each noise and level.

    Args:
        run: a finished run.
        evaluations: evaluations so far, by the settings of their environment. New ones are added, since planning
            their layouts takes longer than playing them.
    """
    device = torch.device("cpu")
    overrides = ["mode=eval", f"checkpoint={run.folder}"]
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        config, source = resolve(compose("config", overrides, return_hydra_config=True), overrides)
    env = make_env(config, 1, device, 0)
    agent = make_agent(config, PAMDPSpecs.from_env(env), device)
    checkpoint.load(source, agent, device, with_training=False)
    name, options = name_of(run), config.env.settings
    for noise, levels in LEVELS.items():
        for level in levels:
            noisy = {**options, **dict.fromkeys(LEVELS, 0.0), noise: level}
            key = str((noisy, config.run.eval, config.run.agent))
            if key not in evaluations:
                evaluations[key] = make_evaluation(replace(config, env=replace(config.env, settings=noisy)), env)
            evaluation = evaluations[key]
            measured = evaluation.measure(evaluation.run(agent.policy))
            figures = {figure: round(measured[figure], 4) for figure in FIGURES}
            yield {**name, "noise": noise, "level": level, **figures}


def add(runs: Sequence[tuple[Run, dict[str, Any]]]) -> None:
    """Score the agents of runs, and replace each agent's rows in results.csv.

    Args:
        runs: each run with the columns that name its agent.

    Raises:
        SystemExit: two of the runs have the same agent.
    """
    refuse_repeats([name for _, name in runs], AGENT_COLUMNS, AGENT_COLUMNS)
    evaluations: dict[str, Evaluation] = {}
    for run, name in tqdm(runs):
        new = list(score(run, evaluations))
        old = read_csv(HERE / "results.csv") if (HERE / "results.csv").exists() else []
        kept = [row for row in old if any(row[column] != name[column] for column in AGENT_COLUMNS)]
        write_tables(HERE, {"results": kept + new})


def table(rows: Rows) -> str:
    """Return a line for each agent: mean and standard deviation of the score over seeds at each level of each noise."""
    by_noise = groups(rows, "noise")
    levels = {noise: sorted({row["level"] for row in of_noise} - {0.0}) for (noise,), of_noise in by_noise.items()}
    lines = []
    for agent, of_agent in groups(rows, "agent", "boat", "trained_with").items():
        at = [[spread(_scores(of_agent, noise, level), digits=2) for level in levels[noise]] for noise in levels]
        lines.append([*agent, spread(_scores(of_agent, next(iter(levels)), 0.0), digits=2), *map(", ".join, at)])
    heads = [f"{noise} {', '.join(f'{level:g}' for level in levels[noise])}" for noise in levels]
    return markdown_table(f"agent | controller | trained with | no noise | {' | '.join(heads)}", lines)


def gains_table(rows: Rows) -> str:
    """Return a line for each single noise of H-PPO's training: the gain in score with this noise and without it."""
    lines = []
    rows = [row for row in rows if row["agent"] == "hppo"]
    for (trained_with,), of_training in groups(rows, "trained_with").items():
        if trained_with == NO_NOISE or PLUS in trained_with:
            continue
        noise, level = trained_with.split()
        gains = [
            difference(_scores(of_training, noise, at), _scores(_trained_without(rows), noise, at))
            for at in (float(level), 0.0)
        ]
        lines.append([trained_with, *gains])
    return markdown_table("H-PPO trained with | gain at that noise (95 %) | without noise (95 %)", lines)


def _trained_without(rows: Rows) -> Rows:
    return [row for row in rows if row["trained_with"] == NO_NOISE]


def _scores(rows: Rows, noise: str, level: float) -> list[float]:
    return [row["score"] for row in rows if row["noise"] == noise and row["level"] == level]


def draw(rows: Rows, path: Path) -> None:
    """Draw scores with the congruent controller against the level of each noise.

    The upper row shows all agents trained without noise. The lower row shows H-PPO trained without noise, with this
    noise, and with all three.
    """
    figure = Figure(figsize=(12.0, 7.2), layout="constrained")
    above, below = figure.subplots(2, len(LEVELS), sharey=True)
    rows = [row for row in rows if row["boat"] == "congruent"]
    for upper, lower, noise in zip(above, below, LEVELS, strict=True):
        of_noise = [row for row in rows if row["noise"] == noise]
        _draw_agents(upper, [row for row in of_noise if row["trained_with"] == NO_NOISE])
        _draw_training(lower, [row for row in of_noise if row["agent"] == "hppo"], noise)
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


def _draw_agents(axes: Axes, rows: Rows) -> None:
    """Draw a line for each agent."""
    agents = groups(rows, "agent").items()
    for colour, ((agent,), of_agent) in zip(COLOURS, agents, strict=False):
        _draw_line(axes, of_agent, colour, agent)


def _draw_training(axes: Axes, rows: Rows, noise: str) -> None:
    """Draw a line for training without noise, with this one, and with the most noises."""
    trained = groups(rows, "trained_with")
    names = [name for (name,) in trained]
    with_this = [name for name in names if name.startswith(noise) and PLUS not in name]
    with_most = max(names, key=lambda name: name.count(PLUS), default=NO_NOISE)
    shown = [name for name in dict.fromkeys((NO_NOISE, *with_this, with_most)) if name in names]
    for colour, name in zip(COLOURS, shown, strict=False):
        _draw_line(axes, trained[(name,)], colour, name.replace("_noise", ""))


def _draw_line(axes: Axes, rows: Rows, colour: str, label: str) -> None:
    levels = groups(rows, "level")
    means = [np.mean([row["score"] for row in each]) for each in levels.values()]
    axes.plot([level for (level,) in levels], means, "o-", color=colour, markersize=4, linewidth=1.5, label=label)


def _order(row: dict[str, Any]) -> tuple[bool, int]:
    """Return the place of a row: agents trained without noise first, then those trained with one, two, three."""
    return row["trained_with"] != NO_NOISE, row["trained_with"].count(PLUS)


def main(folders: Sequence[str]) -> None:
    """Score, draw, tabulate."""
    if folders:
        torch.set_num_threads(1)
        noises = {f"boatdock.{name}": None for name in ("controller", *LEVELS)}
        add(gathered(folders, with_names, settings=noises, env=("boatdock",)))
    rows = read_csv(HERE / "results.csv")
    rows.sort(key=_order)
    draw(rows, HERE / "robustness.png")
    print(table(rows), gains_table(rows), sep="\n\n")


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
