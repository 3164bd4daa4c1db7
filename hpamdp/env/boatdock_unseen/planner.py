"""The ceiling of boats that nobody has sailed: the best plan of an agent that knows what the boat's keys do."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from hpamdp.env.boatdock import planner
from hpamdp.env.boatdock.harbour import Layout
from hpamdp.env.boatdock.planner import MAX_PRESSES, Plan
from hpamdp.env.boatdock.task import DOCKING_SPEED, GLIDE, TANK, speed
from hpamdp.env.boatdock_unseen.fleet import Boats


def best_plan(
    x: Tensor,
    y: Tensor,
    goal_x: Tensor,
    goal_y: Tensor,
    fuel: Tensor,
    directions: Tensor,
    strength: Tensor,
    glide: Tensor,
    *,
    shortest_press: float = 0.0,
    max_presses: int = MAX_PRESSES,
    is_rough: bool = False,
) -> Plan:
    """Return the best plan of every boat from its current place of rest.

    Every row has a boat of its own. Strength and glide only scale the distance of a press, because the best last press
    still comes to rest at the dock.

    Plans have at most three presses. For boats with any directions, a fourth press would dock 2 more layouts in 100 and
    raise the mean score by 0.04 (2,000 layouts). For boats with people's angles three are enough.

    With a `shortest_press`, a last press that meets the dock before its release counts with all its seconds, although
    it burns fewer. The score is then too low, by at most 5/6 of the shortest press. This needs a last leg shorter than
    the shortest press covers before its release: 0.3 px in 0.2 s.

    Args:
        x, y: position of the boat, at rest, px from the harbour's centre, `[N]`.
        goal_x, goal_y: centre of the dock, px from the harbour's centre, `[N]`.
        fuel: seconds of pressing left in the tank, `[N]`.
        directions: unit direction of each key, `[N, 3, 2]`.
        strength: factor of the speed while the key is down, `[N]`.
        glide: factor of the length of the glide, `[N]`.
        shortest_press: seconds. Each press of a plan has at least as many.
        max_presses: largest number of presses of a plan, 1 to 3.
        is_rough: whether to search 60 times faster, with scores 0.002 lower on average and up to 0.07 lower.

    Raises:
        ValueError: after the shortest press the strongest boat is too fast to dock.
    """
    fastest = speed(shortest_press) * strength.amax().item() if len(strength) else 0.0
    if fastest > DOCKING_SPEED:
        raise ValueError(
            f"shortest_press={shortest_press:g} s leads to {fastest:.0f} px/s, but at most {DOCKING_SPEED:g} px/s dock"
        )
    return planner.plan_with_directions(
        x,
        y,
        goal_x,
        goal_y,
        fuel,
        directions,
        scale=strength * (1.0 + GLIDE * glide) / (1.0 + GLIDE),
        shortest_press=shortest_press,
        max_presses=max_presses,
        is_rough=is_rough,
    )


def best_scores(layout: Layout, boats: Sequence[Boats], shortest_press: float) -> Tensor:
    """Return the scores `[N]` of the best plans from the start with a full tank, each with the better one of its boats.

    They come from the rough search, so they are up to 0.07 too low.

    Args:
        layout: layouts with fields `[N]`.
        boats: the boats to choose from, with fields `[N, ...]` each.
        shortest_press: seconds.
    """
    fuel = torch.full_like(layout.start_x, TANK)
    plans = (best_plan(*layout, fuel, *each, shortest_press=shortest_press, is_rough=True) for each in boats)
    return torch.stack([plan.score for plan in plans]).amax(0)
