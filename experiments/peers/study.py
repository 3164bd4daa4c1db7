"""Draw and tabulate the learners of other libraries beside those of hpamdp, against CPU seconds of training.

python experiments/peers/study.py FOLDER    gathers the curves in the folder into curves.csv, and those of its folder
                                            `speed` into speed.csv, then draws and tabulates
python experiments/peers/study.py           draws and tabulates the stored csv files
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from experiments.study_tables import Rows, groups, markdown_table, mean_of, read_csv, refuse_repeats, write_tables
from hpamdp.analysis.statistics import spread
from hpamdp.figure_style import FAINT, INK, LEARNER_COLOURS, STYLE
from hpamdp.messages import exit_code

HERE = Path(__file__).resolve().parent
TIMES = (0.1, 0.25, 0.5, 1.0)  # columns of the table, as fractions of the CPU time of training
FIRST = 5.0  # start of the figure's axes, CPU seconds
# DI-engine's H-PPO is scored in three ways; the figure shows the one of hpamdp's H-PPO on Moving.
SHOWN = ("greedy", "sampled")
PROBLEMS = {"platform": "Platform", "moving": "Moving"}
COLOURS = {("xuance", "mpdqn"): INK, ("xuance", "pdqn"): FAINT, ("di-engine", "hppo"): INK}
NAME = ("problem", "library", "version", "learner", "acts")


def gather(folder: Path) -> dict[str, Rows]:
    """Return the rows of `curves` and of `speed`, in the order of problems, libraries and seeds.

    Raises:
        SystemExit: a file is not of this study or ends after another CPU time, or two are of one run.
    """

    def rows_of(files: Sequence[Path]) -> Rows:
        rows: Rows = []
        for file in files:
            of_file = read_csv(file)
            if not of_file or any(row.get("problem") not in PROBLEMS for row in of_file):
                raise SystemExit(f"{file}: is no file of this study; nothing was written")
            rows += of_file
            if of_file[0]["limit_s"] != rows[0]["limit_s"]:
                raise SystemExit(
                    f"{file}: has limit_s={of_file[0]['limit_s']}, and files before it {rows[0]['limit_s']}; "
                    "nothing was written"
                )
        refuse_repeats(rows, (*NAME, "seed", "cpu_s"), (*NAME, "seed"))
        order = list(PROBLEMS)
        return sorted(rows, key=lambda row: (order.index(row["problem"]), row["library"], row["learner"], row["seed"]))

    return {
        "curves": rows_of(sorted(folder.glob("*.csv"))),
        "speed": rows_of(sorted((folder / "speed").glob("*.csv"))),
    }


def limit_of(curves: Rows) -> float:
    """Return the CPU seconds of training after which all runs end."""
    return float(curves[0]["limit_s"])


def at(run: Rows, cpu_s: float) -> dict[str, float]:
    """Return a run's last evaluation within the CPU time. A run that has ended keeps its last evaluation.

    The evaluation at the limit comes a batch later, and counts as within it.
    """
    return [row for row in run if row["cpu_s"] <= cpu_s or (cpu_s == row["limit_s"] and row is run[-1])][-1]


def scores_table(curves: Rows) -> str:
    """Return a line for each learner with its scores after some CPU time, over seeds."""
    times = [part * limit_of(curves) for part in TIMES]
    lines = []
    for (problem, library, version, learner, acts), rows in groups(curves, *NAME).items():
        runs = list(groups(rows, "seed").values())
        ends = [run[-1] for run in runs]
        cells = [PROBLEMS[problem], f"{library} {version}", learner, acts, len(runs)]
        cells += [spread([at(run, cpu_s)["score"] for run in runs]) for cpu_s in times]
        cells += [spread([end["success"] for end in ends]), f"{mean_of(ends, 'cpu_s'):.0f} s"]
        lines.append([*cells, f"{mean_of(ends, 'steps'):,.0f}"])
    after = " | ".join(f"{cpu_s:g} s CPU" for cpu_s in times)
    head = f"problem | library | learner | acts | seeds | {after} | success at the end | CPU of a run | steps"
    return markdown_table(head, lines)


def steps_a_second(run: Rows) -> float:
    """Return the steps in a CPU second, from the first evaluation after the start to the last.

    The steps before it are left out, because some learners make no updates in their first steps.
    """
    first, last = run[1], run[-1]
    return (last["steps"] - first["steps"]) / (last["cpu_s"] - first["cpu_s"])


def speed_table(speed: Rows) -> str:
    """Return a line for each learner with the steps in a CPU second."""
    lines = []
    for (_, library, version, learner, _), rows in groups([r for r in speed if r["acts"] in SHOWN], *NAME).items():
        speeds = [steps_a_second(run) for run in groups(rows, "seed").values()]
        each = ", ".join(f"{value:,.0f}" for value in speeds)
        lines.append([f"{library} {version}", learner, each, f"{sum(speeds) / len(speeds):,.0f}"])
    return markdown_table("library | learner | steps in a CPU second, each repeat | mean", lines)


def draw(curves: Rows, path: Path) -> None:
    """Draw a panel for each problem, with a line for each seed. A dot is the end of a run before its time was over."""
    with rc_context(STYLE):
        figure = Figure(figsize=(9.2, 3.6), layout="constrained")
        for axes, (problem, title) in zip(figure.subplots(1, len(PROBLEMS)), PROBLEMS.items(), strict=True):
            _draw_problem(axes, [row for row in curves if row["problem"] == problem and row["acts"] in SHOWN])
            axes.set_title(title)
        figure.savefig(path)


def _draw_problem(axes: Axes, curves: Rows) -> None:
    for (library, learner), rows in groups(curves, "library", "learner").items():
        colour = COLOURS.get((library, learner)) or LEARNER_COLOURS[learner.split()[0]]
        style = "-" if library == "hpamdp" else "--"
        for number, run in enumerate(groups(rows, "seed").values()):
            at_s, scores = [row["cpu_s"] for row in run], [row["score"] for row in run]
            label = f"{library}: {learner}" if number == 0 else None
            axes.plot(at_s, scores, color=colour, linestyle=style, linewidth=1.1, label=label)
            if at_s[-1] < run[-1]["limit_s"]:
                axes.plot(at_s[-1:], scores[-1:], color=colour, marker="o", markersize=3.5)
    axes.set_xscale("log")
    axes.set_xlim(FIRST, limit_of(curves) * 1.05)
    axes.xaxis.set_major_locator(FixedLocator([5, 10, 30, 60, 120, 300, 600]))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_xlabel("CPU seconds of training")
    axes.set_ylabel("mean return of 1,000 episodes")
    axes.legend(frameon=False, fontsize=8, loc="best")


def main(arguments: Sequence[str]) -> None:
    """Gather, draw, tabulate."""
    if arguments:
        write_tables(HERE, gather(Path(arguments[0])))
    curves = read_csv(HERE / "curves.csv")
    draw(curves, HERE / "curves.png")
    print(scores_table(curves), speed_table(read_csv(HERE / "speed.csv")), sep="\n\n")


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
