"""Scores of the episodes, and subsets of them: complete logs, successes, the best people, one controller."""

from __future__ import annotations

from collections.abc import Collection

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


def _best_first(data: HumanData, people: Collection[int] | None) -> list[int]:
    """Return the numbers of the people in `data`, or of those in `people`, by their mean scores, the highest first."""
    scores = scores_by_person(data)
    present = scores.isfinite().nonzero().squeeze(1).tolist()
    unknown = set(() if people is None else people).difference(present)
    if unknown:
        raise DataError(
            f"people: nobody has the number {min(unknown)}; the numbers are {min(present)} to {max(present)}"
        )
    return sorted(present if people is None else set(people), key=lambda person: -float(scores[person]))


def _number_of(controller: str) -> int:
    if controller not in harbour.CONTROLLERS:
        raise DataError(f"controller={as_code(controller)}, but must be one of {', '.join(harbour.CONTROLLERS)}")
    return harbour.CONTROLLERS.index(controller)


def select(
    data: HumanData,
    *,
    complete: bool = False,
    successes: bool = False,
    people: Collection[int] | None = None,
    best_people: int | None = None,
    worst_people: int | None = None,
    presses: int | None = None,
    controller: str | None = None,
) -> HumanData:
    """Return the episodes that meet every condition.

    Args:
        complete: only episodes with a complete log of presses.
        successes: only episodes that ended in the dock.
        people: only episodes of the people with these numbers. If None, of all people.
        best_people, worst_people: of these, only episodes of this many people with the highest, or the lowest, mean
            scores over all their episodes in `data`. If None, of all of them.
        presses: only the first episodes of each person that meet the other conditions and have at most this many
            logged presses together. If None, all of them.
        controller: only episodes with the `congruent` or the `incongruent` controller. If None, with either.

    Raises:
        DataError: a condition is out of range, or no episode meets them all.
    """
    episodes = data.episodes
    mask = torch.ones(len(episodes), dtype=torch.bool)
    if complete:
        mask &= episodes["complete"]
    if successes:
        mask &= episodes["outcome"] == physics.SUCCESS
    ranked = _best_first(data, people)
    chosen = set(ranked)
    for name, count, end in (("best_people", best_people, ranked), ("worst_people", worst_people, ranked[::-1])):
        if count is not None:
            if not 1 <= count <= len(ranked):
                raise DataError(f"{name}={count}, but must be 1 to {len(ranked)}")
            chosen &= set(end[:count])
    mask &= torch.isin(episodes["person"], torch.tensor(sorted(chosen)))
    if controller is not None:
        mask &= episodes["controller"] == _number_of(controller)
    if presses is not None:
        for person in chosen:
            of_person = mask & (episodes["person"] == person)
            mask &= ~of_person | ((episodes["presses"] * of_person).cumsum(0) <= presses)
    if not mask.any():
        raise DataError("no episode meets all the conditions")
    return keep(data, mask)
