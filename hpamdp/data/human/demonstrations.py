"""People's presses for an agent to learn from: those that fit an environment, as one collected batch."""

from __future__ import annotations

from pathlib import Path

import torch
from pydantic import PositiveInt
from tensordict import TensorDict

from hpamdp import keys
from hpamdp.data.human.episodes import select
from hpamdp.data.human.errors import HumanDataError
from hpamdp.data.human.released_file import HumanData, read
from hpamdp.data.human.rest_to_rest import to_rest_to_rest
from hpamdp.data.human.transitions import TRAJECTORY, transitions
from hpamdp.env.boatdock import harbour
from hpamdp.env.boatdock.environment import BoatDockEnv


class HumanDemonstrations:
    """The presses of the episodes that meet every condition, as the environment at hand would have given them.

    Where the environment has one key map, the keys are those that push the boat there as people's did.

    Args:
        env: the boats, whose boat, key map, reward and observation are taken.
        path: the released file; None: where `released_file.default_path` expects it.
        checksum: the SHA-256 that the file must have; None: any.
        complete, successes, best_people: as in `hpamdp.data.human.episodes.select`.
        rest_to_rest: whether `hpamdp.data.human.rest_to_rest.to_rest_to_rest` makes presses of them that start from rest and glide out.

    Raises:
        ValueError: another environment than the boats, no such file, not the right one, or nothing is left.
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
        if not isinstance(env, BoatDockEnv):
            raise ValueError("people docked boats; use env=boatdock or data=none")
        rules = env.rules
        controller = rules.controller if rules.controller in harbour.CONTROLLERS else None
        try:
            data = read(None if path is None else Path(path), checksum=checksum, one_frame=True)
            data = select(data, complete=complete, successes=successes, best_people=best_people, controller=controller)
            if rest_to_rest:
                data = to_rest_to_rest(data)
            if rules.keymap != "random":
                data = with_keymap(data, rules.keymap)
            rows = transitions(data, reward=rules.reward, observation=rules.observation, has_choice=env.has_choice)
        except HumanDataError as error:
            raise ValueError(str(error)) from error
        self.batch = with_decision_sums(rows).unsqueeze(0).to(env.device)


def with_keymap(data: HumanData, keymap: int) -> HumanData:
    """Return the recording with the keys of one key map that push the boats where people's did."""
    of = data.episodes[data.presses["episode"]]
    controller, key = of["controller"].int(), data.presses["key"].int()
    pushed = torch.stack(harbour.direction(controller, of["keymap"].int(), key), -1)
    candidates = torch.arange(harbour.NUM_KEYS, dtype=torch.int32).expand(len(key), -1)
    there = torch.full_like(candidates, keymap)
    pushes = torch.stack(harbour.direction(controller.unsqueeze(1).expand_as(there), there, candidates), -1)
    same = (pushes * pushed.unsqueeze(1)).sum(-1).argmax(1)
    episodes = data.episodes.clone()
    episodes["keymap"] = torch.full_like(episodes["keymap"], keymap)
    return HumanData(episodes, data.presses.clone().set("key", same))


def with_decision_sums(rows: TensorDict) -> TensorDict:
    """Add what `DecisionTracker` writes where options last an episode: return so far, steps, decision's observation."""
    trajectory, reward = rows[TRAJECTORY], rows["next", keys.REWARD].squeeze(-1).double()
    first = torch.searchsorted(trajectory, trajectory)
    total = reward.cumsum(0)
    so_far = total - total[first] + reward[first]
    steps = torch.arange(len(first)) - first + 1
    return rows.set(
        "next",
        rows["next"].update(
            {
                keys.OPTION_RETURN: so_far.float().unsqueeze(-1),
                keys.OPTION_STEPS: steps.unsqueeze(-1),
                keys.DECISION_OBSERVATION: rows[keys.OBSERVATION][first],
            }
        ),
    )
