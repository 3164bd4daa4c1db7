"""A model of people's choices: the controller that a person takes, given the goal's bearing and the person's own past.

People differ: one prefers a boat, another a boat for each direction, and both prefer what they took before. The model
is a logistic regression of the congruent choice on eight numbers:
- c = cos 3(bearing - 30 degrees), which is 1 in the congruent and -1 in the incongruent directions, its cube, and 1;
- five memories: means of the person's earlier choices, weighted by how recent and how similar their bearings were. One
  of them takes bearings as similar if they are equally good for the boats.
"""

from __future__ import annotations

import math

import torch
from tensordict import TensorDict
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits
from torch.nn.utils.rnn import pad_sequence

from hpamdp.data.human.released_file import HumanData
from hpamdp.env.boatdock import harbour

# Of each memory: concentration of the similarity, its periods in a turn, and the fraction that an episode fades.
_MEMORIES = ((0.0, 1, 0.05), (2.0, 1, 0.02), (8.0, 1, 0.02), (30.0, 1, 0.01), (2.0, 3, 0.02))
_RIDGE = 1.0
_NEWTON_STEPS = 12


def rows_of_people(episodes: TensorDict) -> Tensor:
    """Return the rows of each person's episodes in their order, int64 `[P, T]`; -1 after the last one."""
    people = [(episodes["person"] == person).nonzero()[:, 0] for person in episodes["person"].unique()]
    return pad_sequence(people, batch_first=True, padding_value=-1)


def bearings(data: HumanData) -> Tensor:
    """Return the bearing of each episode's goal from its start, radians (y down), `[E]`."""
    to_goal = data.episodes["goal"] - data.episodes["start"]
    return torch.atan2(to_goal[:, 1], to_goal[:, 0])


def choice_features(index: Tensor, bearing: Tensor, past_bearings: Tensor, past_choices: Tensor) -> Tensor:
    """Return the eight numbers of one decision of each person, `[P, 8]`.

    Args:
        index: number of earlier episodes of each person, int64 `[P]`.
        bearing: of the goal, radians, `[P]`.
        past_bearings: of the earlier episodes, oldest first, `[P, T]`. Entries from `index` on do not count.
        past_choices: 1 where the congruent controller was taken, -1 where the other one was, `[P, T]`.
    """
    age = index.unsqueeze(1) - 1 - torch.arange(past_bearings.shape[1])
    turn = past_bearings - bearing.unsqueeze(1)
    fit = torch.cos(3.0 * (bearing - math.pi / 6.0))
    features = [fit, fit**3, torch.ones_like(fit)]
    for concentration, periods, fading in _MEMORIES:
        weight = torch.exp(concentration * ((periods * turn).cos() - 1.0)) * (1.0 - fading) ** age.clamp(min=0)
        weight = torch.where(age >= 0, weight, 0.0)
        features.append((weight * past_choices).sum(1) / (weight.sum(1) + 1.0))
    return torch.stack(features, 1)


def features_of(data: HumanData) -> Tensor:
    """Return the numbers of every episode, `[E, 8]`, from the same person's earlier episodes in `data`."""
    rows = rows_of_people(data.episodes)
    bearing = bearings(data)
    choices = 2.0 * (data.episodes["controller"] == harbour.CONGRUENT) - 1.0
    features = torch.zeros(len(bearing), 3 + len(_MEMORIES), dtype=torch.float32)
    for number, now in enumerate(rows.T):
        is_there = now >= 0
        index = torch.full((int(is_there.sum()),), number)
        past = rows[is_there]
        features[now[is_there]] = choice_features(index, bearing[now[is_there]], bearing[past], choices[past])
    return features


class ChoiceModel:
    """The logistic regression, fitted to people's choices.

    Args:
        features: of episodes, from `features_of`, `[E, 8]`.
        is_congruent: whether the congruent controller was taken, bool `[E]`.

    Attributes:
        weights: of the eight numbers, float64 `[8]`.
    """

    def __init__(self, features: Tensor, is_congruent: Tensor) -> None:
        x, y = features.double(), is_congruent.double()
        self.weights = x.new_zeros(x.shape[1])
        identity = torch.eye(x.shape[1], dtype=x.dtype)
        for _ in range(_NEWTON_STEPS):
            p = self.probability(features)
            slope = x.T @ (p - y) + _RIDGE * self.weights
            self.weights = self.weights - torch.linalg.solve(
                x.T @ ((p * (1.0 - p)).unsqueeze(1) * x) + _RIDGE * identity, slope
            )

    def probability(self, features: Tensor) -> Tensor:
        """Return the probability of the congruent choice, float64 `[E]`."""
        return (features.double() @ self.weights).sigmoid()

    def loss(self, features: Tensor, is_congruent: Tensor) -> Tensor:
        """Return the negative log-likelihood of each choice, nats, float64 `[E]`."""
        return binary_cross_entropy_with_logits(
            features.double() @ self.weights, is_congruent.double(), reduction="none"
        )
