"""Means of an evaluation on boats."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hpamdp.env.boatdock.harbour import CONTROLLERS
from hpamdp.env.boatdock.physics import OUTCOMES, SAILING
from hpamdp.env.boatdock.reference import human_normalised


def measure_boats(played: Mapping[str, np.ndarray], controller: str) -> dict[str, float]:
    """Return the outcomes' shares, the ceiling and the figures of the choice.

    - the share of each outcome, by its name;
    - `ceiling`: the best possible mean score on the same layouts, with the better controller of each where the agent
      chose (`option`), else with the one that was given (`controller`);
    - `human_normalised`: the score, where random presses score 0 and people 1;
    - where the agent chose: `option_NAME`, the share of episodes with that controller; `oracle_agreement`, the share
      with the better one; `oracle_agreement_weighted`, the same weighted by what the choice is worth.

    Args:
        played: arrays of an evaluation, first dimension the episode.
        controller: `chosen`, `congruent`, `incongruent` or `random`.
    """
    outcome, optimum, chosen = played["outcome"], played["optimum"], played.get("option")
    held = (played["controller"] if chosen is None else chosen).astype(int)
    best = optimum.max(1) if chosen is not None else np.take_along_axis(optimum, held[:, None], 1)[:, 0]
    means = {
        "ceiling": float(best.mean()),
        "human_normalised": human_normalised(float(played["score"].mean()), controller),
    }
    for code, name in enumerate(OUTCOMES):
        if code != SAILING:
            means[name] = float((outcome == code).mean())
    if chosen is None:
        return means
    for option, name in enumerate(CONTROLLERS):
        means[f"option_{name}"] = float((held == option).mean())
    is_better = optimum.argmax(1) == held
    worth = np.abs(optimum[:, 1] - optimum[:, 0])
    means["oracle_agreement"] = float(is_better.mean())
    means["oracle_agreement_weighted"] = float((is_better * worth).sum() / worth.sum())
    return means
