"""Draw and tabulate PEARL's code beside hpamdp's learners on Pinball and Office, by episodes and by CPU seconds.

python experiments/pearl/study.py FOLDER    adds the curves in the folder to curves.csv, in the place of earlier ones of
                                            the same problem, learner and seed, then draws and tabulates
python experiments/pearl/study.py           draws and tabulates the stored curves
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.study_tables import (
    Rows,
    first_at,
    groups,
    interval_text,
    markdown_table,
    mean_of,
    read_csv,
    refuse_repeats,
    with_repeats_replaced,
    write_tables,
)
from hpamdp.analysis.statistics import spread
from hpamdp.figure_style import INK, LEARNER_COLOURS, STYLE
from hpamdp.messages import exit_code

HERE = Path(__file__).resolve().parent
PROBLEMS = {"pinball": "Pinball, simple map", "office": "Office"}
AXES = {"episodes": "episodes of training", "cpu_s": "CPU seconds of training"}
REACHED = 0.95  # success of a greedy evaluation
LEARNER = ("problem", "library", "version", "learner")


def gather(folder: Path) -> Rows:
    """Return the rows of all curves in a folder.

    Raises:
        SystemExit: the folder has no curves, a file is none, or two files are of one run.
    """
    rows: Rows = []
    for file in sorted(folder.glob("*.csv")):
        rows += read_csv(file)
        if not rows or any(row.get("problem") not in PROBLEMS for row in rows):
            raise SystemExit(f"{file}: is no curve of this study; nothing was written")
    if not rows:
        raise SystemExit(f"{folder}: has no curves; nothing was written")
    refuse_repeats(rows, (*LEARNER, "seed", "steps"), (*LEARNER, "seed"))
    return rows


def merged(stored: Rows, new: Rows) -> Rows:
    """Return the stored rows and the new ones, in the order of problems, libraries and seeds."""
    order = list(PROBLEMS)
    rows = with_repeats_replaced(stored, new, (*LEARNER, "seed"))
    return sorted(rows, key=lambda row: (order.index(row["problem"]), row["library"], row["seed"]))


def table(curves: Rows) -> str:
    """Return a line for each learner: its last returns, and when its runs first succeeded."""
    lines = []
    for (problem, library, version, learner), rows in groups(curves, *LEARNER).items():
        runs = list(groups(rows, "seed").values())
        ends = [run[-1] for run in runs]
        firsts = [first for run in runs if (first := first_at(run, "success", REACHED))]
        scores = [end["score"] for end in ends]
        cells = [PROBLEMS[problem], f"{library} {version}", learner, len(runs)]
        cells += [f"{mean_of(ends, column):,.0f}" for column in ("episodes", "steps")]
        cells += [f"{mean_of(ends, 'cpu_s'):,.0f} s"]
        cells += [spread(scores, 0), interval_text(scores, ",.0f")]
        cells += [f"{100.0 * mean_of(ends, 'success'):.1f}%", f"{len(firsts)} of {len(runs)}"]
        cells += [_range(firsts, "episodes"), _range(firsts, "steps"), _range(firsts, "cpu_s", " s")]
        lines.append(cells)
    head = (
        "problem | library | learner | seeds | episodes | steps | CPU of a run | return | 95 % | success "
        "| seeds that reached 95 % | after episodes | after steps | after CPU"
    )
    return markdown_table(head, lines)


def _range(rows: Rows, name: str, unit: str = "") -> str:
    values = [row[name] for row in rows]
    # One number if there is one run.
    return " to ".join(dict.fromkeys(f"{value:,.0f}" for value in (min(values), max(values)))) + unit if values else ""


def draw(curves: Rows, path: Path) -> None:
    """Draw the returns of each problem, by episodes and by CPU seconds, with a line for each seed."""
    with rc_context(STYLE):
        figure = Figure(figsize=(10.6, 6.4), layout="constrained")
        panels = figure.subplots(len(PROBLEMS), len(AXES))
        for row, (problem, title) in zip(panels, PROBLEMS.items(), strict=True):
            for axes, (column, label) in zip(row, AXES.items(), strict=True):
                _draw_panel(axes, [each for each in curves if each["problem"] == problem], column)
                axes.set(title=title, xlabel=label, ylabel="return, greedy")
        figure.savefig(path)


def _draw_panel(axes: Axes, curves: Rows, column: str) -> None:
    for (library, learner), rows in groups(curves, "library", "learner").items():
        name, _, earlier = learner.partition(", ")
        colour = LEARNER_COLOURS.get(name, INK)
        style = "--" if library != "hpamdp" else ":" if earlier else "-"
        for number, run in enumerate(groups(rows, "seed").values()):
            label = f"{library}: {learner}" if number == 0 else None
            after = [row for row in run if row[column] > 0]  # the axis is logarithmic
            x, y = [row[column] for row in after], [row["score"] for row in after]
            axes.plot(x, y, color=colour, linestyle=style, linewidth=1.1, label=label)
    axes.set_xscale("log")
    if column == "cpu_s":  # one legend for both panels, beside them
        axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))


def main(arguments: Sequence[str]) -> None:
    """Gather, draw, tabulate."""
    if len(arguments) > 1:
        raise SystemExit(f"give one folder with all curves, not {len(arguments)}")
    if arguments:
        write_tables(HERE, {"curves": merged(read_csv(HERE / "curves.csv"), gather(Path(arguments[0])))})
    curves = read_csv(HERE / "curves.csv")
    draw(curves, HERE / "curves.png")
    print(table(curves))


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
