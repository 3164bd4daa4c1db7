"""The schema of the released file: the fields of an episode."""

from __future__ import annotations

from collections.abc import Iterator
from io import BytesIO
from typing import NamedTuple

import numpy as np

from hpamdp.data import DataError
from hpamdp.messages import first_line

SPEED_UNIT = 10.0  # px/s of the column `velocity`
GAS_SECONDS = 5.0  # logged seconds at which the column `gas` is 0; the tank itself has 6

# The fields, and how many numbers each has per press, per non-final press or per episode. `terminals` has one number
# per press, and one in an episode without a press.
_PER_PRESS = {"actions": 3, "velocity": 3, "gas": 1, "distance": 1}
_PER_NON_FINAL_PRESS = {"obs": 2, "next_obs": 2}
_PER_EPISODE = {"center": 2, "SG": 4, "R": 1, "outcome": 1, "boatdir": 6, "boatchoice": 1, "incongkm": 1, "tank": 1}
_WIDTHS = {**_PER_PRESS, **_PER_NON_FINAL_PRESS, **_PER_EPISODE, "terminals": 1}
# The codes that stand for an outcome, a controller and a key map.
_CODES = {"outcome": (1, 2, 3, 4), "boatchoice": (0, 1), "incongkm": (1, 2)}


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
        DataError: the file is damaged or has another structure, or a field is missing or has the wrong size
            or an unknown code.
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
    for name, codes in _CODES.items():
        if not np.isin(stacked[name], codes).all():
            raise DataError(f"{name} is not {' or '.join(map(str, codes))} in every episode")
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
