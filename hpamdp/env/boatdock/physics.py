"""The boat's motion: one press of a key in closed form, on batches of columns.

Units are pixels, seconds and pixels per second. Axes are those of the screen (y points down). Positions are relative to
the harbour's centre, which keeps float32 exact to about 1e-5 px.

Every function is pure, and takes and returns tensors of one shape `[*B]`. It has no Python loop over environments and
no branch that depends on the data. So the same code runs on CPU and CUDA, eager and compiled.

A press accelerates the boat from rest along the key's direction. Then the boat glides to rest: its speed runs back down
the same curve, stretched in time by GLIDE. The path is a straight segment. So closed forms give the first crossing of
the dock circle and of the harbour circle, and the speed there.

`press`, `distance_at` and `time_at` take two factors that make a boat unlike people's: `strength` multiplies its speed
while the key is down, and `glide` multiplies length and duration of its glide. Both are 1 for people's boats.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from hpamdp.env.boatdock.task import (
    DOCK_RADIUS,
    DOCKING_SPEED,
    DRY,
    GLIDE,
    HARBOUR_RADIUS,
    MAX_DURATION,
    OUT_OF_BOUNDS,
    OUT_OF_FUEL,
    OUTCOMES,
    SAILING,
    SUCCESS,
    TANK,
    TIME_LIMIT,
    TOO_FAST,
    speed,
)


class Press(NamedTuple):
    """The result of `press`, every field `[*B]`."""

    x: Tensor
    y: Tensor
    fuel: Tensor
    speed: Tensor
    outcome: Tensor


def pressed_distance(duration: Tensor) -> Tensor:
    """Return the distance P (px) covered while the key is down for `duration` seconds."""
    return duration**3 * ((100.0 / 3.0) - (5.0 / 3.0) * duration)


def total_distance(duration: Tensor) -> Tensor:
    """Return the distance (px) that a press of `duration` seconds covers from rest to rest, including the glide."""
    return (1.0 + GLIDE) * pressed_distance(duration)


def duration_for(distance: Tensor) -> Tensor:
    """Return the seconds of pressing that cover `distance` px while the key is down: the inverse of P.

    Newton's method starts at the root of the cubic term, with a first-order correction for the quartic term. That
    correction changes the root by under 4 % on [0, 2] s. P is increasing and convex there, and three steps reach
    float32 accuracy. Negative distances count as 0.
    """
    distance = distance.clamp(min=0.0)
    # The offset keeps the root's slope and the division finite at 0. It changes the result by up to 1e-4 s, and only
    # if the distance is under 1e-10 px.
    root = ((3.0 / 100.0) * distance + 1e-12) ** (1.0 / 3.0)
    duration = root * (1.0 + root / 60.0)
    for _ in range(3):
        duration = duration - (pressed_distance(duration) - distance) / speed(duration)
    return duration.clamp(min=0.0)


def press_for(distance: Tensor) -> Tensor:
    """Return the seconds of the press that moves the boat by `distance` px from rest to rest."""
    return duration_for(distance / (1.0 + GLIDE))


def distance_at(
    duration: Tensor, elapsed: Tensor, strength: Tensor | float = 1.0, glide: Tensor | float = 1.0
) -> Tensor:
    """Return the distance (px) covered `elapsed` seconds after the beginning of a press of `duration` seconds.

    `press` explains `strength` and `glide`.
    """
    pressed = pressed_distance(torch.minimum(elapsed, duration).clamp(min=0.0))
    stretch = GLIDE * glide
    # The glide runs back down the speed curve. `virtual` is the press time that would give the speed at that moment.
    virtual = (duration - (elapsed - duration).clamp(min=0.0) / stretch).clamp(min=0.0)
    glided = stretch * (pressed - pressed_distance(virtual))
    return strength * torch.where(elapsed > duration, pressed + glided, pressed)


def time_at(duration: Tensor, distance: Tensor, strength: Tensor | float = 1.0, glide: Tensor | float = 1.0) -> Tensor:
    """Return the seconds until a press of `duration` seconds has covered `distance` px: the inverse of `distance_at`.

    If the boat comes to rest before, return the time at which it does. `press` explains `strength` and `glide`.
    """
    pressed = pressed_distance(duration)
    distance = distance / strength
    stretch = GLIDE * glide
    virtual = torch.minimum(duration_for(pressed - (distance - pressed) / stretch), duration)
    in_glide = duration + stretch * (duration - virtual)
    return torch.where(distance > pressed, in_glide, torch.minimum(duration_for(distance), duration))


def distance_to_dock(x: Tensor, y: Tensor, goal_x: Tensor, goal_y: Tensor, dir_x: Tensor, dir_y: Tensor) -> Tensor:
    """Return the distance (px) along the course to the dock circle, or `inf` if the course misses the circle."""
    ahead = (goal_x - x) * dir_x + (goal_y - y) * dir_y
    aside = (goal_x - x) * dir_y - (goal_y - y) * dir_x
    half_chord_squared = DOCK_RADIUS**2 - aside * aside
    entry = ahead - half_chord_squared.clamp(min=0.0).sqrt()
    # The clamp serves boats that rounding has put just inside the circle: they meet it at once.
    return torch.where((half_chord_squared >= 0.0) & (ahead > 0.0), entry.clamp(min=0.0), torch.inf)


def distance_to_harbour(x: Tensor, y: Tensor, dir_x: Tensor, dir_y: Tensor) -> Tensor:
    """Return the distance (px) along the course to the harbour circle."""
    ahead = x * dir_x + y * dir_y
    aside = x * dir_y - y * dir_x
    return ((HARBOUR_RADIUS**2 - aside * aside).clamp(min=0.0).sqrt() - ahead).clamp(min=0.0)


def press(
    x: Tensor,
    y: Tensor,
    fuel: Tensor,
    goal_x: Tensor,
    goal_y: Tensor,
    dir_x: Tensor,
    dir_y: Tensor,
    duration: Tensor,
    *,
    strength: Tensor | float = 1.0,
    glide: Tensor | float = 1.0,
) -> Press:
    """Press a key for `duration` seconds and glide until the first event.

    Args:
        x, y: position of the boat, at rest, px from the harbour's centre, `[*B]`.
        fuel: seconds of pressing left in the tank, `[*B]`.
        goal_x, goal_y: centre of the dock, px from the harbour's centre, `[*B]`.
        dir_x, dir_y: unit direction of the key, `[*B]`.
        duration: seconds in [0, MAX_DURATION], `[*B]`. The press ends early if the tank is empty.
        strength: factor above 0 of the speed while the key is down, `[*B]` or a number.
        glide: factor above 0 of the length and the duration of the glide, `[*B]` or a number.

    Returns:
        The position at the event or at rest, the fuel left (s), the speed (px/s) at the end of the acceleration, and
        the outcome (int32). The acceleration ends with the key's release, an empty tank or the event. A boat at rest
        with fuel left is SAILING.
    """
    duration = torch.minimum(duration, fuel)
    pressed = strength * pressed_distance(duration)
    stretch = GLIDE * glide
    total = (1.0 + stretch) * pressed
    to_dock = distance_to_dock(x, y, goal_x, goal_y, dir_x, dir_y)
    to_harbour = distance_to_harbour(x, y, dir_x, dir_y)
    docks = (to_dock <= total) & (to_dock <= to_harbour)
    leaves = (to_harbour < total) & ~docks
    travelled = torch.where(docks, to_dock, torch.where(leaves, to_harbour, total))

    # `virtual` is the time on the speed curve. It grows to `duration` while the key is down, and falls back to 0 in the
    # glide.
    in_glide = travelled > pressed
    virtual = duration_for(torch.where(in_glide, (total - travelled) / stretch, travelled) / strength)
    virtual = torch.minimum(virtual, duration)
    burnt = torch.where(in_glide, duration, virtual)
    left = fuel - burnt
    left = torch.where(left > DRY, left, 0.0)

    docked = torch.where(strength * speed(virtual) <= DOCKING_SPEED, SUCCESS, TOO_FAST)
    rested = torch.where(left > 0.0, SAILING, OUT_OF_FUEL)
    outcome = torch.where(docks, docked, torch.where(leaves, OUT_OF_BOUNDS, rested)).to(torch.int32)
    return Press(x + travelled * dir_x, y + travelled * dir_y, left, strength * speed(burnt), outcome)
