"""Parts of the recording: complete logs, successes, the best people, one boat."""

from __future__ import annotations

import torch
from torch import Tensor

from hpamdp.data.human.errors import HumanDataError
from hpamdp.data.human.released_file import FULL_TANK, HumanData
from hpamdp.env.boatdock import harbour, physics


def score(data: HumanData) -> Tensor:
    """Return the episodes' scores `[E]`: 5 x the tank left (fraction) on success, else -1."""
    return harbour.score(data.episodes["outcome"], data.episodes["tank"] / FULL_TANK)


def scores_of_people(data: HumanData) -> Tensor:
    """Return each person's mean score `[people]`, NaN for numbers that no episode has."""
    person = data.episodes["person"]
    return torch.bincount(person, score(data)) / torch.bincount(person)


def keep(data: HumanData, mask: Tensor) -> HumanData:
    """Return the episodes of `mask` `[E]` with their presses, numbered anew."""
    number = mask.cumsum(0) - 1
    episode = data.presses["episode"]
    presses = data.presses[mask[episode]].clone()
    return HumanData(data.episodes[mask].clone(), presses.set("episode", number[presses["episode"]]))


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
        complete: only those whose log misses no press.
        successes: only those that docked.
        best_people: only those of this many people, by their mean score over all their episodes in `data`.
        controller: only those with the `congruent` or the `incongruent` boat.

    Raises:
        HumanDataError: a condition that makes no sense, or that nothing meets.
    """
    episodes = data.episodes
    mask = torch.ones(len(episodes), dtype=torch.bool)
    if complete:
        mask &= episodes["complete"]
    if successes:
        mask &= episodes["outcome"] == physics.SUCCESS
    if best_people is not None:
        scores = scores_of_people(data).nan_to_num(nan=-torch.inf)
        num = int(scores.isfinite().sum())
        if not 1 <= best_people <= num:
            raise HumanDataError(f"best_people={best_people}, but must be 1 to {num}")
        mask &= torch.isin(episodes["person"], scores.topk(best_people).indices)
    if controller is not None:
        if controller not in harbour.CONTROLLERS:
            raise HumanDataError(f"controller={controller!r}, but must be one of {', '.join(harbour.CONTROLLERS)}")
        mask &= episodes["controller"] == harbour.CONTROLLERS.index(controller)
    if not mask.any():
        raise HumanDataError("no episode meets all the conditions")
    return keep(data, mask)
