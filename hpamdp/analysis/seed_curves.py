"""Draw learning curves of many seeds: the mean of each configuration, with a band of one standard deviation."""

from __future__ import annotations

import warnings
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator

from hpamdp.analysis.seed_runs import Configuration
from hpamdp.analysis.statistics import mean_curve
from hpamdp.figure_style import LEARNER_COLOURS, REFERENCES, STYLE, label_ends
from hpamdp.messages import one_line
from hpamdp.metrics_file import EVALUATION

SOFTWARE = "hpamdp report"  # in the metadata of the picture
_MOST_LINES, _MOST_PANELS = 12, 12
_LONGEST = 48  # letters of a label


def draw(configurations: Sequence[Configuration], metric: str) -> Callable[[Path], None] | None:
    """Draw a panel for each problem, and return a function that saves the figure; None if there are no curves.

    Only finished runs count. A mean has its band as long as all of its seeds go on. It is dotted after the first one
    has ended.
    """
    problems: dict[str, list[Configuration]] = defaultdict(list)
    for configuration in configurations:
        if any(len(run.curve) for run in configuration.scored):
            problems[configuration.problem].append(configuration)
    if not problems:
        return None
    panels = list(problems.values())[:_MOST_PANELS]
    columns = min(len(panels), 2)
    num_rows = -(-len(panels) // columns)
    with _style():
        figure = Figure(figsize=(6.4 * columns, 3.6 * num_rows + 0.3), layout="constrained")
        axes = figure.subplots(num_rows, columns, squeeze=False).ravel()
        for empty in axes[len(panels) :]:
            empty.set_axis_off()
        left_out = len(problems) - len(panels)
        for panel, shown in zip(axes, panels, strict=False):
            lines = shown[:_MOST_LINES]
            left_out += len(shown) - len(lines)
            _draw_panel(panel, lines, metric)
        figure.supxlabel(_caption(panels, left_out), fontsize=9)
    return partial(_save, figure)


@contextmanager
def _style() -> Iterator[None]:
    """Apply the style of all figures inside the block. Values of settings may have any letters."""
    with mpl.rc_context({**STYLE, "text.parse_math": False}), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about letters that the font lacks
        yield


def _save(figure: Figure, path: Path) -> None:
    with _style():
        figure.savefig(path, metadata={"Software": SOFTWARE})


def _draw_panel(axes: Axes, configurations: Sequence[Configuration], metric: str) -> None:
    labels, heights, end = [], [], 1.0
    for name, value in _references(configurations, metric).items():
        label, colour, dashes = REFERENCES[name]
        axes.axhline(value, color=colour, linestyle=dashes, linewidth=1.1, zorder=1)
        labels.append((value, f"{label} {value:.2f}", colour))
    for configuration, colour in zip(configurations, _colours(configurations), strict=True):
        curves = [run.curve for run in configuration.scored if len(run.curve)]
        frames, means, deviations, counts = mean_curve(curves)
        whole = counts == len(curves)
        last = int(np.flatnonzero(whole)[-1]) if whole.any() else 0
        line: dict[str, Any] = {"color": colour, "zorder": 3, "clip_on": False}
        axes.plot(frames[: last + 1], means[: last + 1], linewidth=2.0, marker="o", markersize=3.5, **line)
        axes.plot(frames[last:], means[last:], linewidth=1.2, linestyle=":", **line)
        band = means - deviations, means + deviations
        if len(curves) > 1:
            axes.fill_between(frames, *band, where=whole, color=colour, alpha=0.18, linewidth=0.0, zorder=2)
        heights += [*band[0][whole], *band[1][whole], *means]
        end = max(end, frames[-1])
        name = configuration.name if len(configuration.name) <= _LONGEST else f"{configuration.name[: _LONGEST - 1]}…"
        labels.append((float(means[-1]), f"{name}: {means[-1]:.2f}", colour))
    heights += [height for height, _, _ in labels]
    margin = 0.05 * max(max(heights) - min(heights), 0.1)
    axes.set_ylim(min(heights) - margin, max(heights) + margin)
    axes.set_xlim(0.0, end)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.set_title(one_line(metric.removeprefix(EVALUATION)))
    label_ends(axes, labels)


def _references(configurations: Sequence[Configuration], metric: str) -> dict[str, float]:
    """Return the metric of each reference that figures show, the mean over the runs."""
    values = defaultdict(list)
    for configuration in configurations:
        for run in configuration.scored:
            for name, value in run.references(metric).items():
                values[name].append(value)
    return {name: fmean(values[name]) for name in REFERENCES if name in values}


def _colours(configurations: Sequence[Configuration]) -> list[str]:
    """Return the learners' own colours if the learner alone tells the configurations apart, otherwise any."""
    learners = [str(configuration.scored[0].summary.get("low")) for configuration in configurations]
    if len({*learners}) == len(learners) and all(learner in LEARNER_COLOURS for learner in learners):
        return [LEARNER_COLOURS[learner] for learner in learners]
    return [*LEARNER_COLOURS.values()][: len(configurations)]


def _caption(panels: Sequence[Sequence[Configuration]], left_out: int) -> str:
    nums = sorted({len(configuration.scored) for shown in panels for configuration in shown})
    seeds = f"{nums[0]} to {nums[-1]}" if len(nums) > 1 else str(nums[0])
    caption = (
        f"steps of training; mean ± standard deviation over {seeds} seeds" if nums[-1] > 1 else "steps of training"
    )
    return f"{caption}; {left_out} more not shown" if left_out else caption
