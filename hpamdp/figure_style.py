"""Define the style of all figures: colours, fonts, and labels at the ends of lines."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

if TYPE_CHECKING:
    from matplotlib.axes import Axes  # takes a third of a second, which a loaded agent need not wait for

# Colours of Okabe and Ito and of Tol, which colour-blind people can tell apart. Each has one meaning in all figures.
AGENT, INK, FAINT = "#0072B2", "#2b2b2b", "#8c8c8c"

# Colour of each learner, in the order of legends and tables.
LEARNER_COLOURS = {
    "hppo": "#0072B2",
    "hsac": "#D55E00",
    "pdqn": "#009E73",
    "hyar": "#CC79A7",
    "hyar_ddpg": "#DDCC77",
    "qpamdp": "#E69F00",
    "dlpa": "#56B4E9",
    "paddpg": "#6b6b00",
    "patd3": "#332288",
    "mpdqn_published": "#882255",
    "pdqn_published": "#117733",
    "hppo_published": "#88CCEE",
    "hyar_published": "#CC6677",
    "pets": "#AA4499",
}

# Label, colour and line style of each reference.
REFERENCES = {
    "random": ("random", "#8c8c8c", ":"),
    "human": ("people", "#D98200", "--"),
    "you": ("you", "#D98200", "--"),
    "best_person": ("best person", "#D98200", "-."),
    "ceiling": ("ceiling", "#2b2b2b", "-"),
}

STYLE: Any = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#666666",
    "axes.labelcolor": INK,
    "xtick.color": "#666666",
    "ytick.color": "#666666",
    "text.color": INK,
    "savefig.dpi": 160,
}


def draw_spread(axes: Axes, x: ArrayLike, mean: np.ndarray, deviation: np.ndarray, *style: str, **line: Any) -> None:
    """Draw a line, and a band of one deviation in its colour; the other arguments are those of `Axes.plot`."""
    colour = axes.plot(x, mean, *style, **line)[0].get_color()
    axes.fill_between(x, mean - deviation, mean + deviation, color=colour, alpha=0.15, linewidth=0)


def with_minus(text: str) -> str:
    """Return a text whose negative numbers have the minus sign of the axes; settings such as `x=-1` stay."""
    return re.sub(r"(?<![^\s(])-(?=[\d.])", "\u2212", text)


def label_ends(axes: Axes, labels: list[tuple[float, str, str]], ends: float = 1.0) -> None:
    """Write labels (height, text, colour) to the right of the axes, at least a line's height apart.

    A thin leader joins each label to the end of its line. `ends` are the ends' places, as fractions of the axes' width.
    """
    low, high = axes.get_ylim()
    labels = sorted(labels)
    heights = [(height - low) / (high - low) for height, _, _ in labels]
    for height, place, (_, text, colour) in zip(heights, apart(heights, 0.064), labels, strict=True):
        axes.plot(
            [ends, 1.03],
            [height, place],
            color=colour,
            linewidth=0.7,
            alpha=0.7,
            clip_on=False,
            transform=axes.transAxes,
        )
        axes.annotate(
            with_minus(text), (1.04, place), xycoords="axes fraction", color=colour, va="center", fontsize=8.5
        )


def apart(heights: list[float], gap: float) -> list[float]:
    """Move sorted heights at least `gap` apart. A cluster keeps its mean, and no height exceeds 1."""
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
