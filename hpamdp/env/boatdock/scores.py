"""Means of an evaluation on boats."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hpamdp.env.boatdock.physics import OUTCOMES, SAILING
from hpamdp.env.boatdock.reference import human_normalised
from hpamdp.env.boatdock.task import FAILURE_REWARD, Rules


def measure_boats(played: Mapping[str, np.ndarray], controller: str, rules: Rules) -> dict[str, float]:
    """Return the outcomes' shares, the ceiling and the figures of the choice.

    - the share of each outcome, by its name;
    - `ceiling`: the best possible mean score on the same layouts, with the better controller of each where the agent
      chose (`option`), else with the one that was given (`controller`);
    - `ceiling_success`: with other boats than people's, the share of these layouts in which a plan docks;
    - `human_normalised`: the human-normalised score, 0 for random presses and 1 for the mean of people; only with the
      two controllers of the recording;
    - where the agent chose: `option_NAME`, the share of episodes with that controller, and with a `switch_cost` that
      began with it; `oracle_agreement`, the share with the best one; `oracle_agreement_weighted`, the share of what the
      choice is worth, from the worst to the best one, that the agent's was worth; 1 where all are equally good.

    Args:
        played: arrays of an evaluation, first dimension the episode.
        controller: `chosen`, the name of a boat, or `random`.
        rules: of the environment.
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
