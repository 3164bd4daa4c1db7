"""The schema of the released file: which fields an episode has, and what must hold between them.

The recording says much of it twice, so a damaged file rarely fits together: distances follow from positions, speeds and
`gas` from durations, the directions of the keys from controller and key map.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch

from hpamdp.data.human.errors import HumanDataError
from hpamdp.data.human.matfile import MatArray, some
from hpamdp.env.boatdock import harbour, physics

SPEED_UNIT = 10.0  # px/s of the column `velocity`
_DIRECTION_UNIT = 10.0
_GAS_SECONDS = 5.0
_EXACT = 1e-6  # px, s: what is said twice agrees to rounding
_MAX_OVERBURN = 15.0  # frames that presses may take beyond what the tank lost; in the released file 10.9

# Numbers for every press, every non-final press, and every episode.
_A_PRESS = {"actions": 3, "velocity": 3, "gas": 1, "distance": 1}
_A_NON_FINAL_PRESS = {"obs": 2, "next_obs": 2}
_AN_EPISODE = {"center": 2, "SG": 4, "R": 1, "outcome": 1, "boatdir": 6, "boatchoice": 1, "incongkm": 1, "tank": 1}
_FIELDS = {*_A_PRESS, *_A_NON_FINAL_PRESS, *_AN_EPISODE, "terminals"}


class Columns(NamedTuple):
    """All episodes' fields one below another, `fields[name]` `[rows, width]`; the rest int64 `[E]`."""

    person: np.ndarray
    index: np.ndarray
    num_presses: np.ndarray
    fields: dict[str, np.ndarray]


def columns(trajectories: MatArray) -> Columns:
    """Return the columns of the variable `trajectories`: cells of people, of cells of episodes, of one struct each.

    Raises:
        HumanDataError: it is something else, or a field has the wrong size.
    """
    gathered: dict[str, list[np.ndarray]] = {name: [] for name in sorted(_FIELDS)}
    rows = []
    for person, cell in enumerate(trajectories.cells()):
        for index, episode in enumerate(cell.cells()):
            try:
                fields = {name: array.numbers() for name, array in episode.fields().items()}
                rows.append((person, index, _num_presses(fields)))
            except HumanDataError as error:
                raise HumanDataError(f"person {person}, episode {index}: {error}") from error
            for name, values in gathered.items():
                values.append(fields[name])
    if not rows:
        raise HumanDataError("there are no episodes in it")
    person, index, num_presses = np.array(rows, np.int64).T
    widths = {**_A_PRESS, **_A_NON_FINAL_PRESS, **_AN_EPISODE, "terminals": 1}
    stacked = {name: np.concatenate(values).reshape(-1, widths[name]) for name, values in gathered.items()}
    return Columns(person, index, num_presses, stacked)


def _num_presses(fields: dict[str, np.ndarray]) -> int:
    """Return how many presses an episode has, once its fields are the right ones and have the right sizes."""
    if set(fields) != _FIELDS:
        raise HumanDataError(f"the fields are {some(sorted(fields))}")
    num = len(fields["gas"])
    sizes = {
        **{name: width * num for name, width in _A_PRESS.items()},
        **{name: width * max(num - 1, 0) for name, width in _A_NON_FINAL_PRESS.items()},
        **_AN_EPISODE,
        "terminals": max(num, 1),
    }
    for name, size in sizes.items():
        if len(fields[name]) != size:
            raise HumanDataError(f"{name} has {len(fields[name])} numbers, but {size} belong to {num} presses")
    return num


def positions(columns: Columns) -> np.ndarray:
    """Return where each press began, px, `[N, 2]`.

    Of a final press the file says only where the one before it ended, and of a single one nothing: it began at the
    start.
    """
    num = columns.num_presses
    where = np.empty((num.sum(), 2))
    last = np.cumsum(num) - 1
    is_final = np.zeros(len(where), bool)
    is_final[last[num > 0]] = True
    where[~is_final] = columns.fields["obs"]
    where[last[num > 1]] = columns.fields["next_obs"][np.cumsum(np.maximum(num - 1, 0))[num > 1] - 1]
    where[last[num == 1]] = columns.fields["SG"][num == 1][:, [0, 2]]
    return where


def check(columns: Columns) -> None:
    """Check that the columns fit together.

    Raises:
        HumanDataError: a rule is broken; it names the first episode that breaks it.
    """
    for name, values in columns.fields.items():
        if not np.isfinite(values).all():
            raise HumanDataError(f"{name} has numbers that are not finite")
    num = columns.num_presses
    episode = np.repeat(np.arange(len(num)), num)
    for rules, of in ((_episode_rules, np.arange(len(num))), (_press_rules, episode)):
        for rule, holds in rules(columns, episode):
            if not holds.all():
                row = of[np.argmin(holds)]
                raise HumanDataError(f"person {columns.person[row]}, episode {columns.index[row]}: {rule}")


def _is_one_of(values: np.ndarray, *allowed: float) -> np.ndarray:
    return np.isin(values[:, 0], allowed)


def _episode_rules(columns: Columns, episode: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Yield what must hold for every episode, and whether it does, `[E]`."""
    f = columns.fields
    yield "R is not the harbour's radius, 120 px", f["R"][:, 0] == physics.HARBOUR_RADIUS
    yield "outcome is not 1, 2, 3 or 4", _is_one_of(f["outcome"], 1, 2, 3, 4)
    yield "boatchoice is not 0 or 1", _is_one_of(f["boatchoice"], 0, 1)
    yield "incongkm is not 1 or 2", _is_one_of(f["incongkm"], 1, 2)
    yield "tank is no number of frames from 0 to 360", _is_one_of(f["tank"], *range(361))
    last = np.cumsum(np.maximum(columns.num_presses, 1)) - 1
    marks = np.add.reduceat(f["terminals"][:, 0] != 0, last - np.maximum(columns.num_presses, 1) + 1)
    yield "terminals does not mark the final press alone", (f["terminals"][last, 0] == 1) & (marks == 1)
    yield "center is not on the screen", ((f["center"] >= 0) & (f["center"] <= 10_000)).all(1)
    x, y = directions(f["boatchoice"][:, 0], f["incongkm"][:, 0])
    error = np.abs(f["boatdir"] - _DIRECTION_UNIT * np.stack([x, y], 2).reshape(-1, 6)).max(1)
    yield "boatdir are not the directions of this controller and key map", error < _EXACT
    start, goal = f["SG"][:, [0, 2]], f["SG"][:, [1, 3]]
    for name, point in (("start", start), ("goal", goal)):
        from_centre = np.linalg.norm(point - f["center"], axis=1)
        yield f"the {name} is not within 110 px of the harbour's centre", from_centre <= harbour.LAYOUT_RADIUS + _EXACT
    apart = np.linalg.norm(start - goal, axis=1)
    yield "start and goal are not 30 px apart", apart >= harbour.MIN_SEPARATION - _EXACT
    burnt = np.bincount(episode, f["actions"].sum(1), minlength=len(apart))
    yield "its presses burn more than the tank lost", f["tank"][:, 0] + 60 * burnt <= 360 + _MAX_OVERBURN


def directions(controller: np.ndarray, keymap: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the unit directions (x, y) of the three keys, each `[E, 3]`."""
    boat = torch.from_numpy(controller.astype(np.int64))[:, None]
    keys = torch.from_numpy(keymap.astype(np.int64))[:, None]
    x, y = harbour.direction(boat, keys, torch.arange(harbour.NUM_KEYS)[None])
    return x.double().numpy(), y.double().numpy()


def _press_rules(columns: Columns, episode: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Yield what must hold for every press and whether it does, `[N]`."""
    f, num = columns.fields, columns.num_presses
    first = np.cumsum(num) - num
    is_final = np.arange(len(episode)) - first[episode] == num[episode] - 1
    x = f["actions"].sum(1)
    yield "a press has not exactly one key", (f["actions"] != 0).sum(1) == 1
    yield "a press takes no time between 0 and 2 s", (x > 0) & (x <= physics.MAX_DURATION)
    speed = np.where(f["actions"] > 0, 10 * f["actions"] ** 2 - 2 / 3 * f["actions"] ** 3, 0.0)
    yield "a press's velocity does not follow from its time", np.abs(f["velocity"] - speed).max(1) < _EXACT
    elapsed = np.cumsum(x)
    elapsed = elapsed - (elapsed - x)[first[episode]] if len(x) else elapsed
    yield "a press's gas does not follow from the times", np.abs(f["gas"][:, 0] - 1 + elapsed / _GAS_SECONDS) < _EXACT
    where = positions(columns)
    inside = np.linalg.norm(where - f["center"][episode], axis=1) <= physics.HARBOUR_RADIUS
    yield "a press begins outside the harbour", inside
    distance = np.linalg.norm(where - f["SG"][episode][:, [1, 3]], axis=1)
    yield "a press's distance does not follow from its position", np.abs(distance - f["distance"][:, 0]) < _EXACT
    follows = np.ones(len(x), bool)
    is_later = np.flatnonzero(~is_final)
    follows[is_later] = (f["next_obs"] == where[is_later + 1]).all(1)
    yield "a press does not begin where the one before says", follows
