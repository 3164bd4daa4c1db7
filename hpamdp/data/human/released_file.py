"""The released recording of people at the task: read, checked, and put into two tables.

The file is `BDtrajectory40.mat`, released with *A Benchmark for Hierarchical Parameterized Action Markov Decision
Process* (MIT licence): 40 people, 360 episodes each. What a user should know of it (`QUIRKS` says it in one place):
the log drops presses that overlapped another, so only a twentieth of the episodes are completely logged.
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

from hpamdp.data.human import schema
from hpamdp.data.human.errors import HumanDataError
from hpamdp.data.human.matfile import read_variable
from hpamdp.env.boatdock import harbour, physics

FILE_NAME = "BDtrajectory40.mat"
SHA256 = "9de16874b43de9e377c2c10749cb2bd435a6db3ca7cead445b826d64ec399d20"
PATH_VARIABLE = "HPAMDP_HUMAN_DATA"  # environment variable with the file's path

FRAMES_A_SECOND = 60
FULL_TANK = int(physics.TANK * FRAMES_A_SECOND)
EPISODES_A_BLOCK = 60
_LOG_TOLERANCE = 2.5  # frames by which tank and logged presses may differ in a complete log
_MAX_BYTES = 64 * 2**20  # of a file that is read at all; the released one has 4 million

# The file's outcomes 1 to 4, as the environment numbers them.
_OUTCOMES = np.array([physics.OUT_OF_FUEL, physics.SUCCESS, physics.TOO_FAST, physics.OUT_OF_BOUNDS])

QUIRKS = (
    "A press's next position is where the next logged press began: the boat may still have been gliding.",
    "An episode's final press has no next position (NaN here); where a single press was logged, `obs` is empty.",
    "Presses that overlapped another are not logged; in some episodes not even the first or the only one.",
    "`gas` (1 - sum of x / 5) ignores the presses that are not logged; `tank` (frames left of 360) counts them.",
    "`complete` marks the episodes whose log agrees with the tank: |tank + 60 x sum of x - 360| <= 2.5 frames.",
)


class HumanData(NamedTuple):
    """What people did: one row an episode, one row a logged press. Lengths are screen px (y points down).

    episodes `[E]`: `person`, `index` (of the person's episodes), `block` (of 60), `controller` (0 incongruent,
    1 congruent), `keymap` (1 or 2), `presses` (logged), `outcome` (as `physics.OUTCOMES`), `tank` (frames left of 360),
    all int64; `complete` bool; `start`, `goal`, `centre` `[E, 2]`.

    presses `[N]`, the transitions: `episode` (row of the other table), `press` (its number in the episode), `key`
    int64; `is_final` bool; `position`, `next_position` `[N, 2]` (where this press and the next began, the latter NaN
    where the press is final); `duration` (s), `speed` (px/s, at release), `distance` (to the goal, when the press
    began), `gas`, float32.
    """

    episodes: TensorDict
    presses: TensorDict


def default_path() -> Path:
    """Return where the file is expected: what the environment variable says, else the user's cache."""
    given = os.environ.get(PATH_VARIABLE)
    return Path(given) if given else user_cache_path("hpamdp") / FILE_NAME


def read(path: Path | str | None = None, *, checksum: str | None = SHA256, one_frame: bool = False) -> HumanData:
    """Read the released file, or another of the same schema.

    Args:
        path: the file; None: `default_path`.
        checksum: the SHA-256 that the file must have; None: any, so long as its contents fit together.
        one_frame: move every position so that all harbours have the environment's centre, (640, 512); half the
            people saw theirs at (672, 504).

    Raises:
        HumanDataError: there is no such file, it is not the one that was released, or its contents don't fit together.
    """
    path = default_path() if path is None else Path(path)
    data = load_bytes(path)
    if checksum is not None:
        check_sum(data, checksum, path)
    try:
        columns = schema.columns(read_variable(data, "trajectories"))
        schema.check(columns)
    except HumanDataError as error:
        raise HumanDataError(f"{path}: {error}") from error
    return _tables(columns, one_frame)


def load_bytes(path: Path) -> bytes:
    """Return a file's bytes, unless there are too many for a recording."""
    try:
        size = path.stat().st_size
        if size > _MAX_BYTES:
            raise HumanDataError(f"{path}: {size} bytes; a recording has at most {_MAX_BYTES}")
        return path.read_bytes()
    except FileNotFoundError as error:
        raise HumanDataError(
            f"{path}: there is no such file; set {PATH_VARIABLE} to the path of {FILE_NAME}, or get it with "
            "`python -m hpamdp.data.human download --url URL`"
        ) from error
    except OSError as error:
        raise HumanDataError(f"{path}: cannot be read ({error.strerror})") from error


def check_sum(data: bytes, checksum: str, path: Path) -> None:
    """Raise HumanDataError unless the bytes have this SHA-256."""
    found = hashlib.sha256(data).hexdigest()
    if found != checksum:
        raise HumanDataError(
            f"{path}: SHA-256 {found[:12]}… ({len(data)} bytes), but the released file has {checksum[:12]}…; "
            "it is truncated, altered or another file"
        )


def _tables(columns: schema.Columns, one_frame: bool) -> HumanData:
    """Put checked columns into the two tables."""
    num = columns.num_presses
    episode = np.repeat(np.arange(len(num)), num)
    first = np.cumsum(num) - num
    press = np.arange(len(episode)) - first[episode]
    is_final = press == num[episode] - 1
    fields = columns.fields
    shift = np.array(harbour.CENTRE) - fields["center"] if one_frame else np.zeros_like(fields["center"])
    duration = fields["actions"].sum(1)
    burnt = np.bincount(episode, duration, minlength=len(num)) * FRAMES_A_SECOND
    tank = fields["tank"][:, 0]
    nowhere = np.full((len(episode), 2), np.nan)
    nowhere[~is_final] = fields["next_obs"]

    def table(size: int, **values: np.ndarray) -> TensorDict:
        single = {np.dtype(np.float64): np.float32}
        arrays = {k: v.astype(single.get(v.dtype, v.dtype)) for k, v in values.items()}
        return TensorDict({k: torch.from_numpy(v) for k, v in arrays.items()}, batch_size=[size])

    episodes = table(
        len(num),
        person=columns.person,
        index=columns.index,
        block=columns.index // EPISODES_A_BLOCK,
        controller=fields["boatchoice"][:, 0].astype(np.int64),
        keymap=fields["incongkm"][:, 0].astype(np.int64),
        presses=num,
        outcome=_OUTCOMES[fields["outcome"][:, 0].astype(np.int64) - 1],
        tank=tank.astype(np.int64),
        complete=np.abs(tank + burnt - FULL_TANK) <= _LOG_TOLERANCE,
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
        next_position=nowhere + shift[episode],
        key=fields["actions"].argmax(1),
        duration=duration,
        speed=schema.SPEED_UNIT * fields["velocity"].sum(1),
        distance=fields["distance"][:, 0],
        gas=fields["gas"][:, 0],
    )
    return HumanData(episodes, presses)
