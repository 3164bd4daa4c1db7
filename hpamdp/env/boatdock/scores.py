"""Mean figures of an evaluation on boats."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hpamdp.env.boatdock.options import BoatDockOptions
from hpamdp.env.boatdock.physics import OUTCOMES, SAILING
from hpamdp.env.boatdock.reference import human_normalised
from hpamdp.env.boatdock.task import FAILURE_REWARD


def measure_boats(played: Mapping[str, np.ndarray], controller: str, rules: BoatDockOptions) -> dict[str, float]:
    """Return the fractions of outcomes, the ceiling and the figures of the choice.

    For every evaluation:
    - the name of each outcome: the fraction of episodes that ended with it.
    - `ceiling`: the best possible mean score on the same layouts. If the agent chose (`option`), it is with the best
      controller of each layout, otherwise with the given one (`controller`).

    With the two controllers of the recording:
    - `human_normalised`: the human-normalised score, 0 for random presses and 1 for the mean of people.

    With other controllers:
    - `ceiling_success`: the fraction of these layouts in which a plan docks.

    If the agent chose:
    - `option_NAME`: the fraction of episodes with that controller. With a `switch_cost`, of those that began with it.
    - `oracle_agreement`: the fraction of episodes with the best controller.
    - `oracle_agreement_weighted`: how much the agent's choices gained over the worst ones, as a fraction of the gain of
      the best ones. It is 1 if all choices are equally good.

    Args:
        played: arrays of an evaluation, whose first dimension is the episode.
        controller: `chosen`, the name of a controller, or `random`.
        rules: rules of the environment.
    """
    outcome, optimum, chosen = played["outcome"], played["optimum"], played.get("option")
    held = (played["controller"] if chosen is None else chosen).astype(int)
    best = optimum.max(1) if chosen is not None else np.take_along_axis(optimum, held[:, None], 1)[:, 0]
    means = {"ceiling": float(best.mean())}
    if rules.boats is None:
        means["human_normalised"] = human_normalised(float(played["score"].mean()), controller)
    else:
        means["ceiling_success"] = float((best > FAILURE_REWARD).mean())
    for code, name in enumerate(OUTCOMES):
        if code != SAILING:
            means[name] = float((outcome == code).mean())
    if chosen is None:
        return means
    for option, name in enumerate(rules.names):
        means[f"option_{name}"] = float((held == option).mean())
    of_choice = np.take_along_axis(optimum, held[:, None], 1)[:, 0]
    worst = optimum.min(1)
    means["oracle_agreement"] = float((of_choice == best).mean())
    at_stake = (best - worst).sum()
    means["oracle_agreement_weighted"] = float((of_choice - worst).sum() / at_stake) if at_stake > 0.0 else 1.0
    return means
