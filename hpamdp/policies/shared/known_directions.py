"""A memory of where discrete actions point, for problems that do not tell it but show it.

Nothing is learned here: a single step shows the direction of its action exactly, up to noise.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from hpamdp.policies.shared.canonical_frame import joined
from hpamdp.specs import PAMDPSpecs

_SHORTEST = 1e-4  # of a displacement that shows a direction, in units of the observation
_SHORTEST_SUM = 1e-3  # of the known directions, if its opposite is to be the guess


class KnownDirections(nn.Module):
    """Remembers where each of K discrete actions moved when it was last taken in the episode.

    The state `[*B, 2 K]` has x of all actions, then y: unit vectors, or zeros for an action that was not taken yet.
    If each option has directions of its own, the state `[*B, O * 2 K]` has these entries for each of the O options.

    The features `[*B, 3 K + entries]` begin with a table of the held option: x of all directions, y of all directions,
    and the certainty of all. The direction of an action that was not taken yet is guessed. It is the opposite of the
    known directions' sum, or +x if nothing is known. The certainty is 1 for a known direction. For a guess it rises
    from -1 with the fraction of known actions. The entries of the observation that are not redundant follow.

    Args:
        specs: of the problem, whose geometry says what reveals the directions.

    Attributes:
        size: entries of the state.
        num_features: entries of the features.
        name: key of its state in a tensordict.
    """

    is_recurrent = False

    def __init__(self, specs: PAMDPSpecs) -> None:
        super().__init__()
        assert specs.geometry is not None and specs.geometry.revealed is not None
        revealed = specs.geometry.revealed
        self.num_actions = specs.num_discrete
        self.sums_to_zero = revealed.sums_to_zero
        self.num_options = 1 if revealed.last_option is None else specs.num_options
        self.last_option = revealed.last_option
        self.held_option = specs.held_option
        self.geometry = specs.geometry
        self.size = 2 * self.num_actions * self.num_options
        self.table_size = 3 * self.num_actions
        self.num_features = self.table_size + len(specs.telling_entries)
        self.name = f"directions_{self.size}"
        self.last_action = nn.Buffer(torch.tensor(revealed.last_action), persistent=False)
        self.moved = nn.Buffer(torch.tensor(revealed.moved), persistent=False)
        self.kept = nn.Buffer(torch.tensor(specs.telling_entries), persistent=False)

    def step(self, seen: Tensor, held: Tensor) -> Tensor:
        """Return the states `[N, size]` after observations `[N, observation_dim]`, given the states before."""
        moved = seen[..., self.moved]
        length = moved.norm(dim=-1, keepdim=True)
        is_shown = (seen[..., self.last_action] > 0.5) & (length > _SHORTEST)
        unit = (moved / length.clamp(min=_SHORTEST)).unsqueeze(-1)
        states = held.unflatten(-1, (self.num_options, 2, self.num_actions)).unbind(-3)
        if self.last_option is None:
            of_options = [is_shown]
        else:
            last = seen[..., [self.last_option]].round()
            of_options = [is_shown & (last == option) for option in range(self.num_options)]
        parts = zip(of_options, states, strict=True)
        return torch.stack([torch.where(shown.unsqueeze(-2), unit, old) for shown, old in parts], -3).flatten(-3)

    def features(self, seen: Tensor, state: Tensor) -> Tensor:
        """Return the features `[*B, num_features]` of observations and the states after them."""
        return torch.cat([self.table(self.under_held_option(seen, state)), self.telling(seen)], -1)

    def under_held_option(self, seen: Tensor, state: Tensor) -> Tensor:
        """Return the part `[*B, 2 K]` of states that belongs to the options held in observations `[*B, *]`."""
        if self.num_options == 1:
            return state
        of_options = state.unflatten(-1, (self.num_options, -1))
        if self.held_option is not None:
            return of_options[..., self.held_option, :]
        assert self.geometry is not None
        return of_options.take_along_dim(self.geometry.context(seen)[..., None, None], -2).squeeze(-2)

    def telling(self, seen: Tensor) -> Tensor:
        """Return observations `[*B, observation_dim]` without their redundant entries."""
        return seen[..., self.kept]

    def imagined(self, features: Tensor, observation: Tensor) -> Tensor:
        """Return the features that follow from others if a model predicts `observation`, without redundant entries.

        A plan knows no more than the step that it begins with.
        """
        return joined(features[..., : self.table_size], observation)

    def unknown(self, features: Tensor) -> Tensor:
        """Return the actions whose directions are guessed, bool `[*B, K]`, of features `[*B, num_features]`."""
        return features[..., 2 * self.num_actions : self.table_size] < 1.0

    def hypotheses(self, features: Tensor, num: int) -> Tensor:
        """Return the features `[N, M, num_features]` under M sampled sets of directions that agree with what is known.

        An unknown direction is uniform on the circle. If the directions of all actions sum to zero, the last two
        follow from the others, up to their order. The order alternates from one set to the next.

        Args:
            features: `[N, num_features]`.
            num: M.
        """
        is_unknown = self.unknown(features)[:, None, :, None]
        known = features[:, : 2 * self.num_actions].unflatten(-1, (2, -1)).mT.unsqueeze(1)
        shape = len(features), num, self.num_actions
        place = torch.rand(shape[1:], device=features.device, dtype=torch.float32).argsort(0)
        angle = 2.0 * math.pi / num * (place + torch.rand(shape, device=features.device, dtype=torch.float32))
        drawn = torch.stack([angle.cos(), angle.sin()], -1)
        if self.sums_to_zero:
            drawn = _with_sum(drawn, is_unknown, -torch.where(is_unknown, 0.0, known).sum(2))
        direction = torch.where(is_unknown, drawn, known)
        others = features[:, None, self.table_size :].expand(-1, num, -1)
        return torch.cat([*direction.unbind(-1), torch.ones_like(angle), others], -1)

    def table(self, state: Tensor) -> Tensor:
        """Return x, y and certainty of all directions `[*B, 3 K]`, given what is known of an option's, `[*B, 2 K]`."""
        x, y = state.chunk(2, -1)
        is_known = (x != 0.0) | (y != 0.0)
        num_known = is_known.sum(-1, keepdim=True)
        guess_x, guess_y = -x.sum(-1, keepdim=True), -y.sum(-1, keepdim=True)
        length = torch.hypot(guess_x, guess_y)
        is_clear = length > _SHORTEST_SUM
        guess_x = torch.where(is_clear, guess_x / length, 1.0)
        guess_y = torch.where(is_clear, guess_y / length, 0.0)
        is_certain = is_known
        if self.sums_to_zero:
            is_certain = is_known | (num_known == self.num_actions - 1)
        certainty = torch.where(is_certain, 1.0, 2.0 * num_known / self.num_actions - 1.0)
        return torch.cat([torch.where(is_known, x, guess_x), torch.where(is_known, y, guess_y), certainty], -1)


def _with_sum(drawn: Tensor, is_unknown: Tensor, total: Tensor) -> Tensor:
    """Return unit vectors of which the unknown ones have a sum, as nearly as unit vectors can.

    Args:
        drawn: `[N, M, K, 2]`. All unknown ones but the last two are kept.
        is_unknown: bool `[N, 1, K, 1]`.
        total: the sum, `[N, 1, 2]`.
    """
    side = 1.0 - 2.0 * (torch.arange(drawn.shape[1], device=drawn.device) % 2)[:, None]
    left, rest, found = is_unknown.sum(2), total.expand(-1, drawn.shape[1], -1), []
    for k in range(drawn.shape[2]):
        length = rest.norm(dim=-1, keepdim=True)
        along = torch.where(length > _SHORTEST_SUM, rest / length.clamp(min=_SHORTEST_SUM), drawn[:, :, k])
        half = (0.5 * length).clamp(max=1.0)
        across = torch.stack([-along[..., 1], along[..., 0]], -1)
        pair = half * along + side * (1.0 - half.square()).sqrt() * across
        found.append(torch.where(left > 2, drawn[:, :, k], torch.where(left == 2, pair, along)))
        rest = torch.where(is_unknown[:, :, k], rest - found[-1], rest)
        left = left - is_unknown[:, :, k].long()
    return torch.stack(found, 2)
