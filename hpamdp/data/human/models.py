"""Models of people: how well they predict other people than they were fitted to, and simulated people."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from tensordict import TensorDict
from torch import Tensor
from torch.nn.functional import one_hot
from torchrl.envs.utils import step_mdp

from hpamdp import keys
from hpamdp.data import DataError
from hpamdp.data.human.choice_model import ChoiceModel, choice_features, features_of, rows_of_people
from hpamdp.data.human.press_model import KEYMAP, UPDATES, Presses, PressModel, press_features
from hpamdp.data.human.released_file import EPISODES_PER_BLOCK, TICKS_PER_SECOND, HumanData
from hpamdp.data.human.schema import GAS_SECONDS
from hpamdp.data.human.statistics import offset_bins
from hpamdp.env.boatdock import harbour, physics
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.boatdock.reference import OFFSET_EDGES, Figures
from hpamdp.env.boatdock.task import MAX_PRESSES, BoatState


class Losses(NamedTuple):
    """Negative log-likelihoods, nats, of what people did, by models that were fitted to other people.

    Attributes:
        choice, bins: of the choices, by the model, and by the fractions in six bins of the bearing alone, `[E]`.
        key, duration: of the keys, and of the durations in seconds given the key, `[N]`.
        episode: the rows of the presses' episodes, `[N]`.
    """

    choice: Tensor
    bins: Tensor
    key: Tensor
    duration: Tensor
    episode: Tensor

    def means(self, mask: Tensor) -> Figures:
        """Return the mean losses over the episodes of `mask`, bool `[E]`, and over their presses."""
        of_episodes = {name: getattr(self, name)[mask] for name in ("choice", "bins")}
        of_presses = {name: getattr(self, name)[mask[self.episode]] for name in ("key", "duration")}
        return {name: values.double().mean().item() for name, values in (of_episodes | of_presses).items()}

    def summary(self, data: HumanData) -> dict[str, Any]:
        """Return the mean losses over all episodes of the recording, and by `block` and `person`."""
        found: dict[str, Any] = {"all": self.means(torch.ones_like(self.choice, dtype=torch.bool))}
        for column in ("block", "person"):
            values = data.episodes[column]
            found[column] = {int(value): self.means(values == value) for value in values.unique()}
        return found


def folds_at_random(data: HumanData, num_folds: int, seed: int = 0) -> list[Tensor]:
    """Return the people of each fold, int64 `[K]`, which differ by at most one person.

    Raises:
        DataError: there are fewer people than folds, or fewer than two folds.
    """
    people = data.episodes["person"].unique()
    if not 2 <= num_folds <= len(people):
        raise DataError(f"{num_folds} folds of {len(people)} people; the number must be from 2 to that of the people")
    order = torch.randperm(len(people), generator=torch.Generator().manual_seed(seed))
    return [people[order[fold::num_folds]] for fold in range(num_folds)]


def halves_by_number(data: HumanData) -> list[Tensor]:
    """Return two folds: the first half of the people by their numbers, and the second half."""
    people = data.episodes["person"].unique()
    return [people[: len(people) // 2], people[len(people) // 2 :]]


def held_out_losses(
    data: HumanData, folds: list[Tensor], *, rest_to_rest: bool = True, updates: int = UPDATES, seed: int = 0
) -> Losses:
    """Fit the models to the people outside each fold, and return their losses on the people of the fold.

    Args:
        data: the unchanged recording in one frame.
        folds: people, each in one fold, see `folds_at_random` and `halves_by_number`.
        rest_to_rest: whether to model rest-to-rest presses, the only ones of the environment, or the recorded ones.
        updates, seed: of the press models.
    """
    person = data.episodes["person"]
    is_congruent = data.episodes["controller"] == harbour.CONGRUENT
    in_bins = one_hot(offset_bins(data), len(OFFSET_EDGES) - 1)
    features, presses = features_of(data), Presses(data, rest_to_rest=rest_to_rest)
    choice, of_bins = torch.zeros(2, len(person), dtype=torch.float64).unbind(0)
    key, duration = torch.zeros(2, len(presses.key), dtype=torch.float32).unbind(0)
    for fold in folds:
        held_out = torch.isin(person, fold)
        fitted = ~held_out
        choices = ChoiceModel(features[fitted], is_congruent[fitted])
        choice[held_out] = choices.loss(features[held_out], is_congruent[held_out])
        of_bins[held_out] = ChoiceModel(in_bins[fitted], is_congruent[fitted]).loss(
            in_bins[held_out], is_congruent[held_out]
        )
        press_model = PressModel(presses, fitted[presses.episode], updates=updates, seed=seed)
        rows = held_out[presses.episode].nonzero()[:, 0]
        with torch.no_grad():
            key[rows], duration[rows] = press_model.losses(presses, rows)
    return Losses(choice, of_bins, key, duration, presses.episode)


def simulate(data: HumanData, *, updates: int = UPDATES, seed: int = 0) -> HumanData:
    """Fit both models to everybody, let as many simulated people play in `BoatDockEnv`, and return their recording.

    Each simulated person stands for a real one: the press model sees that person's recorded past in place of the
    simulated one, so a lucky beginning does not change the rest. Choices follow the simulated person's own past.
    Layouts are new. Everybody has as many episodes as the person with the most.

    Args:
        data: the unchanged recording in one frame.
        updates: of the press model.
        seed: of the press model, the layouts and the people's decisions.
    """
    shown = Presses(data)
    presses = PressModel(shown, torch.ones_like(shown.key, dtype=torch.bool), updates=updates, seed=seed)
    choices = ChoiceModel(features_of(data), data.episodes["controller"] == harbour.CONGRUENT)
    rows = rows_of_people(data.episodes)
    num_people, num_episodes = rows.shape
    past_rows = torch.where(rows >= 0, rows, rows.max(1, keepdim=True).values)
    env = BoatDockEnv(num_people, keymap=KEYMAP, seed=seed)
    bearing, choice = torch.zeros(2, num_people, num_episodes, dtype=torch.float32).unbind(0)
    episodes, played = [], []
    with torch.random.fork_rng(devices=()), torch.no_grad():
        torch.manual_seed(seed)
        for number in range(num_episodes):
            td = env.reset()
            state, past = env.state, shown.past[past_rows[:, number]]
            bearing[:, number] = torch.atan2(state.goal_y - state.start_y, state.goal_x - state.start_x)
            index = torch.full((num_people,), number)
            likely = choices.probability(choice_features(index, bearing[:, number], bearing, choice))
            controller = (torch.rand(num_people, dtype=torch.float32) < likely).long()
            choice[:, number] = 2.0 * controller - 1.0
            while not td[keys.DONE].all():
                before = env.state
                key, duration = presses.sample(press_features(td[keys.OBSERVATION], controller, past))
                parameters = torch.zeros(num_people, harbour.NUM_KEYS, dtype=torch.float32).scatter(
                    1, key[:, None], duration[:, None]
                )
                action = TensorDict({"discrete": key, "parameters": parameters}, td.batch_size)
                td = step_mdp(env.step(td.update({keys.OPTION: controller, keys.ACTION: action})))
                played.append(_presses(before, env.state, key, torch.arange(num_people) * num_episodes + number))
            episodes.append(_episodes(env.state, controller, number))
    made = TensorDict.cat(played)
    order = (made["episode"] * MAX_PRESSES + made["press"]).argsort()
    return HumanData(torch.stack(episodes, 1).flatten(), made[order])


def _episodes(end: BoatState, controller: Tensor, number: int) -> TensorDict:
    """Return the rows of everybody's episode of this number `[P]`, as in a recording."""
    people = torch.arange(len(controller))
    index = torch.full_like(people, number)
    centre = torch.tensor(harbour.CENTRE).expand(len(people), -1)
    columns = {
        "person": people,
        "index": index,
        "block": index // EPISODES_PER_BLOCK,
        "controller": controller,
        "keymap": end.keymap.long(),
        "presses": end.presses.long(),
        "outcome": end.outcome.long(),
        "tank": (end.fuel * TICKS_PER_SECOND).round().long(),
        "complete": torch.ones_like(people, dtype=torch.bool),
        "start": torch.stack([end.start_x, end.start_y], 1) + centre,
        "goal": torch.stack([end.goal_x, end.goal_y], 1) + centre,
        "centre": centre,
    }
    return TensorDict(columns, [len(people)])


def _presses(before: BoatState, after: BoatState, key: Tensor, episode: Tensor) -> TensorDict:
    """Return the rows of everybody's press `[K]` in the episodes of these numbers `[P]` that went on."""
    duration = before.fuel - after.fuel
    centre = torch.tensor(harbour.CENTRE)
    goal = torch.stack([before.goal_x, before.goal_y], 1) + centre
    position = torch.stack([before.x, before.y], 1) + centre
    is_final = after.outcome != physics.SAILING
    columns = {
        "episode": episode,
        "press": before.presses.long(),
        "is_final": is_final,
        "position": position,
        "next_position": (torch.stack([after.x, after.y], 1) + centre).where(~is_final.unsqueeze(1), torch.nan),
        "key": key,
        "duration": duration,
        "speed": physics.speed(duration),
        "distance": (goal - position).norm(dim=1),
        "gas": 1.0 - (physics.TANK - after.fuel) / GAS_SECONDS,
    }
    return TensorDict(columns, [len(key)])[before.outcome == physics.SAILING]
