"""Gather, draw and tabulate results on Pinball, Office, circuits, traffic lights and primitives, beside others'.

python experiments/problems/study.py FOLDER...    adds the finished runs in these folders to results.csv and curves.csv,
                                                  those of traffic lights to traffic.csv, too, then draws and tabulates
python experiments/problems/study.py              draws and tabulates the stored csv files
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import get_args

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from experiments.study_tables import (
    Rows,
    Run,
    add_to_tables,
    curve,
    first_at,
    gathered,
    groups,
    markdown_table,
    mean_of,
    read_csv,
    with_enough_seeds,
)
from hpamdp.analysis.statistics import spread
from hpamdp.env.primitives.options import ACTIONS, Reward, Task
from hpamdp.env.primitives.players import MEASURED
from hpamdp.figure_style import LEARNER_COLOURS, STYLE, draw_spread
from hpamdp.messages import exit_code

HERE = Path(__file__).resolve().parent
ENVIRONMENTS = ("circuit", "office", "pinball", "primitives", "traffic")
# Settings of the problem that may differ from its own; those with None tell rows apart.
OF_PROBLEM = {
    **{f"pinball.{setting}": None for setting in ("map", "start", "training_start", "tiles", "grouping")},
    "office.tiles": (20,),
    "office.chooses_goal": None,
    **{f"primitives.{setting}": None for setting in ("task", "reward", "actions", "grouping")},
    **{f"primitives.{setting}": None for setting in ("reach", "negative_distances", "decisions")},
    **{f"traffic.{setting}": None for setting in ("network", "demand", "strategies")},
    **{f"circuit.{setting}": None for setting in ("task", "gate_set", "target_number", "begin")},
    "circuit.reward": ("gain", "final"),
    "circuit.floor": (None, 0.4),
    "circuit.begin_episodes": (0, 80),
    "circuit.begin_gates": (6, 8),
    "circuit.observe_depth": (False, True),
    "circuit.max_steps": (None, 14),
}
CELL = ("problem", "learner", "exploration", "frames")
RUN = ("problem", "learner", "exploration", "seed")
# Results of traffic lights in traffic.csv, of the agent and of the hand-written players on the same demands.
TRAFFIC = ("delay", "queue", "stops", "throughput")
AGENT = "agent"
# What the mean return of a run should reach, by problem, and whose return that is. PEARL's code, with seed 1 of
# experiments/pearl, the best of three: on Pinball's simple map its first and highest evaluation that arrives, after
# 800 episodes; on Office its last evaluation, after 2,100. The published scores of circuits are means of 8 seeds, read
# off a figure.
BARS = {
    "pinball simple": (9_343.0, "PEARL's code"),
    "pinball simple, 4 options": (9_343.0, "PEARL's code"),
    "pinball hard, training_start=anywhere": (9_000.0, "our aim; by hand 9,404"),
    "pinball hard, training_start=both": (9_000.0, "our aim; by hand 9,404"),
    "pinball hard, training_start=both, tiles=20": (9_000.0, "our aim; by hand 9,404"),
    **{
        f"primitives {task}, {reward}{way}": (0.9, f"our aim; by hand {MEASURED[task]['success']:.1f}")
        for reward in get_args(Reward)
        for task in get_args(Task)
        for way in ("", *(f", actions={actions}" for actions in ACTIONS))
    },
    "office": (806.0, "PEARL's code"),
    "office, chooses goal": (806.0, "PEARL's code"),
    "circuit hadamard": (0.88, "published"),
    "circuit bell": (0.95, "published"),
    "circuit ghz": (0.68, "published"),
    "circuit toffoli, begin=known": (0.7, "our aim; published 0.295"),
    # Published runs have one random target each, too.
    "circuit random_state, one target, begin=near_target": (0.84, "published"),
    # The mean best score of 1,000 targets with the set that is better on average.
    "circuit random_state, gate_set=choose": (0.862, "always ion"),
}

# What conf/experiment/primitives.yaml and the defaults set on primitives; other values make another problem.
PRIMITIVES = {"reach": 0.4, "negative_distances": False, "decisions": 5}
# The weight of H-PPO's entropy bonus on Pinball's hard map in the earlier form of conf/experiment/pinball_hard.yaml.
EARLIER_ENTROPY = 0.01
# The weight of counted visits for H-PPO on Office; P-DQN has another one.
OFFICE_WEIGHT = 25


def problem_of(run: Run) -> str:
    """Return the environment of a run, with the settings that make it another problem."""
    name, settings = run.summary["env"], run.config["env"]
    if name == "pinball":
        others = ["from anywhere" if settings["start"] == "anywhere" else ""]
        begins = settings.get("training_start")
        others += ["" if begins in (None, settings["start"]) else f"training_start={begins}"]
        others += [f"tiles={settings['tiles']}" if settings.get("tiles") else ""]
        options = settings.get("grouping") or ()
        others += [f"{len(options)} options" if isinstance(options, dict) else "grouped axes" if options else ""]
        name = f"{name} {settings['map']}"
    elif name == "office":
        others = ["chooses goal" if settings["chooses_goal"] else ""]
    elif name == "primitives":
        others = [
            settings["reward"],
            "" if settings["actions"] == "primitives" else f"actions={settings['actions']}",
            *("" if settings[key] == value else f"{key}={settings[key]}" for key, value in PRIMITIVES.items()),
        ]
        name = f"{name} {settings['task']}"
    elif name == "traffic":
        others = [settings["network"] if settings["network"] != "crossing" else ""]
        others += ["strategies" if settings["strategies"] else ""]
        name = f"{name} {settings['demand']}"
    elif name == "circuit":
        others = [
            f"gate_set={settings['gate_set']}" if settings["gate_set"] != "published" else "",
            "one target" if settings["target_number"] is not None else "",
            f"begin={settings['begin']}" if settings["begin"] != "empty" else "",
        ]
        name = f"{name} {settings['task']}"
    else:
        others = []
    return ", ".join([name, *filter(None, others)])


def learner_of(run: Run) -> str:
    """Return the learner of a run and the selector above it; the selector alone over random play in the options."""
    env, high, low = (run.summary[name] for name in ("env", "high", "low"))
    settings = run.config["low"]
    is_hard_map = env == "pinball" and run.config["env"]["map"] == "hard"
    if is_hard_map and settings.get("discrete_entropy") == EARLIER_ENTROPY:
        low = f"{low}, discrete_entropy={EARLIER_ENTROPY}"
    if high == "none":
        return low
    return high if low == "random" else f"{high} over {low}"


def exploration_of(run: Run) -> str:
    """Return the exploration of a run; on Office with the weight of counted visits, if it is not that of H-PPO."""
    kind: str = run.config["choices"]["exploration"]
    if run.summary["env"] == "office" and kind == "counts":
        weight = run.config["exploration"]["weight"]
        return kind if weight == OFFICE_WEIGHT else f"{kind}, weight={weight:g}"
    return kind


def gather(runs: Sequence[Run]) -> dict[str, Rows]:
    """Return a row for each run, a row for each evaluation, and one for each player of a run on traffic lights."""
    results: Rows = []
    curves: Rows = []
    traffic: Rows = []
    for run in runs:
        summary = run.summary
        # On primitives success is asked for; returns also tell how soon it came.
        score = "success" if summary["env"] == "primitives" else "score"
        name = {
            "problem": problem_of(run),
            "learner": learner_of(run),
            "exploration": exploration_of(run),
            "seed": summary["seed"],
        }
        results.append(
            {
                **name,
                "frames": summary["frames"],
                "score": round(summary[score], 4),
                "success": round(summary["success"], 4) if "success" in summary else "",
                "better_option": round(summary["oracle_agreement"], 4) if "oracle_agreement" in summary else "",
                "cpu_s": round(summary["cpu_s"], 1),
            }
        )
        curves += [
            {**name, "frames": int(row["frames"]), "score": round(row[f"eval/{score}"], 4)} for row in run.evaluations()
        ]
        if summary["env"] == "traffic":
            players = {AGENT: summary, **summary["references"]}
            traffic += [
                {**name, "frames": summary["frames"], "player": player}
                | {result: round(of_player[result], 4) for result in TRAFFIC}
                for player, of_player in players.items()
            ]
    return {"results": results, "curves": curves} | ({"traffic": traffic} if traffic else {})


def table(results: Rows, curves: Rows) -> str:
    """Return a line for each cell with enough seeds: scores, how many runs reach the bar, and after how many steps."""
    lines = []
    evaluations = groups(curves, *RUN)
    for (problem, learner, exploration, frames), rows in groups(with_enough_seeds(results, *CELL), *CELL).items():
        if problem.startswith("traffic"):  # `traffic_table` compares its results
            continue
        if problem not in BARS:
            raise SystemExit(f"{problem}: no return to reach is known; add one to BARS of {Path(__file__).name}")
        bar, whose = BARS[problem]
        digits = 0 if bar > 100.0 else 3
        scores = [row["score"] for row in rows]
        firsts = [first_at(evaluations[problem, learner, exploration, row["seed"]], "score", bar) for row in rows]
        reached = [first["frames"] for first in firsts if first]
        columns = [
            problem,
            learner if exploration == "none" else f"{learner}, {exploration}",
            f"{frames:,}",
            len(rows),
            spread(scores, digits),
            f"{100.0 * mean_of(rows, 'success'):.1f}%",
            f"{min(scores):.{digits}f}",
            f"{bar:,.{digits}f} ({whose})",
            f"{sum(score >= bar for score in scores)} of {len(rows)}",
            f"{min(reached):,} to {max(reached):,}" if reached else "",
            f"{mean_of(rows, 'cpu_s'):.0f} s",
        ]
        lines.append(columns)
    head = (
        "problem | learner | steps | n | return | success | lowest return | return to reach | runs that reach it "
        "| first reached after | CPU"
    )
    return markdown_table(head, lines)


def traffic_table(rows: Rows) -> str:
    """Return a line for each player of a cell, and by how much the agent's delay is lower."""
    lines = []
    for (problem, learner, _, frames), cell in groups(rows, *CELL).items():
        players = groups(cell, "player")
        agent = np.array([row["delay"] for row in players[AGENT,]])
        for (player,), of_player in players.items():
            delays = np.array([row["delay"] for row in of_player])
            lower = "" if player == AGENT else f"{np.mean(1.0 - agent / delays):.1%}".replace("%", " %")
            columns = [problem, learner, f"{frames:,}", len(agent), player.replace("_", " "), spread(delays, 1), lower]
            columns += [spread([row[name] for row in of_player], 1) for name in ("queue", "stops")]
            lines.append([*columns, spread([row["throughput"] for row in of_player], 0)])
    head = "problem | learner | steps | n | player | delay, s | the agent's is lower by | queue | stops | throughput"
    return markdown_table(head, lines)


def draw(curves: Rows, path: Path) -> None:
    """Draw a panel for each task of primitives with dense rewards: the mean over seeds, and one standard deviation."""
    found = groups(with_enough_seeds(curves, *RUN[:-1]), "problem")
    shown = {task: found[problem] for task in get_args(Task) if (problem := (f"primitives {task}, dense",)) in found}
    if not shown:
        return
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(3.6 * len(shown), 3.2), layout="constrained")
        panels = figure.subplots(1, len(shown), squeeze=False)[0]
        for axes, (task, rows) in zip(panels, shown.items(), strict=True):
            for (learner, exploration), runs in groups(rows, *RUN[1:-1]).items():
                label = learner if exploration == "none" else f"{learner}, {exploration}"
                drawn = curve(runs, "frames", "score")
                draw_spread(axes, *drawn, marker=".", label=label, color=LEARNER_COLOURS.get(learner))
            axes.set(title=task, xlabel="primitives", ylabel="success, greedy", ylim=(-0.02, 1.02))
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
            axes.legend(frameon=False, fontsize=7)
        figure.savefig(path)


def main(folders: Sequence[str]) -> None:
    """Add the runs in the folders, if any are given, then draw and tabulate."""
    if folders:
        add_to_tables(HERE, gathered(folders, gather, settings=OF_PROBLEM, env=ENVIRONMENTS), RUN, lengths_differ=True)
    curves = read_csv(HERE / "curves.csv")
    draw(curves, HERE / "primitives.png")
    print(table(read_csv(HERE / "results.csv"), curves))
    print()
    print(traffic_table(with_enough_seeds(read_csv(HERE / "traffic.csv"), *CELL)))


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
