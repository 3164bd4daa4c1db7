"""Scores of the episodes, and subsets of them: complete logs, successes, the best people, one controller."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from hpamdp.data import DataError
from hpamdp.data.human.released_file import FULL_TANK, HumanData
from hpamdp.env.boatdock import harbour, physics
from hpamdp.messages import as_code


def score(data: HumanData) -> Tensor:
    """Return the episodes' scores `[E]`: 5 times the fuel left (fraction of a tank) on success, else -1."""
    return harbour.score(data.episodes["outcome"], data.episodes["tank"] / FULL_TANK)


def scores_by_person(data: HumanData) -> Tensor:
    """Return the mean score of each person from 0 to the highest number in `person`, `[P]`. NaN without episodes."""
    person = data.episodes["person"]
    return torch.bincount(person, score(data)) / torch.bincount(person)


def keep(data: HumanData, mask: Tensor) -> HumanData:
    """Return the episodes of `mask` `[E]` with their presses. `episode` is then the row in the new table."""
    new_row = mask.cumsum(0) - 1
    episode = data.presses["episode"]
    presses = data.presses[mask[episode]].clone()
    presses["episode"] = new_row[presses["episode"]]
    return HumanData(data.episodes[mask].clone(), presses)


def check_conditions(complete: object, successes: object, best_people: object, controller: object) -> None:
    """Refuse conditions that `select` does not take.

    Raises:
        DataError: a condition is of another type, or there is no such controller.
    """
    for name, value in (("complete", complete), ("successes", successes)):
        if not isinstance(value, bool):
            raise DataError(f"{name}={as_code(value)}, but must be True or False")
    if best_people is not None and (isinstance(best_people, bool) or not isinstance(best_people, int | np.integer)):
        raise DataError(f"best_people={as_code(best_people)}, but must be a whole number or None")
    if controller is not None and controller not in harbour.CONTROLLERS:
        raise DataError(f"controller={as_code(controller)}, but must be one of {', '.join(harbour.CONTROLLERS)}")


def select(
    data: HumanData,
    *,
    complete: bool = False,
    successes: bool = False,
    best_people: int | None = None,
    controller: str | None = None,
) -> HumanData:
    """Return the episodes that meet every condition.

    Args:
        complete: only episodes with a complete log of presses.
        successes: only episodes that ended in the dock.
        best_people: only episodes of this many people with the highest mean scores over all their episodes in `data`.
            If None, of all people.
        controller: only episodes with the `congruent` or the `incongruent` controller. If None, with either.

    Raises:
        DataError: a condition is of another type or out of range, or no episode meets them all.
    """
    check_conditions(complete, successes, best_people, controller)
    episodes = data.episodes
    mask = torch.ones(len(episodes), dtype=torch.bool)
    if complete:
        mask &= episodes["complete"]
    if successes:
        mask &= episodes["outcome"] == physics.SUCCESS
    if best_people is not None:
        scores = scores_by_person(data).nan_to_num(nan=-torch.inf)
        num_people = int(scores.isfinite().sum())
        if not 1 <= best_people <= num_people:
            raise DataError(f"best_people={best_people}, but must be 1 to {num_people}")
        mask &= torch.isin(episodes["person"], scores.topk(best_people).indices)
    if controller is not None:
        mask &= episodes["controller"] == harbour.CONTROLLERS.index(controller)
    if not mask.any():
        raise DataError("no episode meets all the conditions")
    return keep(data, mask)
