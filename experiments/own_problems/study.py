"""Tabulate and draw hpamdp with its defaults beside PPO of Stable-Baselines3, against CPU seconds.

python experiments/own_problems/study.py FOLDER    gathers the curves in the folder into curves.csv, then tabulates
python experiments/own_problems/study.py           tabulates the stored csv file
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path

from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from experiments.study_tables import (
    Rows,
    first_at,
    groups,
    markdown_table,
    read_csv,
    refuse_repeats,
    write_tables,
)
from hpamdp.analysis.statistics import spread
from hpamdp.figure_style import FAINT, INK, LEARNER_COLOURS, STYLE
from hpamdp.messages import exit_code

HERE = Path(__file__).resolve().parent
NAME = ("problem", "library", "player", "seed")
LATENESS = 3.0  # CPU seconds by which a score may follow the time that it stands for
LEVEL = 0.8  # of the way from random play to the best policy
END = 60.0  # CPU seconds of a run
COLOURS = {"ppo raw": FAINT, "ppo normalised": INK, "ppo informed": "#D55E00", "hppo low.memory=gru": "#56B4E9"}
DEFAULT_FORMS = ("ppo raw", "ppo normalised")  # of PPO, with its defaults
PLAYERS = ("hppo", "pdqn", "hsac", *DEFAULT_FORMS, "ppo informed")


def gather(folder: Path, order: Sequence[str]) -> Rows:
    """Return the rows of all curves in the folder, in the order of problems, players and seeds.

    Raises:
        SystemExit: two files are of one run.
    """
    rows = [row for file in sorted(folder.glob("*.csv")) for row in read_csv(file)]
    refuse_repeats(rows, (*NAME, "cpu_s"), NAME)
    return sorted(rows, key=lambda row: (order.index(row["problem"]), row["library"], row["player"], row["seed"]))


def way_at(run: Rows, cpu_s: float) -> float:
    """Return the way by then. Before its first score a run has made none; one that has ended keeps its last agent."""
    return next((row["way"] for row in reversed(run) if row["cpu_s"] <= cpu_s + LATENESS), 0.0)


def seconds_to(run: Rows, level: float) -> float:
    """Return the CPU seconds of the first score of at least `level`; infinity if no score is that high."""
    first = first_at(run, "way", level)
    return float("inf") if first is None else first["cpu_s"]


def median(values: Sequence[float]) -> float:
    """Return the upper median, which may be infinite."""
    return sorted(values)[len(values) // 2]


def seconds_text(seconds: float) -> str:
    """Return seconds as text; `none` if they are infinite."""
    return "none" if seconds == float("inf") else f"{seconds:.0f} s"


def table(curves: Rows, optima: Rows) -> str:
    """Return a line for each problem: ways at the end, and CPU seconds to LEVEL of H-PPO and of default PPO.

    If neither default form of PPO gets there, its seconds count as END. Then the ratio is a lower bound, rounded down.
    """
    lines = []
    for problem, part in [(row["problem"], row["part"]) for row in optima]:
        runs: dict[str, list[Rows]] = {player: [] for player in PLAYERS}
        for (player, _), run in groups([row for row in curves if row["problem"] == problem], "player", "seed").items():
            runs.setdefault(player, []).append(run)
        ways = {player: [way_at(run, END) for run in runs[player]] for player in PLAYERS}
        cells = [f"{spread(values, 2)} ({len(values)})" if values else "not run" for values in ways.values()]
        seconds = {name: median([seconds_to(run, LEVEL) for run in runs[name]]) for name in ("hppo", *DEFAULT_FORMS)}
        best = min(seconds[form] for form in DEFAULT_FORMS)
        ratio = f"{best / seconds['hppo']:.1f}"
        if best == float("inf"):
            ratio = f"more than {math.floor(10 * END / seconds['hppo']) / 10:.1f}"
        lines.append([problem, part, *cells, seconds_text(seconds["hppo"]), seconds_text(best), ratio])
    after = f"to {LEVEL:g}: hppo | PPO's better default form | ratio"
    return markdown_table(f"problem | part | {' | '.join(PLAYERS)} | {after}", lines)


def optima_table(optima: Rows) -> str:
    """Return a line for each problem with the returns of random play and of the best policy."""
    lines = [[row["problem"], row["part"], f"{row['random']:,.2f}", f"{row['best']:,.2f}"] for row in optima]
    return markdown_table("problem | part | return of random play | of the best policy", lines)


def draw(curves: Rows, path: Path) -> None:
    """Draw a panel for each problem, with a line for each seed."""
    problems = groups(curves, "problem")
    with rc_context(STYLE):
        figure = Figure(figsize=(9.2, 7.4), layout="constrained")
        panels = figure.subplots(3, -(-len(problems) // 3), sharex=True, sharey=True, squeeze=False).ravel()
        for axes, ((problem,), rows) in zip(panels, problems.items(), strict=False):
            for (library, player), of_player in groups(rows, "library", "player").items():
                colour = COLOURS.get(player) or LEARNER_COLOURS[player]
                for number, run in enumerate(groups(of_player, "seed").values()):
                    label = f"{library} {player}" if number == 0 else None
                    style = "-" if library == "hpamdp" else "--"
                    at_s, ways = [row["cpu_s"] for row in run], [row["way"] for row in run]
                    axes.plot(at_s, ways, color=colour, linestyle=style, linewidth=1.1, label=label)
            axes.set_title(problem)
            axes.set_xscale("log")
            axes.set_ylim(-0.1, 1.05)
            axes.xaxis.set_major_locator(FixedLocator([5, 10, 20, 30, 60, 120]))
            axes.xaxis.set_minor_locator(NullLocator())
            axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        for empty in panels[len(problems) :]:
            empty.set_axis_off()
        lines = {line.get_label(): line for axes in panels for line in axes.get_legend_handles_labels()[0]}
        panels[-1].legend(lines.values(), lines.keys(), frameon=False, fontsize=8, loc="lower right")
        figure.supxlabel("CPU seconds since the start of the program")
        figure.supylabel("way from random play to the best policy")
        figure.savefig(path)


def main(arguments: Sequence[str]) -> None:
    """Gather, draw, tabulate."""
    optima = read_csv(HERE / "optima.csv")
    if arguments:
        order = [row["problem"] for row in optima]
        write_tables(HERE, {"curves": gather(Path(arguments[0]), order)})
    curves = read_csv(HERE / "curves.csv")
    draw(curves, HERE / "curves.png")
    print(table(curves, optima), optima_table(optima), sep="\n\n")


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
