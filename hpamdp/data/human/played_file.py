"""Episodes that were played on a page (`hpamdp play`), read into the tables of the recording of 40 people.

Differences from that recording:
- Every press is logged, so all episodes are complete.
- An interrupted press has its duration until the interruption.
- `person` numbers the players in their order in the file.
- `tank` is the fuel in whole ticks.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from hpamdp.data import DataError
from hpamdp.data.human.released_file import EPISODES_PER_BLOCK, TICKS_PER_SECOND, HumanData, table
from hpamdp.data.human.schema import GAS_SECONDS
from hpamdp.env.boatdock import harbour, physics
from hpamdp.env.boatdock.play import episodes as played
from hpamdp.env.boatdock.play.episodes import Episode
from hpamdp.env.play_page import EpisodeError

SUFFIX = ".jsonl"


def read(path: Path | str, *, practice: bool = False) -> HumanData:
    """Read a file of played episodes. Lines without a valid episode are left out, with a warning.

    Args:
        path: a file written by `hpamdp play` or downloaded from its page.
        practice: whether practice episodes also count.

    Raises:
        DataError: the file cannot be read, or no episode counts.
    """
    try:
        read_episodes = played.read(Path(path)).values()
    except EpisodeError as error:
        raise DataError(str(error)) from error
    counted = [episode for episode in read_episodes if practice or episode.mode != played.PRACTICE]
    if not counted:
        raise DataError(f"{path}: no episode{' except practice' if read_episodes else ''}")
    return _tables(counted)


def verify(path: Path | str) -> int:
    """Check every line of a file by its raw events, as the page's server does, and return the number of episodes.

    Raises:
        DataError: the file cannot be read, or a line holds no valid episode or repeats an earlier one.
    """
    try:
        found, problems = played.read_with_problems(Path(path))
    except EpisodeError as error:
        raise DataError(str(error)) from error
    if problems:
        number, problem = min(problems.items())
        raise DataError(f"{path}, line {number}: {problem}; {len(found)} of {len(found) + len(problems)} are valid")
    return len(found)


def _tables(episodes: list[Episode]) -> HumanData:
    sailed = played.sail(episodes)
    outcome = np.array([physics.OUTCOMES.index(episode.outcome) for episode in episodes])
    players = list(dict.fromkeys(episode.player for episode in episodes))
    person = np.array([players.index(episode.player) for episode in episodes])
    num_presses = np.array([len(episode.presses) for episode in episodes])
    number = np.repeat(np.arange(len(episodes)), num_presses)
    press = np.arange(len(number)) - np.repeat(np.cumsum(num_presses) - num_presses, num_presses)
    is_final = press == num_presses[number] - 1
    centre = np.array(harbour.CENTRE)
    begun = torch.stack([sailed.x, sailed.y], -1).numpy()[number, press] + centre
    following = np.full_like(begun, np.nan)
    following[~is_final] = begun[np.flatnonzero(~is_final) + 1]
    duration = np.array([each.duration for episode in episodes for each in episode.presses])
    goal = np.array([episode.goal for episode in episodes]) + centre
    elapsed = np.array([t for episode in episodes for t in np.cumsum([each.duration for each in episode.presses])])
    index = _count(person)
    return HumanData(
        table(
            len(episodes),
            person=person,
            index=index,
            block=index // EPISODES_PER_BLOCK,
            controller=np.array([harbour.CONTROLLERS.index(episode.controller) for episode in episodes]),
            keymap=np.array([episode.keymap for episode in episodes]),
            presses=num_presses,
            outcome=outcome,
            tank=np.rint(_numpy(sailed.fuel) * TICKS_PER_SECOND).astype(np.int64),
            complete=np.ones(len(episodes), bool),
            start=np.array([episode.start for episode in episodes]) + centre,
            goal=goal,
            centre=np.tile(centre, (len(episodes), 1)),
        ),
        table(
            len(number),
            episode=number,
            press=press,
            is_final=is_final,
            position=begun,
            next_position=following,
            key=np.array([each.key for episode in episodes for each in episode.presses]),
            duration=duration,
            speed=_numpy(physics.speed(torch.from_numpy(duration))),
            distance=np.linalg.norm(goal[number] - begun, axis=1),
            gas=1.0 - elapsed / GAS_SECONDS,
        ),
    )


def _numpy(values: Tensor) -> np.ndarray:
    return values.double().numpy()


def _count(person: np.ndarray) -> np.ndarray:
    """Return the number of each episode among its person's episodes, in the order of the file."""
    index = np.zeros_like(person)
    for each in np.unique(person):
        index[person == each] = np.arange((person == each).sum())
    return index
