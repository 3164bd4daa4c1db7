"""What people reached: scores, shares, choices, and how far below the best plan they stayed."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from hpamdp.data.human.episodes import score
from hpamdp.data.human.released_file import HumanData
from hpamdp.env.boatdock import harbour, physics, planner
from hpamdp.env.boatdock.reference import OFFSET_EDGES, Figures

_COINCIDES = 30.0  # degrees off the congruent boat's nearest direction up to which it is the better boat


def layouts(data: HumanData) -> harbour.Layout:
    """Return the episodes' layouts, px from the harbour's centre."""
    start, goal = (data.episodes[name] - data.episodes["centre"] for name in ("start", "goal"))
    return harbour.Layout(*start.unbind(1), *goal.unbind(1))


def figures(data: HumanData, mask: Tensor | None = None) -> Figures:
    """Return the figures of the episodes of `mask` `[E]`, under the names of `hpamdp.env.boatdock.reference`.

    `score_error` is the mean score's standard error, over episodes; `episodes` their number.
    """
    mask = torch.ones(len(data.episodes), dtype=torch.bool) if mask is None else mask
    episodes, scores = data.episodes[mask], score(data)[mask]
    is_congruent = episodes["controller"] == harbour.CONGRUENT
    coincides = harbour.bearing_offset(layouts(data))[mask] < _COINCIDES
    shares = {
        name: episodes["outcome"] == code for code, name in enumerate(physics.OUTCOMES) if code != physics.SAILING
    }
    shares |= {"option_congruent": is_congruent, "oracle_agreement": is_congruent == coincides}
    return {
        "episodes": len(scores),
        "score": scores.double().mean().item(),
        "score_error": (scores.double().std() / len(scores) ** 0.5).item(),
        **{name: share.double().mean().item() for name, share in shares.items()},
        "presses": episodes["presses"].double().mean().item(),
    }


def figures_by(data: HumanData, column: str) -> dict[int, Figures]:
    """Return the figures for every value of a column of the episodes: `person`, `block`, `controller`, `keymap`."""
    values = data.episodes[column]
    return {int(value): figures(data, values == value) for value in values.unique()}


def offset_bins(data: HumanData) -> Tensor:
    """Return the bin of each episode `[E]` between OFFSET_EDGES, by the bearing's offset."""
    edges = torch.tensor(OFFSET_EDGES[1:-1], dtype=torch.float32)
    return torch.bucketize(harbour.bearing_offset(layouts(data)), edges)


def choice_curve(data: HumanData, mask: Tensor | None = None) -> np.ndarray:
    """Return the share choosing the congruent boat by the bearing's offset `[6]`; NaN where there is no episode."""
    mask = torch.ones(len(data.episodes), dtype=torch.bool) if mask is None else mask
    bins, num = offset_bins(data)[mask], len(OFFSET_EDGES) - 1
    congruent = (data.episodes["controller"][mask] == harbour.CONGRUENT).double()
    return (torch.bincount(bins, congruent, num) / torch.bincount(bins, minlength=num)).numpy()


def best_scores(data: HumanData) -> Tensor:
    """Return the best possible score of each episode with the incongruent and the congruent boat `[E, 2]`.

    Takes about a second for a thousand episodes.
    """
    return planner.best_plans(layouts(data), data.episodes["keymap"]).score


def optimality_gaps(data: HumanData, best: Tensor) -> Mapping[str, Tensor]:
    """Return what every episode fell short by `[E]`, given `best_scores`.

    `gap` of the best plan with the better boat, the sum of `choice_gap` (lost by choosing the worse boat) and
    `press_gap` (lost with the boat that was chosen).
    """
    chosen = best.gather(1, data.episodes["controller"].unsqueeze(1)).squeeze(1)
    better = best.max(1).values
    return {"gap": better - score(data), "choice_gap": better - chosen, "press_gap": chosen - score(data)}
