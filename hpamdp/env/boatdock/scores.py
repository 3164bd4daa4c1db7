"""What an evaluation on boats comes to."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hpamdp.env.boatdock.harbour import CONTROLLERS
from hpamdp.env.boatdock.physics import OUTCOMES, SAILING


def measure_boats(played: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Return the shares of outcomes and controllers and the ceiling of evaluation episodes.

    `ceiling` is the best possible mean score on the same layouts: with the better controller of each where the agent
    chose (`option`), else with the controller that was given (`controller`). `oracle_agreement` is the share of
    episodes in which the agent chose the better controller, `oracle_agreement_weighted` the same weighted by what the
    choice is worth.
    """
    outcome, optimum, chosen = played["outcome"], played["optimum"], played.get("option")
    controller = (played["controller"] if chosen is None else chosen).astype(int)
    given = np.take_along_axis(optimum, controller[:, None], 1)[:, 0]
    scores = {"ceiling": float(np.mean(given if chosen is None else optimum.max(1)))}
    for code, name in enumerate(OUTCOMES):
        if code != SAILING:
            scores[name] = float((outcome == code).mean())
    for option, name in enumerate(CONTROLLERS):
        scores[f"option_{name}"] = float((controller == option).mean())
    if chosen is not None:
        is_better = optimum.argmax(1) == controller
        worth = np.abs(optimum[:, 1] - optimum[:, 0])
        scores["oracle_agreement"] = float(is_better.mean())
        scores["oracle_agreement_weighted"] = float((is_better * worth).sum() / worth.sum())
    return scores
