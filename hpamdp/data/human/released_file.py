"""The released recording of people at the task, read into two tables.

The file is `BDtrajectory40.mat`, released with *A Benchmark for Hierarchical Parameterized Action Markov Decision
Process* (MIT licence): 40 people, 360 episodes each. The log drops presses that overlapped another, so only a twentieth
of the episodes are completely logged. `QUIRKS` lists further properties that users should know.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from platformdirs import user_cache_path
from tensordict import TensorDict

from hpamdp.data import DataError
from hpamdp.data.human import schema
from hpamdp.data.human.options import SHA256
from hpamdp.env.boatdock import harbour, physics
from hpamdp.env.boatdock.task import Outcome
from hpamdp.files import read_regular
from hpamdp.messages import reason_of

FILE_NAME = "BDtrajectory40.mat"
PATH_VARIABLE = "HPAMDP_HUMAN_DATA"  # environment variable with the file's path

TICKS_PER_SECOND = 60
FULL_TANK = int(physics.TANK * TICKS_PER_SECOND)
EPISODES_PER_BLOCK = 60
_LOG_TOLERANCE = 2.5  # ticks by which the tank and the logged presses may differ in a complete log
_MAX_BYTES = 64 * 2**20  # larger files are not read; the released one has 4 million

# The file's outcomes 1 to 4.
_OUTCOMES = np.array([Outcome.OUT_OF_FUEL, Outcome.SUCCESS, Outcome.TOO_FAST, Outcome.OUT_OF_BOUNDS])

QUIRKS = (
    "A press's next position is where the next logged press began. The boat may still have been gliding.",
    "An episode's final press has no next position (NaN here). If a single press was logged, `obs` is empty.",
    "Presses that overlapped another are not logged. In some episodes the first or the only press is missing.",
    "`gas` (1 - logged seconds / 5) ignores the missing presses. `tank` (ticks left of 360) counts them.",
    "Outcomes are renumbered, see `hpamdp.env.boatdock.task.Outcome`: 1, 2, 3 and 4 of the file (out of fuel, success, "
    "too fast, out of bounds) are 4, 1, 2 and 3 here.",
    "`complete` marks the episodes whose log agrees with the tank: |tank + 60 x logged seconds - 360| <= 2.5 ticks.",
)


class HumanData(NamedTuple):
    """The recording: a table of episodes and a table of logged presses. Lengths are in screen px (y points down).

    Columns of `episodes` `[E]`:
    - int64: `person`, `index` (number of the person's episode), `block` (of 60 episodes), `controller` (0 incongruent,
      1 congruent), `keymap` (1 or 2), `presses` (number of logged presses), `outcome` (see `Outcome`) and
      `tank` (ticks of fuel left, of 360).
    - bool: `complete`.
    - float32 `[E, 2]`: `start`, `goal` and `centre`.

    Columns of `presses` `[N]`:
    - int64: `episode` (row of `episodes`), `press` (number in the episode) and `key`.
    - bool: `is_final`.
    - float32 `[N, 2]`: `position` and `next_position`, where this press and the next one began. The latter is NaN for a
      final press.
    - float32: `duration` (s), `speed` (px/s, at release), `distance` (to the goal when the press began) and `gas`.
    """

    episodes: TensorDict
    presses: TensorDict


def default_path() -> Path:
    """Return the expected path of the file, from the environment variable or else in the user's cache."""
    path = os.environ.get(PATH_VARIABLE)
    return Path(path) if path else user_cache_path("hpamdp") / FILE_NAME


def read(path: Path | str | None = None, *, checksum: str | None = SHA256, one_frame: bool = False) -> HumanData:
    """Read the released file, or another of the same schema.

    Args:
        path: the file. If None, `default_path`.
        checksum: the SHA-256 that the file must have. If None, any file with these fields is accepted, and its
            numbers are not checked. A damaged file can crash SciPy's reader, so read only files that you trust.
        one_frame: whether to move every position so that all harbours have the environment's centre, (640, 512). Half
            the people saw theirs at (672, 504).

    Raises:
        DataError: the file does not exist, has another checksum, or other fields.
    """
    path = default_path() if path is None else Path(path)
    data = load_bytes(path)
    if checksum is not None:
        check_sum(data, checksum, path)
    try:
        columns = schema.columns(data)
    except DataError as error:
        raise DataError(f"{path}: {error}") from error
    return _tables(columns, one_frame)


def load_bytes(path: Path) -> bytes:
    """Return a file's bytes.

    Raises:
        DataError: the file is missing, unreadable or too large for a recording.
    """
    try:
        return read_regular(path, _MAX_BYTES)
    except FileNotFoundError as error:
        raise DataError(
            f"{path}: there is no such file; set {PATH_VARIABLE} to the path of {FILE_NAME}, or fetch it with "
            "`python -m hpamdp.data.human download --url URL`"
        ) from error
    except OSError as error:
        raise DataError(f"{path}: {reason_of(error)}") from error


def check_sum(data: bytes, checksum: str, path: Path) -> None:
    """Check the SHA-256 of a file's bytes.

    Raises:
        DataError: the checksum differs.
    """
    found = hashlib.sha256(data).hexdigest()
    if found != checksum:
        raise DataError(
            f"{path}: SHA-256 {found[:12]}… ({len(data)} bytes), but the released file has {checksum[:12]}…; "
            "it is truncated, altered or another file"
        )


def _tables(columns: schema.Columns, one_frame: bool) -> HumanData:
    """Return the two tables of checked columns."""
    fields = columns.fields
    num_presses = columns.num_presses
    num_episodes = len(num_presses)
    episode = np.repeat(np.arange(num_episodes), num_presses)
    first = np.cumsum(num_presses) - num_presses
    press = np.arange(len(episode)) - first[episode]
    is_final = press == num_presses[episode] - 1
    shift = np.zeros_like(fields["center"])
    if one_frame:
        shift = np.array(harbour.CENTRE) - fields["center"]
    duration = fields["actions"].sum(1)
    pressed = np.bincount(episode, duration, minlength=num_episodes) * TICKS_PER_SECOND
    tank = fields["tank"][:, 0]
    next_position = np.full((len(episode), 2), np.nan)
    next_position[~is_final] = fields["next_obs"]

    episodes = table(
        num_episodes,
        person=columns.person,
        index=columns.episode_index,
        block=columns.episode_index // EPISODES_PER_BLOCK,
        controller=fields["boatchoice"][:, 0].astype(np.int64),
        keymap=fields["incongkm"][:, 0].astype(np.int64),
        presses=num_presses,
        outcome=_OUTCOMES[fields["outcome"][:, 0].astype(np.int64) - 1],
        tank=tank.astype(np.int64),
        complete=np.abs(tank + pressed - FULL_TANK) <= _LOG_TOLERANCE,
        start=fields["SG"][:, [0, 2]] + shift,
        goal=fields["SG"][:, [1, 3]] + shift,
        centre=fields["center"] + shift,
    )
    presses = table(
        len(episode),
        episode=episode,
        press=press,
        is_final=is_final,
        position=schema.positions(columns) + shift[episode],
        next_position=next_position + shift[episode],
        key=fields["actions"].argmax(1),
        duration=duration,
        speed=schema.SPEED_UNIT * fields["velocity"].sum(1),
        distance=fields["distance"][:, 0],
        gas=fields["gas"][:, 0],
    )
    return HumanData(episodes, presses)


def table(size: int, **columns: np.ndarray) -> TensorDict:
    """Return a table of these columns, with float64 converted to float32."""
    table = TensorDict(batch_size=[size])
    for name, values in columns.items():
        dtype = np.float32 if values.dtype == np.float64 else values.dtype
        table[name] = torch.from_numpy(values.astype(dtype))
    return table
