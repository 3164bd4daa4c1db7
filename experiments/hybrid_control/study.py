"""Gather, draw and tabulate H-PPO on two public problems whose actions have two components.

python experiments/hybrid_control/study.py FOLDER...    adds the runs in these folders to results.csv and
                                                        curves.csv, then draws and tabulates
python experiments/hybrid_control/study.py heuristic    plays Gymnasium's hand-written player of LunarLander, and
                                                        prints its mean return
python experiments/hybrid_control/study.py              draws and tabulates the stored csv files
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from experiments.study_tables import (
    Rows,
    Run,
    add_to_tables,
    curve,
    difference,
    gathered,
    groups,
    markdown_table,
    mean_of,
    read_csv,
)
from hpamdp.analysis.statistics import spread
from hpamdp.figure_style import STYLE, draw_spread
from hpamdp.messages import exit_code

HERE = Path(__file__).resolve().parent
# Settings of the problem that may differ from its own; those with None tell rows apart.
OF_PROBLEM = {
    "gymnasium.entry_point": None,
    "gymnasium.action_form": None,
    "gymnasium.max_steps": (5,),
    "gymnasium.kwargs": ({"hit_radius": 0.2},),
}
RUN = ("problem", "variant", "seed")
SHOOT = "hybrid_shoot:HybridShootEnv"
PROBLEMS = {"lunar_lander": "Hybrid LunarLander", "gymnasium": "Hybrid-Shoot"}
# What a score is compared with: Gymnasium's bar, and the best possible return.
BARS = {"lunar_lander": 200.0, "gymnasium": 34.7}
VARIANTS = {
    "independent": "independent heads",
    "autoregressive": "autoregressive heads",
    "summed": "independent heads, credit summed",
    "mixed": "independent heads, credit mixed",
    "one choice": "one choice with its own parameters",
}
COLOURS = dict(zip(VARIANTS, ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#6b6b00"), strict=True))
CURVE_COLUMNS = {"frames": "frames", "eval/score": "score", "eval/success": "success"}
HEURISTIC_EPISODES = 500


def gather(runs: Sequence[Run]) -> dict[str, Rows]:
    """Return a row for each run and a row for each evaluation."""
    results: Rows = []
    curves: Rows = []
    for run in runs:
        summary = run.summary
        name = {"problem": summary["env"], "variant": variant(run), "seed": summary["seed"]}
        results.append(
            {
                **name,
                "score": round(summary["score"], 4),
                "success": round(summary.get("success", float("nan")), 4),
                "frames": summary["frames"],
                "cpu_s": round(summary["cpu_s"], 1),
            }
        )
        for row in run.evaluations():
            values = {short: row.get(column, float("nan")) for column, short in CURVE_COLUMNS.items()}
            curves.append({**name, **{short: round(value, 4) for short, value in values.items()}})
    return {"results": results, "curves": curves}


def variant(run: Run) -> str:
    """Return the key of a run's variant in `VARIANTS`.

    Raises:
        ValueError: the run is of another problem of Gymnasium.
    """
    low, env = run.config["low"], run.config["env"]
    if run.summary["env"] == "gymnasium" and env["entry_point"] != SHOOT:
        raise ValueError(f"env.entry_point={env['entry_point']}, but runs of this study have {SHOOT}")
    if env.get("action_form", "components") == "auto":
        return "one choice"
    if low["autoregressive"]:
        return "autoregressive"
    return "independent" if low["credit"] == "joint" else str(low["credit"])


def table(results: Rows) -> str:
    """Return a line for each problem and variant: mean and standard deviation over seeds."""
    lines = []
    for problem, title in PROBLEMS.items():
        for name, label in VARIANTS.items():
            runs = [row for row in results if (row["problem"], row["variant"]) == (problem, name)]
            if runs:
                score = spread([run["score"] for run in runs], 1)
                success = [run["success"] for run in runs if np.isfinite(run["success"])]
                solved = f"{np.mean(success):.0%}" if success else ""
                costs = f"{mean_of(runs, 'frames'):,.0f}", f"{mean_of(runs, 'cpu_s'):.0f} s"
                lines.append([title, label, len(runs), score, solved, *costs])
    return markdown_table("problem | H-PPO with | seeds | return | solved | steps | CPU", lines)


def differences(results: Rows) -> str:
    """Return a line for each variant: the difference of its return from that of independent heads."""
    lines = []
    for (problem,), rows in groups(results, "problem").items():
        scores = {name: [row["score"] for row in of_name] for (name,), of_name in groups(rows, "variant").items()}
        plain = scores.pop("independent", [])
        for name, others in scores.items():
            if len(plain) > 1 and len(others) > 1:
                lines.append([PROBLEMS[problem], VARIANTS[name], difference(others, plain)])
    return markdown_table("problem | H-PPO with | difference from independent heads (95 % interval)", lines)


def draw(curves: Rows, path: Path) -> None:
    """Draw a panel for each problem: the mean over seeds, with one standard deviation."""
    found = groups(curves, "problem")
    shown = {problem: title for problem, title in PROBLEMS.items() if (problem,) in found}
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(5.4 * len(shown), 3.8), layout="constrained")
        panels = figure.subplots(1, len(shown), squeeze=False)[0]
        for axes, (problem, title) in zip(panels, shown.items(), strict=True):
            _draw_panel(axes, found[problem,], BARS[problem])
            axes.set(title=title, xlabel="steps", ylabel="greedy return")
        figure.savefig(path)


def _draw_panel(axes: Axes, rows: Rows, bar: float) -> None:
    axes.axhline(bar, color="#8c8c8c", linestyle=":", linewidth=1.0)
    found = groups(rows, "variant")
    for name, label in VARIANTS.items():
        if (name,) in found:
            draw_spread(axes, *curve(found[name,], "frames", "score"), color=COLOURS[name], label=label)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.legend(frameon=False, fontsize=7, loc="lower right")


def play_heuristic() -> str:
    """Return a line with the mean return of Gymnasium's hand-written player in Hybrid LunarLander."""
    import gymnasium
    from gymnasium.envs.box2d.lunar_lander import heuristic

    from hpamdp.env.lunar_lander.lander import SOLVED, hybrid_action
    from hpamdp.env.registration import register

    register()
    env = gymnasium.make("hpamdp/LunarLander-v0")
    returns = np.zeros(HEURISTIC_EPISODES)
    for episode in range(HEURISTIC_EPISODES):
        observation, _ = env.reset(seed=1_000_000 + episode)
        is_over = False
        while not is_over:
            action = hybrid_action(heuristic(env, observation))
            observation, reward, terminated, truncated, _ = env.step(action)
            returns[episode] += float(reward)
            is_over = terminated or truncated
    error = returns.std() / HEURISTIC_EPISODES**0.5
    return f"{returns.mean():.1f} (standard error {error:.1f}), {(returns >= SOLVED).mean():.1%} at least {SOLVED:.0f}"


def main(arguments: list[str]) -> None:
    """Gather the runs in these folders, if any, then draw and tabulate the stored files."""
    if arguments == ["heuristic"]:
        print(play_heuristic())
        return
    if arguments:
        add_to_tables(
            HERE,
            gathered(arguments, gather, settings=OF_PROBLEM, env=("gymnasium", "lunar_lander"), low=("hppo",)),
            RUN,
        )
    results, curves = (read_csv(HERE / f"{name}.csv") for name in ("results", "curves"))
    print(table(results))
    print()
    print(differences(results))
    draw(curves, HERE / "curves.png")


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
