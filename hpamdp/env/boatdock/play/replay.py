"""The game as people play it: keys may be pressed and released at any time, and a new press ends the previous one.

In the environment a press lasts until the boat is at rest again. In people's game the next key may be pressed while the
boat still glides, or while another key is down. That ends the previous press and its glide, and the boat starts again
from rest where it is. A press that begins and ends at the same reading of the clock does not count.

Sessions with unknown boats (`hpamdp.env.boatdock_unseen`) have a shortest press. A key that is released earlier stays
down until then, and the next key counts only from then on.

The page's script `page/physics.js` has the same functions, and a test compares them. Positions are px from the
harbour's centre, times are seconds since the boat was chosen, and all computations are in float64.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor

from hpamdp.env.boatdock import physics
from hpamdp.env.boatdock.task import MAX_PRESSES

DOWN, UP, BLUR = "down", "up", "blur"
# The duration of a press that is not over yet.
HELD = float("inf")


class Press(NamedTuple):
    """A settled press: its key (0 to 2), its beginning (s), and how long the key was down (s)."""

    key: int
    start: float
    duration: float


class Replay(NamedTuple):
    """The course of E replayed episodes.

    Attributes:
        x, y: position at the beginning of each press, `[E, T]`.
        burnt: seconds for which each press burnt fuel, `[E, T]`. Burning ends with the release of the key, an empty
            tank or the end of the episode.
        end_x, end_y: last position of the boat, `[E]`.
        fuel: seconds of fuel left, `[E]`.
        outcome: outcome as in `physics`, int32 `[E]`. It is SAILING if the boat rests with fuel left.
        ended: time at which the episode ended or the boat came to rest, s, `[E]`.
        num_presses: number of presses up to the end of the episode, int64 `[E]`.
    """

    x: Tensor
    y: Tensor
    burnt: Tensor
    end_x: Tensor
    end_y: Tensor
    fuel: Tensor
    outcome: Tensor
    ended: Tensor
    num_presses: Tensor


def settle(events: Iterable[tuple[float, str, int]], shortest: float = 0.0, longest: float = HELD) -> list[Press]:
    """Return the presses that follow from raw key events.

    Only one key is down at a time. A press ends with the release of its key, with the next key, or with a blur.

    Args:
        events: time (s), kind (DOWN, UP or BLUR) and key, in ascending order of time. The key of a BLUR is ignored.
        shortest: seconds that a press lasts at least. The next one begins only then; if its key is released before, it
            does not count.
        longest: seconds that a press lasts at most.

    Returns:
        At most MAX_PRESSES presses. If the last key is still down, its press lasts `longest` seconds.
    """
    presses: list[Press] = []
    open_key, begun = -1, 0.0

    def close(time: float) -> None:
        if open_key >= 0 and time > begun:
            presses.append(Press(open_key, begun, min(max(time - begun, shortest), longest)))

    for time, kind, key in events:
        if kind == DOWN:
            close(time)
            open_key, begun = key, max(time, presses[-1].start + shortest) if presses else time
        elif kind == BLUR or key == open_key:
            close(time)
            open_key = -1
    close(HELD)
    return presses[:MAX_PRESSES]


def replay(
    start: Tensor,
    goal: Tensor,
    directions: Tensor,
    keys: Tensor,
    starts: Tensor,
    durations: Tensor,
    *,
    strength: Tensor | float = 1.0,
    glide: Tensor | float = 1.0,
) -> Replay:
    """Replay E episodes from their settled presses.

    Args:
        start, goal: positions of start and goal, float64 `[E, 2]`.
        directions: unit directions of the keys of each boat, float64 `[E, 3, 2]`.
        keys: key of each press, int64 `[E, T]`.
        starts: beginning of each press, s, ascending, `[E, T]`. It is `inf` past an episode's last press.
        durations: duration of each press, s, `[E, T]`.
        strength, glide: factors of each boat's speed and glide, see `physics`, float64 `[E]` or a number.
    """
    (x, y), (goal_x, goal_y) = start.unbind(-1), goal.unbind(-1)
    fuel = torch.full_like(x, physics.TANK)
    row = torch.arange(len(x))
    outcome = torch.full_like(row, physics.SAILING, dtype=torch.int32)
    ended = torch.zeros_like(x)
    num_presses = torch.zeros_like(row)
    following = torch.cat([starts[:, 1:], torch.full_like(x, HELD).unsqueeze(-1)], 1)
    columns: list[tuple[Tensor, Tensor, Tensor]] = []
    for i in range(keys.shape[1]):
        is_pressed = (outcome == physics.SAILING) & starts[:, i].isfinite()
        dir_x, dir_y = directions[row, keys[:, i]].unbind(-1)
        duration = torch.minimum(durations[:, i], fuel)
        whole = physics.press(x, y, fuel, goal_x, goal_y, dir_x, dir_y, duration, strength=strength, glide=glide)
        length = (whole.x - x) * dir_x + (whole.y - y) * dir_y
        seconds = physics.time_at(duration, length, strength, glide)
        # After the tank has run dry, a new press has no fuel, so it cannot interrupt the last glide.
        is_last = (whole.outcome == physics.OUT_OF_FUEL) | (i + 1 == MAX_PRESSES)
        available = following[:, i] - starts[:, i]
        is_cut = (available < seconds) & ~is_last
        way = torch.where(is_cut, physics.distance_at(duration, available, strength, glide), length)
        columns.append((x, y, torch.where(is_cut, duration, fuel - whole.fuel) * is_pressed))
        out_of_time = (whole.outcome == physics.SAILING) & (i + 1 == MAX_PRESSES)
        became = torch.where(out_of_time, physics.TIME_LIMIT, whole.outcome).to(torch.int32)
        x = torch.where(is_pressed, torch.where(is_cut, x + way * dir_x, whole.x), x)
        y = torch.where(is_pressed, torch.where(is_cut, y + way * dir_y, whole.y), y)
        fuel = torch.where(is_pressed, torch.where(is_cut, fuel - duration, whole.fuel), fuel)
        outcome = torch.where(is_pressed & ~is_cut, became, outcome)
        ended = torch.where(is_pressed, starts[:, i] + torch.minimum(seconds, available), ended)
        num_presses = num_presses + is_pressed
    if not columns:
        columns.append((x[:0], y[:0], x[:0]))
    begun_x, begun_y, burnt = (torch.stack(column, -1) for column in zip(*columns, strict=True))
    return Replay(begun_x, begun_y, burnt, x, y, fuel, outcome, ended, num_presses)
