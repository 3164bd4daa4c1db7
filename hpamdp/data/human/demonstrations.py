"""The recording as a data set to learn from: the presses that fit an environment, in its keys."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

from hpamdp.data import DataError
from hpamdp.data.demonstrations import Demonstrations
from hpamdp.data.human import played_file
from hpamdp.data.human.episodes import select
from hpamdp.data.human.options import CARDS, HumanOptions, PeoplesOptions, PlayedOptions
from hpamdp.data.human.released_file import HumanData, read
from hpamdp.data.human.rest_to_rest import to_rest_to_rest
from hpamdp.data.human.transitions import decisions, transitions
from hpamdp.data.row_checks import PERSON
from hpamdp.env.boatdock import harbour
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.settings import SettingError


class HumanDemonstrations(Demonstrations):
    """The recorded presses of the selected episodes, as the given environment would have returned them.

    If the environment has a fixed key map, each key is replaced by the key that pushes in the same direction under that
    key map. If it has a fixed controller, only the episodes with this controller are taken.

    Selectors learn from all episodes with their recorded outcomes and their recorded remaining fuel. Missing presses
    and `rest_to_rest` do not change that.

    Args:
        env: the boat-docking environment, which determines controller, key map, reward and observation.

    Raises:
        ValueError: `env` is not a boat-docking environment.
        DataError: the file is missing or has another checksum, or no episode or no press is left.
    """

    Options = HumanOptions
    card = CARDS["HumanDemonstrations"]

    def __init__(self, env: object, options: HumanOptions | None = None, **settings: Any) -> None:
        self.options: HumanOptions = HumanOptions.of(options, settings)
        boats = _boats(env)
        path = None if self.options.path is None else Path(self.options.path)
        data = read(path, checksum=self.options.checksum, one_frame=True)
        rows, recorded = _as_returned(data, boats, self.options, complete=self.options.complete)
        super().__init__(rows, boats.device, decisions=recorded, held_out=self.options.held_out)


class PlayedDemonstrations(Demonstrations):
    """The presses of episodes that were played on the page of `hpamdp play`. Otherwise as `HumanDemonstrations`.

    Args:
        env: the boat-docking environment, which determines controller, key map, reward and observation.

    Raises:
        ValueError: `env` is not a boat-docking environment.
        DataError: the file is missing or damaged, or no episode or no press is left.
    """

    Options = PlayedOptions
    card = CARDS["PlayedDemonstrations"]

    def __init__(self, env: object, options: PlayedOptions | None = None, **settings: Any) -> None:
        self.options: PlayedOptions = PlayedOptions.of(options, settings)
        boats = _boats(env)
        data = played_file.read(self.options.path, practice=self.options.practice)
        rows, recorded = _as_returned(data, boats, self.options)
        super().__init__(rows, boats.device, decisions=recorded, held_out=self.options.held_out)


def _boats(env: object) -> BoatDockEnv:
    if not isinstance(env, BoatDockEnv):
        raise SettingError("people docked boats; use env=boatdock or data=none")
    if not env.options.are_peoples:
        raise SettingError(
            "people kept one of their two controllers; use data=none, or leave out env.boats and env.switch_cost"
        )
    return env


def _controller_of(env: BoatDockEnv) -> str | None:
    return env.options.controller if env.options.controller in harbour.CONTROLLERS else None


def _as_returned(
    data: HumanData, env: BoatDockEnv, options: PeoplesOptions, *, complete: bool = False
) -> tuple[TensorDict, TensorDict | None]:
    """Return the transitions and, if the agent chooses, the decisions, as the environment would return them."""
    rules = env.options
    data = select(
        data,
        complete=complete,
        successes=options.successes,
        people=options.people,
        best_people=options.best_people,
        worst_people=options.worst_people,
        presses=options.presses,
        controller=_controller_of(env),
    )
    recorded = None
    if env.has_choice:
        recorded = decisions(data, reward=rules.reward, observation=rules.observation)
        recorded[PERSON] = data.episodes["person"].clone()
    if options.rest_to_rest and len(data.presses):
        data = to_rest_to_rest(data, clean=options.rest_to_rest == "clean")
        if not len(data.presses):
            raise DataError("no press is left as a rest-to-rest press; use rest_to_rest=false")
    if isinstance(rules.keymap, int):
        data = with_keymap(data, rules.keymap)
    rows = transitions(data, reward=rules.reward, observation=rules.observation, has_choice=env.has_choice)
    rows[PERSON] = data.episodes["person"][data.presses["episode"]]
    return rows, recorded


def with_keymap(data: HumanData, keymap: int) -> HumanData:
    """Return the recording under one key map. Each press gets the key that pushes the boat in the same direction."""
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
