"""The recording as a data set to learn from: the presses that fit an environment, in its keys."""

from __future__ import annotations

from pathlib import Path

import torch
from pydantic import PositiveInt
from tensordict import TensorDict

from hpamdp.data.demonstrations import Demonstrations
from hpamdp.data.human import played_file
from hpamdp.data.human.episodes import select
from hpamdp.data.human.released_file import HumanData, read
from hpamdp.data.human.rest_to_rest import to_rest_to_rest
from hpamdp.data.human.transitions import decisions, transitions
from hpamdp.env.boatdock import harbour
from hpamdp.env.boatdock.environment import BoatDockEnv


class HumanDemonstrations(Demonstrations):
    """The presses of the selected episodes, as the given environment would have returned them.

    Where the environment has a fixed key map, each key is replaced by the one that pushes the boat in the same
    direction under that key map. Where it has a fixed controller, only the episodes with this controller are taken.

    Selectors learn from the episodes as they were recorded, with their outcomes and the fuel that was left, whatever
    the log of their presses misses and `rest_to_rest` leaves out.

    Args:
        env: the boat-docking environment, which determines controller, key map, reward and observation.
        path: the released file; None: `released_file.default_path`.
        checksum: the SHA-256 that the file must have; None: any.
        complete, successes, best_people: which episodes, as in `hpamdp.data.human.episodes.select`.
        rest_to_rest: whether to convert the recorded presses to rest-to-rest presses; see
            `hpamdp.data.human.rest_to_rest`.

    Raises:
        ValueError: `env` is not a boat-docking environment.
        DataError: the file is missing or not the right one, or no episode is left.
    """

    def __init__(
        self,
        env: object,
        *,
        path: str | None,
        checksum: str | None,
        complete: bool,
        successes: bool,
        best_people: PositiveInt | None,
        rest_to_rest: bool,
    ) -> None:
        boats = _boats(env)
        data = select(
            read(None if path is None else Path(path), checksum=checksum, one_frame=True),
            complete=complete,
            successes=successes,
            best_people=best_people,
            controller=_controller_of(boats),
        )
        rows, recorded = _as_returned(data, boats, rest_to_rest=rest_to_rest)
        super().__init__(rows, boats.device, decisions=recorded)


class PlayedDemonstrations(Demonstrations):
    """The presses of episodes that were played in the page of `hpamdp play`, otherwise as in `HumanDemonstrations`.

    Args:
        env: the boat-docking environment, which determines controller, key map, reward and observation.
        path: the file of episodes.
        practice: whether the episodes of practice count, too.
        successes, best_people, rest_to_rest: as in `HumanDemonstrations`.

    Raises:
        ValueError: `env` is not a boat-docking environment.
        DataError: the file is missing or damaged, or no episode is left.
    """

    def __init__(
        self,
        env: object,
        *,
        path: str,
        practice: bool,
        successes: bool,
        best_people: PositiveInt | None,
        rest_to_rest: bool,
    ) -> None:
        boats = _boats(env)
        data = select(
            played_file.read(path, practice=practice),
            successes=successes,
            best_people=best_people,
            controller=_controller_of(boats),
        )
        rows, recorded = _as_returned(data, boats, rest_to_rest=rest_to_rest)
        super().__init__(rows, boats.device, decisions=recorded)


def _boats(env: object) -> BoatDockEnv:
    if not isinstance(env, BoatDockEnv):
        raise ValueError("people docked boats; use env=boatdock or data=none")
    if not env.rules.are_peoples:
        raise ValueError(
            "people kept one of their two boats; use data=none, or leave out env.boats and env.switch_cost"
        )
    return env


def _controller_of(env: BoatDockEnv) -> str | None:
    return env.rules.controller if env.rules.controller in harbour.CONTROLLERS else None


def _as_returned(data: HumanData, env: BoatDockEnv, *, rest_to_rest: bool) -> tuple[TensorDict, TensorDict | None]:
    """Return the transitions and, where the agent chooses, the decisions, as the environment would have them."""
    rules = env.rules
    recorded = decisions(data, reward=rules.reward, observation=rules.observation) if env.has_choice else None
    if rest_to_rest:
        data = to_rest_to_rest(data)
    if isinstance(rules.keymap, int):
        data = with_keymap(data, rules.keymap)
    rows = transitions(data, reward=rules.reward, observation=rules.observation, has_choice=env.has_choice)
    return rows, recorded


def with_keymap(data: HumanData, keymap: int) -> HumanData:
    """Return the recording under one key map: each press has the key that pushes the boat in the same direction."""
    episodes = data.episodes[data.presses["episode"]]  # the episode of each press
    controller = episodes["controller"].int()
    recorded_key = data.presses["key"].int()
    recorded = torch.stack(harbour.direction(controller, episodes["keymap"].int(), recorded_key), -1)
    every_key = torch.arange(harbour.NUM_KEYS, dtype=torch.int32).expand(len(recorded_key), -1)
    same_controller = controller.unsqueeze(1).expand_as(every_key)
    new_keymap = torch.full_like(every_key, keymap)
    available = torch.stack(harbour.direction(same_controller, new_keymap, every_key), -1)
    key = (available * recorded.unsqueeze(1)).sum(-1).argmax(1)
    converted = data.episodes.clone()
    converted["keymap"] = torch.full_like(converted["keymap"], keymap)
    return HumanData(converted, data.presses.clone().set("key", key))
