"""Figures of an evaluation on boats: the trajectories, and the choice of the controller."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.ticker import PercentFormatter
from scipy.stats import binomtest

from hpamdp.env.boatdock.harbour import CONGRUENT, INCONGRUENT, NOT_CHOSEN
from hpamdp.env.boatdock.physics import DOCK_RADIUS, HARBOUR_RADIUS, OUTCOMES, SUCCESS
from hpamdp.env.boatdock.reference import HUMAN_CONGRUENT_BY_OFFSET, OFFSET_EDGES
from hpamdp.env.boatdock.task import Outcome
from hpamdp.figure_style import AGENT, FAINT, INK, REFERENCES, label_ends, with_minus

_WATER, _RIM, _DOCK, _DOCK_EDGE = "#eef4f6", "#9fb9c2", "#f4dfb0", "#c8963e"

_SHEET = (4, 6)  # rows and columns of the sheet of trajectories


def draw(evaluation: Mapping[str, np.ndarray], summary: Mapping[str, Any]) -> dict[str, Figure]:
    """Return `trajectories.png` and, if the agent chose its controller, `choices.png`.

    Args:
        evaluation: arrays from `BoatDockEnv.describe` and an evaluation. A figure is left out if one of its arrays is
            missing.
        summary: summary of the run. `references` has people's figures, `boats` the names of controllers other than
            theirs.
    """
    evaluation = dict(evaluation)
    if "option" in evaluation:
        evaluation.setdefault("controller", evaluation["option"])
    names = tuple(summary.get("boats", ()))
    figures = {"trajectories.png": _trajectories(evaluation, names), "choices.png": _choices(evaluation, summary)}
    return {name: figure for name, figure in figures.items() if figure is not None}


def _trajectories(evaluation: Mapping[str, np.ndarray], names: tuple[str, ...]) -> Figure | None:
    if not {"path", "goal", "outcome", "score"} <= evaluation.keys() or not len(evaluation["score"]):
        return None
    scores, outcomes = evaluation["score"], evaluation["outcome"].astype(int)
    # Rank the best first. Failures all score the same, so rank them by outcome. Evenly spaced ranks also show typical
    # episodes.
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
        _draw_episode(axes, evaluation, int(episode), names)
    present = [(name, (outcomes == code).mean()) for code, name in enumerate(OUTCOMES) if (outcomes == code).any()]
    handles = [
        Line2D([], [], color=_colour(name), marker=_end_marker(name), label=f"{_words(name)} {fraction:.1%}")
        for name, fraction in present
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), frameon=False, fontsize=9)
    figure.supxlabel(
        f"{num} of {len(scores)} episodes, evenly spaced by score. Open circle: start; a dot where each press ends.\n"
        f"Above: score / best possible score, boat{'' if names else ' (C congruent, I incongruent)'}.",
        fontsize=8.5,
        color=FAINT,
    )
    return figure


def _colour(outcome: str) -> str:
    return Outcome[outcome.upper()].colour


def _words(name: str) -> str:
    return name.replace("_", " ")


def _end_marker(outcome: str) -> str:
    return "o" if outcome == OUTCOMES[SUCCESS] else "X"


def _draw_episode(axes: Axes, evaluation: Mapping[str, np.ndarray], episode: int, names: tuple[str, ...]) -> None:
    outcome = OUTCOMES[int(evaluation["outcome"][episode])]
    colour = _colour(outcome)
    path = evaluation["path"][episode]
    path = path[np.isfinite(path).all(axis=-1)]
    axes.add_patch(Circle((0, 0), HARBOUR_RADIUS, facecolor=_WATER, edgecolor=_RIM, linewidth=0.8))
    axes.add_patch(
        Circle(evaluation["goal"][episode], DOCK_RADIUS, facecolor=_DOCK, edgecolor=_DOCK_EDGE, linewidth=0.8)
    )
    if len(path):
        axes.plot(*path.T, color=colour, linewidth=1.5, marker="o", markersize=2.6, zorder=3)
        axes.plot(*path[0], "o", markersize=5, markerfacecolor="white", markeredgecolor=INK, zorder=4)
        axes.plot(*path[-1], _end_marker(outcome), color=colour, markersize=6, markeredgecolor="white", zorder=5)
    axes.set_xlim(-HARBOUR_RADIUS - 3, HARBOUR_RADIUS + 3)
    axes.set_ylim(HARBOUR_RADIUS + 3, -HARBOUR_RADIUS - 3)  # y points down
    axes.set_aspect("equal")
    title = with_minus(episode_title(evaluation, episode, names))
    axes.set_title(title, fontsize=8.5, fontweight="normal", loc="center", pad=2)


def episode_title(evaluation: Mapping[str, np.ndarray], episode: int, names: tuple[str, ...] = ()) -> str:
    """Return a title: the score, the highest possible score if it is known, and the initial of the controller."""
    title = f"{evaluation['score'][episode]:.2f}"
    boat = int(evaluation["controller"][episode]) if "controller" in evaluation else NOT_CHOSEN
    if "optimum" in evaluation:
        best = evaluation["optimum"][episode]
        is_chosen = "option" in evaluation and evaluation["option"][episode] != NOT_CHOSEN
        # If the agent does not choose, its ceiling is the best score with its own controller.
        best = best if is_chosen or boat == NOT_CHOSEN else best[boat : boat + 1]
        if np.isfinite(best).any():
            title += f" / {np.nanmax(best):.2f}"
    letter = dict(enumerate(names)).get(boat) if names else {CONGRUENT: "C", INCONGRUENT: "I"}.get(boat)
    return f"{title}  {letter}" if letter else title


def _choices(evaluation: Mapping[str, np.ndarray], summary: Mapping[str, Any]) -> Figure | None:
    needed = {"option", "bearing_offset", "outcome"}
    if summary.get("boats"):
        needed |= {"optimum", "start", "goal"}
    if not needed <= evaluation.keys():
        return None
    chose = (evaluation["option"] != NOT_CHOSEN) & np.isfinite(evaluation["bearing_offset"])
    if not chose.any():
        return None
    people = summary.get("references", {}).get("human", {})
    figure = Figure(figsize=(9.6, 3.7), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1.5, 1.0])
    of_choices = {name: array[chose] for name, array in evaluation.items()}
    if summary.get("boats"):
        _draw_boats(left, of_choices, summary["boats"])
    else:
        _draw_choices(left, of_choices, summary.get("practised", {}), has_people=bool(people))
    _draw_outcomes(right, evaluation["outcome"].astype(int), people)
    return figure


def _in_bins(values: np.ndarray, edges: np.ndarray, *weights: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the centres of the bins with episodes, how many they have, and the sums of the weights `[N]` in them."""
    values = np.clip(values, edges[0], edges[-1])
    num = np.histogram(values, edges)[0]
    sums = [np.histogram(values, edges, weights=each.astype(float))[0] for each in weights]
    return tuple(column[num > 0] for column in ((edges[:-1] + edges[1:]) / 2.0, num, *sums))


def _draw_choices(
    axes: Axes, evaluation: Mapping[str, np.ndarray], practised: Mapping[str, float], *, has_people: bool
) -> None:
    edges, labels = np.array(OFFSET_EDGES, dtype=float), []
    optimum = evaluation.get("optimum", np.full((len(evaluation["option"]), 2), np.nan))
    congruent = evaluation["option"] == CONGRUENT
    title = "Congruent boat chosen"
    is_known = np.isfinite(optimum).all(1)
    if is_known.any():
        better = optimum[is_known, CONGRUENT] > optimum[is_known, INCONGRUENT]
        centres, num, chosen = _in_bins(evaluation["bearing_offset"][is_known], edges, better)
        oracle = chosen / num
        axes.plot(centres, oracle, color=INK, linewidth=1.1, marker="s", markersize=4)
        labels.append((oracle[-1], "oracle", INK))
        title += f" (better boat in {(better == congruent[is_known]).mean():.0%})"
    if has_people:
        label, colour, dashes = REFERENCES["human"]
        middles = (edges[:-1] + edges[1:]) / 2.0
        axes.plot(middles, HUMAN_CONGRUENT_BY_OFFSET, color=colour, linestyle=dashes, marker="D", markersize=4)
        labels.append((HUMAN_CONGRUENT_BY_OFFSET[-1], label, colour))
    centres, num, chosen = _in_bins(evaluation["bearing_offset"], edges, congruent)
    fraction = chosen / num
    intervals = [
        binomtest(int(k), int(n)).proportion_ci(0.95, method="wilson") for k, n in zip(chosen.round(), num, strict=True)
    ]
    errors = np.maximum([fraction - [i.low for i in intervals], [i.high for i in intervals] - fraction], 0.0)
    axes.errorbar(centres, fraction, errors, color=AGENT, linewidth=2.0, marker="o", markersize=5, capsize=3)
    labels.append((fraction[-1], "this agent", AGENT))
    if "congruent" in practised:
        axes.axhline(practised["congruent"], color=AGENT, linewidth=1.0, linestyle=":")
        labels.append((practised["congruent"], "its practice", AGENT))
    axes.set(xlim=(0, 60), ylim=(-0.03, 1.03), xticks=edges)
    axes.set_xlabel("degrees between the goal's bearing and the congruent boat's nearest key")
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set_title(title)
    label_ends(axes, labels, ends=centres[-1] / edges[-1])


def _draw_boats(axes: Axes, evaluation: Mapping[str, np.ndarray], names: Sequence[str]) -> None:
    """Draw the fraction of choices of each controller by the goal's bearing, for the agent and the planner.

    If several controllers are equally good, the planner's choice is split evenly between them. Its choice is known in
    the episodes whose `optimum` is finite.
    """
    to_goal = evaluation["goal"] - evaluation["start"]
    bearing = np.degrees(np.arctan2(to_goal[:, 1], to_goal[:, 0])) % 360.0
    is_known = np.isfinite(evaluation["optimum"]).all(1)
    optimum, option = evaluation["optimum"][is_known], evaluation["option"].astype(int)
    is_best = optimum == optimum.max(1, keepdims=True)
    edges = np.arange(0.0, 361.0, 30.0)
    title = "Boat chosen"
    for boat, name in enumerate(names):
        centres, num, chosen = _in_bins(bearing, edges, option == boat)
        axes.plot(centres, chosen / num, color=f"C{boat}", label=name, linewidth=2.0, marker="o", markersize=5)
        if is_known.any():
            centres, num, planned = _in_bins(bearing[is_known], edges, is_best[:, boat] / is_best.sum(1))
            axes.plot(centres, planned / num, color=f"C{boat}", linewidth=1.1, linestyle="--")
    if is_known.any():
        title += f" (best one in {is_best[np.arange(len(is_best)), option[is_known]].mean():.0%})"
    axes.set(xlim=(0, 360), ylim=(-0.03, 1.2), xticks=edges[::2], yticks=np.linspace(0.0, 1.0, 6))
    dashed = "; dashed: oracle" if is_known.any() else ""
    axes.set_xlabel(f"the goal's bearing, degrees (0 to the right, 90 down){dashed}")
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set_title(title)
    axes.legend(frameon=False, fontsize=8.5, loc="upper center", ncols=min(len(names), 3))


def _draw_outcomes(axes: Axes, outcomes: np.ndarray, people: Mapping[str, float]) -> None:
    names = [name for code, name in enumerate(OUTCOMES) if (outcomes == code).any() or people.get(name)]
    colour = REFERENCES["human"][1]
    for row, name in enumerate(names):
        fraction = (outcomes == OUTCOMES.index(name)).mean()
        axes.barh(row, fraction, color=_colour(name), height=0.62)
        axes.annotate(f"{fraction:.1%}", (1.19, row), ha="right", va="center", fontsize=8.5, annotation_clip=False)
        if people.get(name) is not None:
            for edge, width in (("white", 4.5), (colour, 2.0)):  # the white edge sets the mark apart from the bar
                axes.plot([people[name]] * 2, [row - 0.38, row + 0.38], color=edge, linewidth=width)
    if people.get("success") is not None:
        axes.annotate("people", (people["success"], -0.45), color=colour, ha="center", va="bottom", fontsize=8.5)
    axes.set(xlim=(0, 1), ylim=(len(names) - 0.4, -0.85))
    axes.set_yticks(range(len(names)), [_words(name) for name in names])
    axes.xaxis.set_major_formatter(PercentFormatter(1.0))
    axes.tick_params(axis="y", length=0)
    axes.set_title("How episodes end")
