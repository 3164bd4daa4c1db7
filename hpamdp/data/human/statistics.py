"""People's results: scores, fractions of outcomes and choices, and the distance to the best plan."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from hpamdp.data.human.episodes import score
from hpamdp.data.human.released_file import HumanData
from hpamdp.env.boatdock import harbour, physics, planner
from hpamdp.env.boatdock.reference import OFFSET_EDGES, Figures

# The congruent controller counts as better if the goal's bearing is less than this many degrees off the nearest of its
# directions.
_CONGRUENT_IS_BETTER_BELOW = 30.0


def layouts(data: HumanData) -> harbour.Layout:
    """Return the episodes' layouts, px from the harbour's centre."""
    start_x, start_y = (data.episodes["start"] - data.episodes["centre"]).unbind(1)
    goal_x, goal_y = (data.episodes["goal"] - data.episodes["centre"]).unbind(1)
    return harbour.Layout(start_x, start_y, goal_x, goal_y)


def figures(data: HumanData, mask: Tensor | None = None) -> Figures:
    """Return the mean figures of the episodes of `mask` `[E]`, by the names of `hpamdp.env.boatdock.reference`.

    There are three more figures: `presses`, the mean number of presses (called `steps` there); `score_error`, the
    standard error of the mean score, NaN for a single episode; and `episodes`, the number of episodes.
    """
    if mask is None:
        mask = torch.ones(len(data.episodes), dtype=torch.bool)
    episodes = data.episodes[mask]
    scores = score(data)[mask]
    is_congruent = episodes["controller"] == harbour.CONGRUENT
    congruent_is_better = harbour.bearing_offset(layouts(data))[mask] < _CONGRUENT_IS_BETTER_BELOW
    cases = {name: episodes["outcome"] == code for code, name in enumerate(physics.OUTCOMES) if code != physics.SAILING}
    cases["option_congruent"] = is_congruent
    cases["oracle_agreement"] = is_congruent == congruent_is_better
    deviation = scores.double().std().item() if len(scores) > 1 else math.nan
    return {
        "episodes": len(scores),
        "score": scores.double().mean().item(),
        "score_error": deviation / max(1, len(scores)) ** 0.5,
        **{name: is_case.double().mean().item() for name, is_case in cases.items()},
        "presses": episodes["presses"].double().mean().item(),
    }


def figures_by(data: HumanData, column: str) -> dict[int, Figures]:
    """Return the figures for every value of a column of `episodes`: `person`, `block`, `controller` or `keymap`."""
    values = data.episodes[column]
    return {int(value): figures(data, values == value) for value in values.unique()}


def offset_bins(data: HumanData) -> Tensor:
    """Return the bin of `OFFSET_EDGES` in which each episode's bearing offset lies, `[E]`."""
    edges = torch.tensor(OFFSET_EDGES[1:-1], dtype=torch.float32)
    return torch.bucketize(harbour.bearing_offset(layouts(data)), edges)


def choice_curve(data: HumanData, mask: Tensor | None = None) -> np.ndarray:
    """Return the probability of the congruent choice in each bin of `offset_bins`, `[6]`. NaN without episodes."""
    if mask is None:
        mask = torch.ones(len(data.episodes), dtype=torch.bool)
    bins = offset_bins(data)[mask]
    num_bins = len(OFFSET_EDGES) - 1
    is_congruent = (data.episodes["controller"][mask] == harbour.CONGRUENT).double()
    return (torch.bincount(bins, is_congruent, num_bins) / torch.bincount(bins, minlength=num_bins)).numpy()


def best_scores(data: HumanData) -> Tensor:
    """Return the best possible score of each episode with the incongruent and the congruent controller, `[E, 2]`.

    A thousand episodes take about a second.
    """
    return planner.best_plans(layouts(data), data.episodes["keymap"]).score
