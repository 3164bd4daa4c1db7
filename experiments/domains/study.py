"""Tabulate the learners on the field's domains beside the published scores, and draw their curves.

python experiments/domains/study.py FOLDER...    adds the finished runs in these folders to results.csv and curves.csv,
                                                 in the place of earlier ones of the same learner, domain, steps and
                                                 seed; then draws and tabulates. A cell of cells.csv shows the seeds of
                                                 the protocol once all of them have run.
python experiments/domains/study.py              draws and tabulates the stored csv files
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, NullFormatter

from experiments.study_tables import (
    FIRST_PROTOCOL_SEED,
    Rows,
    Run,
    curve,
    difference,
    gathered,
    groups,
    interquartile_mean,
    interval_text,
    markdown_table,
    mean_of,
    read_csv,
    refuse_repeats,
    standing_rows,
    with_enough_seeds,
    with_repeats_replaced,
    write_tables,
)
from hpamdp.analysis.statistics import spread
from hpamdp.figure_style import LEARNER_COLOURS
from hpamdp.messages import exit_code

HERE = Path(__file__).resolve().parent
# The domains, with the largest published number of steps and the score: the mean return or the success rate.
# No scores were published on Moving and Sliding, for which DI-engine's settings allow ten million steps.
DOMAINS = {
    "platform": (200_000, "score"),
    "goal": (300_000, "success"),
    "hard_goal": (300_000, "success"),
    "catch_point": (1_000_000, "success"),
    "hard_move_4": (1_000_000, "success"),
    "hard_move_6": (1_000_000, "success"),
    "hard_move_8": (1_000_000, "success"),
    "hard_move_10": (1_000_000, "success"),
    "moving": (10_000_000, "score"),
    "sliding": (10_000_000, "score"),
}
# Hard Move is one environment with four numbers of actuators.
ENVIRONMENTS = [*dict.fromkeys("hard_move" if name.startswith("hard_move") else name for name in DOMAINS)]
# Random steps before HyAR learns, which its published number of steps leaves out.
UNCOUNTED_STEPS = {("platform", "hyar_published"): 11_000}
BATCH_TOLERANCE = 0.03  # a run ends with a whole batch, so its steps exceed the published ones by a little
FIRST_STEPS = 700  # start of the curves' axes, before any evaluation
PLANNERS = ("dlpa", "pets")
AUGMENTED = "_augment"  # follows a learner's name if it learns from steps mapped by the problem's symmetries
KEY = ("domain", "learner", "frames", "seed")
EARLIER = "†"  # marks the number of seeds before those of the protocol


def gather(runs: Sequence[Run]) -> tuple[Rows, Rows]:
    """Return a row for each run and a row for each of its evaluations."""
    results: Rows = []
    curves: Rows = []
    for run in runs:
        summary = run.summary
        name = {"domain": domain(run), "learner": learner(run), "frames": summary["frames"], "seed": summary["seed"]}
        results.append(
            name
            | {"score": round(summary["score"], 4), "success": round(summary["success"], 4)}
            | {"cpu_s": round(summary["cpu_s"], 1), "wall_s": round(summary["wall_s"], 1)}
            | given(run)
        )
        for row in run.evaluations():
            at = {"at_frames": row["frames"], "at_wall_s": round(row["wall_s"], 1)}
            curves.append(name | at | {what: round(row[f"eval/{what}"], 4) for what in ("score", "success")})
    return results, curves


def given(run: Run) -> dict[str, Any]:
    """Return what the learner was given beside the problem, as text or number by name."""
    low, name = run.config["low"], str(run.summary["low"])
    symmetry = ["mapped steps"] if low.get("augment", False) is True else []
    symmetry += ["canonical frame"] if name == "pets" else []
    symmetry += ["vector products"] if low.get("vector_products", False) else []
    variations = low.get("greedy_samples") or 0
    search = "planning" if name in PLANNERS else f"{variations} variations" if variations else "none"
    return {
        "initial_parameters": low.get("initial_parameters", "none"),
        "symmetry": ", ".join(symmetry) or "none",
        "gamma": low["gamma"],
        "search": search,
        "reward_scale": low.get("reward_scale", 1.0),
    }


def domain(run: Run) -> str:
    """Return the domain's name; Hard Move's has its number of actuators."""
    name = str(run.summary["env"])
    return f"{name}_{run.config['env']['n']}" if name == "hard_move" else name


def learner(run: Run) -> str:
    """Return the learner's name, or the name of its form of P-DQN, PADDPG or HyAR.

    `AUGMENTED` may follow.
    """
    name = str(run.summary["low"])
    low = run.config["low"]
    if name == "paddpg" and low["twin"]:
        name = "patd3"
    elif name == "pdqn_published" and low["multipass"]:
        name = "mpdqn_published"
    elif name in ("hyar", "hyar_published") and not low["twin"]:
        name = name.replace("hyar", "hyar_ddpg")
    return f"{name}{AUGMENTED}" if low.get("augment", False) is True else name


def merged(stored: Rows, new: Rows) -> Rows:
    """Return the stored rows, with rows of repeated runs replaced by the new rows, in order of `DOMAINS`.

    `add_to_tables` would sort domains by their letters, and tables would follow. Earlier rows lack columns of new ones.
    """
    merged_rows = with_repeats_replaced(stored, new, KEY)
    columns = dict.fromkeys(name for row in [*new, *merged_rows] for name in row)
    rows = [{name: row.get(name, "") for name in columns} for row in merged_rows]
    order = {name: number for number, name in enumerate(DOMAINS)}
    return sorted(
        rows, key=lambda row: (order[row["domain"]], row["learner"], float(row["frames"]), float(row["seed"]))
    )


def at_published_steps(results: Rows) -> Rows:
    """Return each learner's longest runs on each domain that do not exceed the published number of steps."""
    chosen: Rows = []
    for (name, low), cell in groups(results, "domain", "learner").items():
        most = DOMAINS[name][0] * (1.0 + BATCH_TOLERANCE) + UNCOUNTED_STEPS.get((name, low), 0)
        allowed = [rows for (steps,), rows in groups(cell, "frames").items() if steps <= most]
        chosen += max(allowed, key=lambda rows: rows[0]["frames"], default=[])
    return chosen


def table(results: Rows, published: Rows, references: Rows) -> str:
    """Return a line for each learner with its scores over seeds, in a column for each domain.

    Lines with the published scores, the players without learning and the ceilings follow.
    """
    names = [f"{name}{form}" for form in ("", AUGMENTED) for name in LEARNER_COLOURS]
    learners = [name for name in names if any(row["learner"] == name for row in results)]
    lines = []
    cells = groups(results, "domain", "learner")
    for name in learners:
        lines.append([f"**{name}**", *(_cell(cells.get((column, name), [])) for column in DOMAINS)])
    for (method, source), rows in groups(published, "method", "source").items():
        lines.append(_line(f"{method} ({source})", rows))
    lines += [_line(str(player), rows) for (player,), rows in groups(references, "player").items()]
    return markdown_table(f"| {' | '.join(DOMAINS)}", lines)


def _line(name: str, rows: Rows) -> list[str]:
    """Return a line of the table with the score of each domain, if it has one."""
    scores = {row["domain"]: f"{row['score']:g}" for row in rows}
    return [name, *(scores.get(domain, "") for domain in DOMAINS)]


def _values(rows: Rows) -> list[float]:
    return [row[DOMAINS[row["domain"]][1]] for row in rows]


def _cell(rows: Rows) -> str:
    """Return mean ± deviation and the number of seeds."""
    return f"{spread(_values(rows))} ({_num_seeds(rows)})" if rows else ""


def _num_seeds(rows: Rows) -> str:
    return f"{len(rows)}{EARLIER if rows[0]['seed'] < FIRST_PROTOCOL_SEED else ''}"


def best_table(results: Rows, published: Rows) -> str:
    """Return a line for each domain: our learner with the highest mean, the next ones, and the best published score.

    The highest mean is chosen on the scored episodes, so a column has the number of learners that it is chosen from.
    """
    lines = []
    for name, (_, what) in DOMAINS.items():
        cells = groups([row for row in results if row["domain"] == name], "learner")
        values = {low: _values(rows) for (low,), rows in cells.items()}
        if not values:
            continue
        best, *others = sorted(values, key=lambda low: -float(np.mean(values[low])))
        second = f"{others[0]} ({_num_seeds(cells[(others[0],)])})" if others else ""
        improvement = f"{difference(values[best], values[others[0]]).improvement:.2f}" if others else ""
        top = best_published(published, name)
        unit = "return" if what == "score" else "success"
        columns = [
            name,
            best,
            len(values),
            f"{_cell(cells[(best,)])}, IQM {interquartile_mean(values[best])[0]:.3f} {unit}",
            interval_text(values[best]),
            second,
            improvement,
            _not_clearly_lower(values, best, others),
            f"{top['score']:g} ({top['method']})" if top else "",
            f"{mean_of(cells[(best,)], 'cpu_s'):.0f} s",
        ]
        lines.append(columns)
    head = (
        "domain | highest mean | of learners | score | 95 % interval | next (seeds) | probability of improvement "
        "| not clearly lower | best published | CPU of a run"
    )
    return markdown_table(head, lines)


def _not_clearly_lower(values: dict[str, list[float]], best: str, others: Sequence[str]) -> str:
    """Return the learners whose difference to the best one has an interval with 0."""
    return ", ".join(low for low in others if not difference(values[best], values[low]).is_clear)


def given_table(results: Rows) -> str:
    """Return a line for each learner and what it was given, with the domains where it was given that."""
    lines = []
    known = [row for row in results if row.get("search")]
    columns = ("initial_parameters", "symmetry", "gamma", "search", "reward_scale")
    for (name, *values), rows in groups(known, "learner", *columns).items():
        where = ", ".join(dict.fromkeys(row["domain"] for row in rows))
        shown = [value if isinstance(value, str) else f"{value:g}" for value in values]
        lines.append([name, where, *shown])
    head = "learner | domains | initial parameters | symmetry | discount | search when scored | reward scale"
    return markdown_table(head, lines)


def best_published(published: Rows, name: str) -> dict[str, Any] | None:
    """Return the row of the best published score on a domain, None if there is none."""
    return max((row for row in published if row["domain"] == name), key=lambda row: row["score"], default=None)


def draw(curves: Rows, published: Rows, path: Path) -> None:
    """Draw a panel for each domain: the mean over seeds and one standard deviation, and the best published score."""
    shown = [name for name in DOMAINS if any(row["domain"] == name for row in curves)]
    columns = min(len(shown), 3)
    num_rows = -(-len(shown) // columns)
    figure = Figure(figsize=(4.6 * columns, 3.4 * num_rows), layout="constrained")
    panels: Iterable[Axes] = figure.subplots(num_rows, columns, squeeze=False).flat
    for axes, name in zip(panels, shown, strict=False):
        _draw_domain(axes, name, at_published_steps([row for row in curves if row["domain"] == name]), published)
    for axes in list(figure.axes)[len(shown) :]:
        axes.set_axis_off()
    lines = {line.get_label(): line for axes in figure.axes for line in axes.get_lines()}
    figure.legend(handles=list(lines.values()), loc="outside lower center", ncols=6, fontsize=10, frameon=False)
    figure.savefig(path, dpi=130)


def _draw_domain(axes: Axes, name: str, curves: Rows, published: Rows) -> None:
    what = DOMAINS[name][1]
    for (low,), rows in groups([row for row in curves if row["at_frames"] > 0], "learner").items():
        longest = max(row["frames"] for row in rows)
        at, mean, deviation = curve([row for row in rows if row["frames"] == longest], "at_frames", what)
        colour, line = LEARNER_COLOURS[low.removesuffix(AUGMENTED)], ":" if low.endswith(AUGMENTED) else "-"
        axes.plot(at, mean, color=colour, linestyle=line, linewidth=1.6, marker=".", markersize=4, label=low)
        axes.fill_between(at, mean - deviation, mean + deviation, color=colour, alpha=0.18, lw=0)
    best = best_published(published, name)
    if best is not None:
        axes.axhline(best["score"], color="#2b2b2b", linestyle="--", linewidth=1.0, label="best published")
    axes.set_title(name, loc="left", fontweight="bold", fontsize=10)
    # Learners differ by a factor of a thousand in the steps that they take.
    axes.set_xscale("log")
    axes.set_xlim(left=FIRST_STEPS)
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("steps")
    if what == "score":
        axes.set_ylabel("mean return, greedy")
    else:
        axes.set_ylabel("fraction of successes, greedy")
        axes.set_ylim(-0.02, 1.02)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.spines[["top", "right"]].set_visible(False)


def main(folders: Sequence[str]) -> None:
    """Gather, draw, tabulate."""
    if folders:
        # P-DQN and H-PPO as published end values at the limit of Goal, as their sources do.
        settings = {"hard_move.n": None, "goal.limit": ("terminated",)}
        results, curves = gathered(folders, gather, settings=settings, env=ENVIRONMENTS)
        refuse_repeats(results, KEY, KEY)
        tables = {"results": results, "curves": curves}
        stored = {name: read_csv(HERE / f"{name}.csv") if (HERE / f"{name}.csv").exists() else [] for name in tables}
        write_tables(HERE, {name: merged(stored[name], rows) for name, rows in tables.items()})
    stored = (standing_rows(HERE / f"{name}.csv") for name in ("results", "curves"))
    results, curves = (with_enough_seeds(rows, "domain", "learner", "frames") for rows in stored)
    published = read_csv(HERE / "published.csv")
    references = read_csv(HERE / "references.csv")
    draw(curves, published, HERE / "curves.png")
    print(
        best_table(at_published_steps(results), published),
        table(at_published_steps(results), published, references),
        given_table(at_published_steps(results)),
        sep="\n\n",
    )


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
