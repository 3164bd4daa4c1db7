"""Figures of a finished or stopped run, drawn from the files in its folder and nothing else."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.ticker import EngFormatter, MaxNLocator, PercentFormatter

from hpamdp.env.boatdock.harbour import CONGRUENT, INCONGRUENT, NOT_CHOSEN
from hpamdp.env.boatdock.physics import DOCK_RADIUS, HARBOUR_RADIUS, OUTCOMES, SUCCESS
from hpamdp.env.boatdock.reference import (
    CHOICE_FIGURES,
    HUMAN_CONGRUENT_BY_OFFSET,
    OFFSET_EDGES,
    has_choice,
    references,
)
from hpamdp.run.metrics import EVALUATION, FRAMES, WALL_SECONDS, duration, read_rows, warn

# Colours of Okabe and Ito and of Tol that the colour-blind tell apart, each with one meaning in all figures.
_AGENT, _INK, _FAINT = "#0072B2", "#2b2b2b", "#8c8c8c"
_REFERENCES = {
    "random": ("random", "#8c8c8c", ":"),
    "human": ("people", "#D98200", "--"),
    "best_person": ("best person", "#D98200", "-."),
    "ceiling": ("ceiling", "#2b2b2b", "-"),
}
_OUTCOME_COLOURS = {
    "success": "#009E73",
    "too_fast": "#D55E00",
    "out_of_bounds": "#AA4499",
    "out_of_fuel": "#332288",
    "time_limit": "#7FC8F2",
    "sailing": "#8c8c8c",
}
_WATER, _RIM, _DOCK, _DOCK_EDGE = "#eef4f6", "#9fb9c2", "#f4dfb0", "#c8963e"

_STYLE = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#666666",
    "axes.labelcolor": _INK,
    "xtick.color": "#666666",
    "ytick.color": "#666666",
    "text.color": _INK,
    "savefig.dpi": 160,
}

# Panels of the learning curves: the metric, its title, whether it is a share.
_PANELS = (
    ("score", "Score", False),
    ("success", "Episodes that succeed", True),
    ("oracle_agreement", "Better boat chosen", True),
    ("option_congruent", "Congruent boat chosen", True),
)

_SHEET = (4, 6)  # rows and columns of the sheet of trajectories


def draw_all(output_dir: Path) -> list[Path]:
    """Draw what the files in a run's folder allow and return the figures' paths.

    `metrics.csv` gives `learning_curves.png`; `evaluation.npz` gives `trajectories.png` and, where the agent chose its
    boat, `choices.png`; `summary.json` gives the references. A missing or broken file leaves its figures out.
    """
    summary = _read_summary(output_dir / "summary.json")
    rows = read_rows(output_dir / "metrics.csv")
    evaluation = _read_evaluation(output_dir / "evaluation.npz")
    if "option" in evaluation:
        evaluation.setdefault("controller", evaluation["option"])
    with mpl.rc_context(_STYLE):
        figures = {
            "learning_curves.png": _learning_curves(rows, summary),
            "trajectories.png": _trajectories(evaluation),
            "choices.png": _choices(evaluation, summary),
        }
        drawn = {output_dir / name: figure for name, figure in figures.items() if figure is not None}
        for path, figure in drawn.items():
            figure.savefig(path)
    return list(drawn)


def _read_summary(path: Path) -> dict[str, Any]:
    try:
        return json.loads(path.read_text()) if path.exists() else {}
    except ValueError as error:
        warn(f"{path} is no json, its references are left out: {error}")
        return {}


def _read_evaluation(path: Path) -> dict[str, np.ndarray]:
    if not path.exists():
        return {}
    try:
        with np.load(path) as arrays:
            return dict(arrays)
    except (ValueError, EOFError, zipfile.BadZipFile) as error:
        warn(f"{path} cannot be read, its figures are left out: {error}")
        return {}


def _label_ends(axes: Axes, labels: list[tuple[float, str, str]], ends: float = 1.0) -> None:
    """Write labels (height, text, colour) right of the axes, a line's height apart at least.

    A thin leader joins a label to its line's end, `ends` of the way across the axes.
    """
    low, high = axes.get_ylim()
    labels = sorted(labels)
    heights = [(height - low) / (high - low) for height, _, _ in labels]
    for height, place, (_, text, colour) in zip(heights, _apart(heights, 0.064), labels, strict=True):
        leader = {"color": colour, "linewidth": 0.7, "clip_on": False, "transform": axes.transAxes}
        axes.plot([ends, 1.03], [height, place], alpha=0.7, **leader)
        axes.annotate(text, (1.04, place), xycoords="axes fraction", color=colour, va="center", fontsize=8.5)


def _apart(heights: list[float], gap: float) -> list[float]:
    """Move sorted heights to be at least `gap` apart, every cluster about its own mean, none above 1."""
    clusters: list[list[float]] = []
    for height in heights:
        clusters.append([height])
        while len(clusters) > 1 and _foot(clusters[-1], gap) < _foot(clusters[-2], gap) + gap * len(clusters[-2]):
            last = clusters.pop()
            clusters[-1].extend(last)
    return [_foot(cluster, gap) + gap * i for cluster in clusters for i in range(len(cluster))]


def _foot(cluster: list[float], gap: float) -> float:
    reach = gap * (len(cluster) - 1)
    return min(sum(cluster) / len(cluster) - reach / 2.0, 1.02 - reach)


def _series(rows: list[dict[str, float]], name: str) -> tuple[np.ndarray, np.ndarray]:
    points = [(row[FRAMES], row[name]) for row in rows if FRAMES in row and name in row]
    points = np.array([point for point in points if np.isfinite(point).all()]).reshape(-1, 2)
    return points[:, 0], points[:, 1]


def _learning_curves(rows: list[dict[str, float]], summary: Mapping[str, Any]) -> Figure | None:
    logged = {name for row in rows for name in row}
    panels = [panel for panel in _PANELS if {EVALUATION + panel[0], "train/" + panel[0]} & logged]
    panels = [panel for panel in panels if has_choice(summary) or panel[0] not in CHOICE_FIGURES]
    if not panels:
        return None
    columns = min(len(panels), 2)
    num_rows = -(-len(panels) // columns)
    figure = Figure(figsize=(4.8 * columns, 3.2 * num_rows + 0.3), layout="constrained")
    all_axes = figure.subplots(num_rows, columns, squeeze=False).ravel()
    for axes in all_axes[len(panels) :]:
        axes.set_axis_off()
    for axes, panel in zip(all_axes, panels, strict=False):
        _draw_curve(axes, rows, panel, references(summary))
    seconds = _series(rows, WALL_SECONDS)[1].max(initial=0.0)
    figure.supxlabel(f"presses while training{f' ({duration(seconds)} in all)' if seconds else ''}", fontsize=9)
    return figure


def _draw_curve(
    axes: Axes, rows: list[dict[str, float]], panel: tuple[str, str, bool], beside: Mapping[str, Any]
) -> None:
    name, title, is_share = panel
    write = "{:.0%}".format if is_share else "{:.2f}".format
    labels = []
    for reference, (label, colour, dashes) in _REFERENCES.items():
        value = beside.get(reference, {}).get(name)
        if value is not None and np.isfinite(value):
            axes.axhline(value, color=colour, linestyle=dashes, linewidth=1.1, zorder=1)
            labels.append((value, f"{label} {write(value)}", colour))
    trained, evaluated = _series(rows, "train/" + name), _series(rows, EVALUATION + name)
    faint = {"alpha": 0.35, "linewidth": 1.0, "zorder": 2}
    bold = {"linewidth": 2.0, "marker": "o", "markersize": 3.5, "zorder": 3, "clip_on": False}
    for (frames, values), label, line in ((evaluated, "this agent", bold), (trained, "exploring", faint)):
        if len(values):
            axes.plot(frames, values, color=_AGENT, **line)
            labels.append((values[-1], f"{label} {write(values[-1])}", _AGENT))
    heights = [height for height, _, _ in labels] + [*trained[1], *evaluated[1]]
    if is_share:
        axes.set_ylim(-0.02, 1.03)
        axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    elif heights:
        margin = 0.05 * max(max(heights) - min(heights), 0.1)
        axes.set_ylim(min(heights) - margin, max(heights) + margin)
    axes.set_xlim(0.0, max([1.0, *trained[0], *evaluated[0]]))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.set_title(title)
    _label_ends(axes, labels)


def _trajectories(evaluation: Mapping[str, np.ndarray]) -> Figure | None:
    if not {"path", "goal", "outcome", "score"} <= evaluation.keys() or not len(evaluation["score"]):
        return None
    scores, outcomes = evaluation["score"], evaluation["outcome"].astype(int)
    # Best first; failures, which all score the same, by their outcome. Evenly spaced ranks show the typical ones too.
    ranking = np.lexsort((outcomes, -scores))
    num = min(len(ranking), _SHEET[0] * _SHEET[1])
    chosen = ranking[np.linspace(0, len(ranking) - 1, num).round().astype(int)]
    columns = min(_SHEET[1], num)
    num_rows = -(-num // columns)
    figure = Figure(figsize=(max(1.75 * columns, 5.5), 1.92 * num_rows + 0.75), layout="constrained")
    all_axes = figure.subplots(num_rows, columns, squeeze=False).ravel()
    for axes in all_axes:
        axes.set_axis_off()
    for axes, episode in zip(all_axes, chosen, strict=False):
        _draw_episode(axes, evaluation, int(episode))
    present = [(name, (outcomes == code).mean()) for code, name in enumerate(OUTCOMES) if (outcomes == code).any()]
    handles = [
        Line2D([], [], color=_OUTCOME_COLOURS[name], marker=_end_marker(name), label=f"{_words(name)} {share:.1%}")
        for name, share in present
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), frameon=False, fontsize=9)
    figure.supxlabel(
        f"{num} of {len(scores)} episodes, evenly spaced by score. Open circle: start; a dot where each press ends.\n"
        "Above: score / best possible score, boat (C congruent, I incongruent).",
        fontsize=8.5,
        color=_FAINT,
    )
    return figure


def _words(name: str) -> str:
    return name.replace("_", " ")


def _end_marker(outcome: str) -> str:
    return "o" if outcome == OUTCOMES[SUCCESS] else "X"


def _draw_episode(axes: Axes, evaluation: Mapping[str, np.ndarray], episode: int) -> None:
    outcome = OUTCOMES[int(evaluation["outcome"][episode])]
    colour = _OUTCOME_COLOURS[outcome]
    path = evaluation["path"][episode]
    path = path[np.isfinite(path).all(axis=-1)]
    axes.add_patch(Circle((0, 0), HARBOUR_RADIUS, facecolor=_WATER, edgecolor=_RIM, linewidth=0.8))
    axes.add_patch(
        Circle(evaluation["goal"][episode], DOCK_RADIUS, facecolor=_DOCK, edgecolor=_DOCK_EDGE, linewidth=0.8)
    )
    if len(path):
        axes.plot(*path.T, color=colour, linewidth=1.5, marker="o", markersize=2.6, zorder=3)
        axes.plot(*path[0], "o", markersize=5, markerfacecolor="white", markeredgecolor=_INK, zorder=4)
        axes.plot(*path[-1], _end_marker(outcome), color=colour, markersize=6, markeredgecolor="white", zorder=5)
    axes.set_xlim(-HARBOUR_RADIUS - 3, HARBOUR_RADIUS + 3)
    axes.set_ylim(HARBOUR_RADIUS + 3, -HARBOUR_RADIUS - 3)  # y points down
    axes.set_aspect("equal")
    axes.set_title(_episode_title(evaluation, episode), fontsize=8.5, fontweight="normal", loc="center", pad=2)


def _episode_title(evaluation: Mapping[str, np.ndarray], episode: int) -> str:
    title = f"{evaluation['score'][episode]:.2f}"
    boat = int(evaluation["controller"][episode]) if "controller" in evaluation else NOT_CHOSEN
    if "optimum" in evaluation:
        best = evaluation["optimum"][episode]
        is_chosen = "option" in evaluation and evaluation["option"][episode] != NOT_CHOSEN
        # The best of both boats is the ceiling of those who choose only.
        best = best if is_chosen or boat == NOT_CHOSEN else best[boat : boat + 1]
        if np.isfinite(best).any():
            title += f" / {np.nanmax(best):.2f}"
    letter = {CONGRUENT: "C", INCONGRUENT: "I"}.get(boat)
    return f"{title}  {letter}" if letter else title


def _choices(evaluation: Mapping[str, np.ndarray], summary: Mapping[str, Any]) -> Figure | None:
    if not {"option", "bearing_offset", "outcome"} <= evaluation.keys():
        return None
    chose = (evaluation["option"] != NOT_CHOSEN) & np.isfinite(evaluation["bearing_offset"])
    if not chose.any():
        return None
    people = references(summary).get("human", {})
    figure = Figure(figsize=(9.6, 3.7), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1.5, 1.0])
    _draw_choices(left, {name: array[chose] for name, array in evaluation.items()}, has_people=bool(people))
    _draw_outcomes(right, evaluation["outcome"].astype(int), people)
    return figure


def _draw_choices(axes: Axes, evaluation: Mapping[str, np.ndarray], has_people: bool) -> None:
    edges = np.array(OFFSET_EDGES, dtype=float)
    centres = (edges[:-1] + edges[1:]) / 2.0
    bins = np.clip(np.digitize(evaluation["bearing_offset"], edges) - 1, 0, len(centres) - 1)
    num = np.bincount(bins, minlength=len(centres))
    filled = num > 0

    def shares(is_congruent: np.ndarray) -> np.ndarray:
        return np.bincount(bins, weights=is_congruent, minlength=len(centres))[filled] / num[filled]

    labels = []
    optimum = evaluation.get("optimum", np.full((len(bins), 2), np.nan))
    congruent = evaluation["option"] == CONGRUENT
    title = "Congruent boat chosen"
    if np.isfinite(optimum).all():
        better = optimum[:, CONGRUENT] > optimum[:, INCONGRUENT]
        oracle = shares(better)
        axes.plot(centres[filled], oracle, color=_INK, linewidth=1.1, marker="s", markersize=4)
        labels.append((oracle[-1], "oracle", _INK))
        title += f" (better boat in {(better == congruent).mean():.0%})"
    if has_people:
        label, colour, dashes = _REFERENCES["human"]
        axes.plot(centres, HUMAN_CONGRUENT_BY_OFFSET, color=colour, linestyle=dashes, marker="D", markersize=4)
        labels.append((HUMAN_CONGRUENT_BY_OFFSET[-1], label, colour))
    share = shares(congruent)
    errors = _wilson(share, num[filled])
    axes.errorbar(centres[filled], share, errors, color=_AGENT, linewidth=2.0, marker="o", markersize=5, capsize=3)
    labels.append((share[-1], "this agent", _AGENT))
    axes.set(
        xlim=(0, 60),
        ylim=(-0.03, 1.03),
        xticks=edges,
    )
    axes.set_xlabel("degrees between the goal's bearing and the congruent boat's nearest key")
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set_title(title)
    _label_ends(axes, labels, ends=centres[filled][-1] / edges[-1])


def _wilson(share: np.ndarray, num: np.ndarray) -> np.ndarray:
    """Return how far the 95 % interval of a binomial share reaches below and above it, `[2, bins]` (Wilson, 1927)."""
    z = 1.96
    middle = (share + z**2 / (2.0 * num)) / (1.0 + z**2 / num)
    half = z * np.sqrt(share * (1.0 - share) / num + z**2 / (4.0 * num**2)) / (1.0 + z**2 / num)
    return np.maximum([share - middle + half, middle + half - share], 0.0)


def _draw_outcomes(axes: Axes, outcomes: np.ndarray, people: Mapping[str, float]) -> None:
    names = [name for code, name in enumerate(OUTCOMES) if (outcomes == code).any() or people.get(name)]
    colour = _REFERENCES["human"][1]
    for row, name in enumerate(names):
        share = (outcomes == OUTCOMES.index(name)).mean()
        axes.barh(row, share, color=_OUTCOME_COLOURS[name], height=0.62)
        axes.annotate(f"{share:.1%}", (1.16, row), ha="right", va="center", fontsize=8.5, annotation_clip=False)
        if people.get(name) is not None:
            for edge, width in (("white", 4.5), (colour, 2.0)):  # the white edge keeps it apart from the bar
                axes.plot([people[name]] * 2, [row - 0.38, row + 0.38], color=edge, linewidth=width)
    if people.get("success") is not None:
        axes.annotate("people", (people["success"], -0.45), color=colour, ha="center", va="bottom", fontsize=8.5)
    axes.set(xlim=(0, 1), ylim=(len(names) - 0.4, -0.85))
    axes.set_yticks(range(len(names)), [_words(name) for name in names])
    axes.xaxis.set_major_formatter(PercentFormatter(1.0))
    axes.tick_params(axis="y", length=0)
    axes.set_title("How episodes end")
