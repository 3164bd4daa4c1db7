"""Draw the figures of a finished or stopped run."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator, PercentFormatter

from hpamdp.env.base import Metric, PAMDPEnv
from hpamdp.figure_style import AGENT, REFERENCES, STYLE, label_ends
from hpamdp.files import replacing
from hpamdp.messages import duration, warn
from hpamdp.metrics_file import EVALUATION, FRAMES, WALL_SECONDS, read_rows
from hpamdp.run_files import CURVES_NAME, FIGURES_NAME, METRICS_NAME, listed_figures


def draw_all(
    output_dir: Path, env: type[PAMDPEnv], summary: Mapping[str, Any], evaluation: Mapping[str, np.ndarray]
) -> list[Path]:
    """Draw the figures of a run into its folder, and return their paths. Pictures that no run has written stay.

    Args:
        output_dir: the run's folder, whose `metrics.csv` has the rows of `learning_curves.png`.
        env: the environment's class, which names the curves and draws its own figures.
        summary: the run's summary, with the references.
        evaluation: arrays of the last evaluation, of which the environment draws figures.
    """
    with mpl.rc_context(STYLE):
        curves = learning_curves(read_rows(output_dir / METRICS_NAME), summary, env.curves(summary))
        figures = {} if curves is None else {CURVES_NAME: curves}
        figures |= env.draw_figures(evaluation, summary)
        for name in figures.keys() - {*listed_figures(output_dir)}:
            if os.path.lexists(output_dir / name):
                warn(f"{output_dir / name}: no run has written it, so it stays, and the run's own figure is left out")
                del figures[name]
        with replacing(output_dir / FIGURES_NAME) as partial:
            partial.write_text("".join(f"{name}\n" for name in figures))
        for name, figure in figures.items():
            with replacing(output_dir / name) as partial:
                figure.savefig(partial)
    return [output_dir / name for name in figures]


def _series(rows: list[dict[str, float]], name: str) -> tuple[np.ndarray, np.ndarray]:
    points = [(row[FRAMES], row[name]) for row in rows if FRAMES in row and name in row]
    finite = np.array([point for point in points if np.isfinite(point).all()]).reshape(-1, 2)
    return finite[:, 0], finite[:, 1]


def learning_curves(
    rows: list[dict[str, float]], summary: Mapping[str, Any], metrics: tuple[Metric, ...]
) -> Figure | None:
    """Return a figure with one panel per metric that was logged, or None if none was."""
    logged = {name for row in rows for name in row}
    shown = [metric for metric in metrics if {EVALUATION + metric.name, "train/" + metric.name} & logged]
    if not shown:
        return None
    columns = min(len(shown), 2)
    num_rows = -(-len(shown) // columns)
    figure = Figure(figsize=(4.8 * columns, 3.2 * num_rows + 0.3), layout="constrained")
    panels = figure.subplots(num_rows, columns, squeeze=False).ravel()
    for axes in panels[len(shown) :]:
        axes.set_axis_off()
    for axes, metric in zip(panels, shown, strict=False):
        _draw_curve(axes, rows, metric, summary.get("references", {}))
    seconds = _series(rows, WALL_SECONDS)[1].max(initial=0.0)
    figure.supxlabel(f"steps of training{f' ({duration(seconds)} in all)' if seconds else ''}", fontsize=9)
    return figure


def _draw_curve(
    axes: Axes, rows: list[dict[str, float]], metric: Metric, references: Mapping[str, Mapping[str, float]]
) -> None:
    is_share = metric.kind == "share"
    write = "{:.0%}".format if is_share else "{:.2f}".format
    labels = []
    for reference, (label, colour, dashes) in REFERENCES.items():
        value = references.get(reference, {}).get(metric.name)
        if value is not None and np.isfinite(value):
            axes.axhline(value, color=colour, linestyle=dashes, linewidth=1.1, zorder=1)
            labels.append((value, f"{label} {write(value)}", colour))
    trained, evaluated = _series(rows, "train/" + metric.name), _series(rows, EVALUATION + metric.name)
    faint = {"alpha": 0.35, "linewidth": 1.0, "zorder": 2}
    bold = {"linewidth": 2.0, "marker": "o", "markersize": 3.5, "zorder": 3, "clip_on": False}
    for (frames, values), label, line in ((evaluated, "this agent", bold), (trained, "exploring", faint)):
        if len(values):
            if len(values) < 3:  # too few for a curve
                line |= {"linestyle": "", "marker": "o", "clip_on": False}
            axes.plot(frames, values, color=AGENT, **line)
            labels.append((values[-1], f"{label} {write(values[-1])}", AGENT))
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
    axes.set_title(metric.title)
    label_ends(axes, labels)
