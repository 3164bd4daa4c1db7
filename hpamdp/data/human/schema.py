"""The schema of the released file: the fields of an episode, and the rules between them.

Much of the recording is redundant, so the rules find most damaged files. Distances follow from positions, speeds and
`gas` from durations, and the directions of the keys from controller and key map.
"""

from __future__ import annotations

from collections.abc import Iterator
from io import BytesIO
from typing import NamedTuple

import numpy as np
import torch

from hpamdp.data.errors import DataError
from hpamdp.env.boatdock import harbour, physics, task
from hpamdp.messages import first_line

SPEED_UNIT = 10.0  # px/s of the column `velocity`
_DIRECTION_UNIT = 10.0
GAS_SECONDS = 5.0  # logged seconds at which the column `gas` is 0; the tank itself has 6
_EXACT = 1e-6  # px, s: tolerance for redundant values, which agree up to rounding
_MAX_OVERBURN = 15.0  # ticks by which the presses may exceed the fuel that the tank lost; 10.9 in the released file

# The fields, and how many numbers each has per press, per non-final press or per episode. `terminals` has one number
# per press, and one in an episode without a press.
_PER_PRESS = {"actions": 3, "velocity": 3, "gas": 1, "distance": 1}
_PER_NON_FINAL_PRESS = {"obs": 2, "next_obs": 2}
_PER_EPISODE = {"center": 2, "SG": 4, "R": 1, "outcome": 1, "boatdir": 6, "boatchoice": 1, "incongkm": 1, "tank": 1}
_WIDTHS = {**_PER_PRESS, **_PER_NON_FINAL_PRESS, **_PER_EPISODE, "terminals": 1}

_Rules = Iterator[tuple[str, np.ndarray]]


class Columns(NamedTuple):
    """The fields of all episodes, one episode after another.

    Attributes:
        person, episode_index: the person of each episode, and the episode's number among that person's, int64 `[E]`.
        num_presses: number of logged presses of each episode, int64 `[E]`.
        fields: numbers of each field, float64 `[rows, width]`.
    """

    person: np.ndarray
    episode_index: np.ndarray
    num_presses: np.ndarray
    fields: dict[str, np.ndarray]


def columns(data: bytes) -> Columns:
    """Return the columns of the variable `trajectories` of a MATLAB file.

    It is a cell array of people. Each person is a cell array of episodes, and each episode is a struct.

    Raises:
        DataError: the file is damaged or has another structure, or a field is missing or has the wrong size.
    """
    try:
        episodes = list(_episodes(data))
    except Exception as error:  # SciPy raises errors of many types
        message = f"{type(error).__name__}: {first_line(error)}"
        raise DataError(f"this is not a MATLAB file with people's trajectories ({message})") from error
    if not episodes:
        raise DataError("the file has no episodes")
    rows: list[tuple[int, int, int]] = []
    for person, index, fields in episodes:
        try:
            rows.append((person, index, _num_presses(fields)))
        except DataError as error:
            raise DataError(f"person {person}, episode {index}: {error}") from error
    people, indices, num_presses = np.array(rows, np.int64).T
    stacked = {
        name: np.concatenate([fields[name] for _, _, fields in episodes]).reshape(-1, _WIDTHS[name])
        for name in sorted(_WIDTHS)
    }
    return Columns(people, indices, num_presses, stacked)


def _episodes(data: bytes) -> Iterator[tuple[int, int, dict[str, np.ndarray]]]:
    """Yield the person, the number and the fields of each episode."""
    from scipy.io import loadmat

    people = loadmat(BytesIO(data), variable_names=["trajectories"])["trajectories"]
    for person, episodes in enumerate(people.ravel("F")):
        for index, episode in enumerate(episodes.ravel("F")):
            # SciPy returns whole numbers as uint8 or uint16, whose differences wrap.
            fields = {name: episode[name].item().ravel("F").astype(np.float64) for name in episode.dtype.names}
            yield person, index, fields


def _num_presses(fields: dict[str, np.ndarray]) -> int:
    """Return the number of presses of an episode.

    Raises:
        DataError: a field is missing or unknown, or has the wrong size.
    """
    if set(fields) != set(_WIDTHS):
        raise DataError(f"the fields are {', '.join(sorted(fields))}")
    num = len(fields["gas"])
    sizes = {
        **{name: width * num for name, width in _PER_PRESS.items()},
        **{name: width * max(num - 1, 0) for name, width in _PER_NON_FINAL_PRESS.items()},
        **_PER_EPISODE,
        "terminals": max(num, 1),
    }
    for name, size in sizes.items():
        if len(fields[name]) != size:
            raise DataError(f"{name} has {len(fields[name])} numbers, but must have {size} for {num} presses")
    return num


def positions(columns: Columns) -> np.ndarray:
    """Return the position at the beginning of each press, px, `[N, 2]`.

    The file has no position for a final press. That press began where the previous press ended. A single press began at
    the start.
    """
    num = columns.num_presses
    position = np.empty((num.sum(), 2))
    final = np.cumsum(num) - 1  # row of each episode's final press
    is_final = np.zeros(len(position), bool)
    is_final[final[num > 0]] = True
    position[~is_final] = columns.fields["obs"]
    last_non_final = np.cumsum(np.maximum(num - 1, 0)) - 1  # row of `next_obs`
    position[final[num > 1]] = columns.fields["next_obs"][last_non_final[num > 1]]
    position[final[num == 1]] = columns.fields["SG"][num == 1][:, [0, 2]]
    return position


def check(columns: Columns) -> None:
    """Check the rules that hold for the released file.

    Raises:
        DataError: a rule is broken. The message names the rule and the first episode that breaks it.
    """
    for name, values in columns.fields.items():
        if not np.isfinite(values).all():
            raise DataError(f"{name} has numbers that are not finite")
    every_episode = np.arange(len(columns.num_presses))
    episode_of_press = np.repeat(every_episode, columns.num_presses)
    _check_rules(columns, _episode_rules(columns, episode_of_press), every_episode)
    _check_rules(columns, _press_rules(columns, episode_of_press), episode_of_press)


def _check_rules(columns: Columns, rules: _Rules, episode_of_row: np.ndarray) -> None:
    for broken, holds in rules:
        if not holds.all():
            episode = episode_of_row[np.argmin(holds)]
            person = columns.person[episode]
            raise DataError(f"person {person}, episode {columns.episode_index[episode]}: {broken}")


def _is_one_of(values: np.ndarray, *allowed: float) -> np.ndarray:
    return np.isin(values[:, 0], allowed)


def _episode_rules(columns: Columns, episode_of_press: np.ndarray) -> _Rules:
    """Yield, for each rule, the message for an episode that breaks it, and which episodes keep it, `[E]`."""
    fields = columns.fields
    yield "R is not the harbour's radius, 120 px", fields["R"][:, 0] == physics.HARBOUR_RADIUS
    yield "outcome is not 1, 2, 3 or 4", _is_one_of(fields["outcome"], 1, 2, 3, 4)
    yield "boatchoice is not 0 or 1", _is_one_of(fields["boatchoice"], 0, 1)
    yield "incongkm is not 1 or 2", _is_one_of(fields["incongkm"], 1, 2)
    yield "tank is not a number of ticks from 0 to 360", _is_one_of(fields["tank"], *range(361))
    num_terminals = np.maximum(columns.num_presses, 1)
    last = np.cumsum(num_terminals) - 1
    num_marked = np.add.reduceat(fields["terminals"][:, 0] != 0, last - num_terminals + 1)
    is_last_marked = fields["terminals"][last, 0] == 1
    yield "terminals does not mark the final press alone", is_last_marked & (num_marked == 1)
    on_screen = (fields["center"] >= 0) & (fields["center"] <= 10_000)
    yield "center is not on the screen", np.all(on_screen, axis=1)
    x, y = directions(fields["boatchoice"][:, 0], fields["incongkm"][:, 0])
    expected = _DIRECTION_UNIT * np.stack([x, y], 2).reshape(-1, 6)
    error = np.abs(fields["boatdir"] - expected).max(1)
    yield "boatdir does not hold the directions of this controller and key map", error < _EXACT
    start = fields["SG"][:, [0, 2]]
    goal = fields["SG"][:, [1, 3]]
    for name, point in (("start", start), ("goal", goal)):
        from_centre = np.linalg.norm(point - fields["center"], axis=1)
        yield f"the {name} is not within 110 px of the harbour's centre", from_centre <= harbour.LAYOUT_RADIUS + _EXACT
    separation = np.linalg.norm(start - goal, axis=1)
    yield "start and goal are less than 30 px apart", separation >= harbour.MIN_SEPARATION - _EXACT
    pressed = np.bincount(episode_of_press, fields["actions"].sum(1), minlength=len(separation))
    yield "the presses take more fuel than the tank lost", fields["tank"][:, 0] + 60 * pressed <= 360 + _MAX_OVERBURN


def directions(controller: np.ndarray, keymap: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the unit directions of the three keys, x and y, each `[E, 3]`."""
    x, y = harbour.direction(
        torch.from_numpy(controller.astype(np.int64)).unsqueeze(1),
        torch.from_numpy(keymap.astype(np.int64)).unsqueeze(1),
        torch.arange(harbour.NUM_KEYS).unsqueeze(0),
    )
    return x.double().numpy(), y.double().numpy()


def _press_rules(columns: Columns, episode_of_press: np.ndarray) -> _Rules:
    """Yield, for each rule, the message for a press that breaks it, and which presses keep it, `[N]`."""
    fields = columns.fields
    actions = fields["actions"]
    num_presses = columns.num_presses
    first = np.cumsum(num_presses) - num_presses
    number = np.arange(len(episode_of_press)) - first[episode_of_press]
    is_final = number == num_presses[episode_of_press] - 1
    duration = actions.sum(1)
    yield "a press does not have exactly one key", (actions != 0).sum(1) == 1
    yield "a press does not take between 0 and 2 s", (duration > 0) & (duration <= physics.MAX_DURATION)
    speed = np.where(actions > 0, task.speed(actions) / SPEED_UNIT, 0.0)
    speed_error = np.abs(fields["velocity"] - speed).max(1)
    yield "a press's velocity does not follow from its time", speed_error < _EXACT
    elapsed = np.cumsum(duration)
    if len(duration):
        elapsed = elapsed - (elapsed - duration)[first[episode_of_press]]
    gas_error = np.abs(fields["gas"][:, 0] - 1 + elapsed / GAS_SECONDS)
    yield "a press's gas does not follow from the times", gas_error < _EXACT
    position = positions(columns)
    from_centre = np.linalg.norm(position - fields["center"][episode_of_press], axis=1)
    yield "a press begins outside the harbour", from_centre <= physics.HARBOUR_RADIUS
    distance = np.linalg.norm(position - fields["SG"][episode_of_press][:, [1, 3]], axis=1)
    distance_error = np.abs(distance - fields["distance"][:, 0])
    yield "a press's distance does not follow from its position", distance_error < _EXACT
    follows = np.ones(len(duration), bool)
    non_final = np.flatnonzero(~is_final)
    follows[non_final] = (fields["next_obs"] == position[non_final + 1]).all(1)
    yield "a press does not begin where the previous one ended", follows
