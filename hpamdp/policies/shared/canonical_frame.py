"""Canonical frames: states of a problem in the plane, turned until an action points along +x."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from hpamdp.specs import PAMDPSpecs


def joined(*parts: Tensor) -> Tensor:
    """Join features `[*B, N, F_i]` to `[*B, N, F]`, so that in memory each feature lies in one piece.

    There are few features and many rows. What handles each feature by itself is several times as fast this way, and
    the results of arithmetic lie in memory as their arguments do.
    """
    return torch.cat([part.mT for part in parts], -2).mT


class CanonicalFrame(nn.Module):
    """Turns the plane until the discrete action points along +x; leaves it alone where that means nothing.

    Pairs of a state and an action that differ only by a rotation look identical, so the model learns them once.

    Args:
        specs: of the problem.
        is_used: if false, turn nothing, whatever the problem declares.
        is_revealed: whether directions come from a table of `KnownDirections`, and not from the problem.
    """

    def __init__(self, specs: PAMDPSpecs, *, is_used: bool = True, is_revealed: bool = False) -> None:
        super().__init__()
        geometry = specs.geometry if is_used else None
        self.geometry = geometry
        self.is_revealed = is_revealed
        self.turns = geometry is not None and (is_revealed or geometry.directions is not None)
        pairs = geometry.vectors if geometry is not None else ()
        origins = geometry.origins if geometry is not None and geometry.origins else [(0.0, 0.0)] * len(pairs)
        directions = torch.zeros(1, specs.num_discrete, 2, dtype=torch.float32)
        kind = torch.arange(specs.num_discrete)
        if geometry is not None and geometry.directions is not None:
            directions = geometry.directions
        if geometry is not None and self.turns and geometry.kinds:
            kind = torch.tensor(geometry.kinds)
        nowhere = directions.norm(dim=-1, keepdim=True) < 1e-6
        directions = torch.where(nowhere, torch.tensor([1.0, 0.0], dtype=torch.float32), directions)  # along +x already
        x = torch.tensor([pair[0] for pair in pairs], dtype=torch.long)
        y = torch.tensor([pair[1] for pair in pairs], dtype=torch.long)
        zeros = torch.zeros(specs.observation_dim, dtype=torch.float32)
        # A quarter turn: the entry that takes the place of each one, and its sign; 0 for what is no vector.
        partner, partner_sign = torch.arange(specs.observation_dim), zeros.clone()
        partner[x], partner[y] = y, x
        partner_sign[x], partner_sign[y] = 1.0, -1.0
        origin = zeros.clone()
        origin[x], origin[y] = torch.tensor(origins, dtype=torch.float32).reshape(-1, 2).unbind(-1)
        self.directions = nn.Buffer(directions, persistent=False)
        self.kind = nn.Buffer(kind, persistent=False)
        self.x = nn.Buffer(x, persistent=False)
        self.y = nn.Buffer(y, persistent=False)
        self.origin = nn.Buffer(origin, persistent=False)
        self.is_vector = nn.Buffer(zeros.index_fill(0, torch.cat([x, y]), 1.0), persistent=False)
        self.is_y = nn.Buffer(zeros.index_fill(0, y, 1.0), persistent=False)
        self.partner = nn.Buffer(partner, persistent=False)
        self.partner_sign = nn.Buffer(partner_sign, persistent=False)

    @property
    def num_kinds(self) -> int:
        """How many kinds of discrete actions there are: those that differ in more than their direction."""
        return int(self.kind.max()) + 1

    @property
    def num_vectors(self) -> int:
        """How many vectors of the plane a state has."""
        return len(self.x)

    def direction(self, state: Tensor, discrete: Tensor) -> Tensor:
        """Return where actions `[*B]` point in states `[*B, observation_dim]`, unit vectors `[*B, 2]`."""
        if self.geometry is None or len(self.directions) == 1:
            return self.directions[0].mT.index_select(1, discrete.flatten()).mT.unflatten(0, discrete.shape)
        return self.directions[self.geometry.context(state), discrete]

    def revealed_direction(self, table: Tensor, discrete: Tensor) -> tuple[Tensor, Tensor]:
        """Return where actions `[*B, N]` point, `[*B, N, 2]`, and how certain that is, `[*B, N, 1]` in [-1, 1].

        Args:
            table: x, y and certainty of all actions, `[*B, N, 3 num_discrete]`, see `KnownDirections`.
            discrete: the actions.
        """
        place = discrete[..., None, None, :].expand(*discrete.shape[:-1], 3, 1, -1)
        found = table.mT.unflatten(-2, (3, -1)).gather(-2, place).squeeze(-2).mT
        return found[..., :2], found[..., 2:]

    def turn(self, state: Tensor, direction: Tensor) -> Tensor:
        """Return states `[*B, observation_dim]` with the plane turned until `direction` `[*B, 2]` is +x."""
        return self._turned(state, direction[..., :1], direction[..., 1:])

    def turn_back(self, state: Tensor, direction: Tensor) -> Tensor:
        """Undo `turn`."""
        return self._turned(state, direction[..., :1], -direction[..., 1:])

    def _turned(self, state: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
        if not self.turns:
            return state
        relative = state - self.origin
        crossed = relative.mT.index_select(-2, self.partner).mT * self.partner_sign
        return torch.addcmul(state, cos - 1.0, relative * self.is_vector).addcmul(sin, crossed)

    def mirror(self, state: Tensor) -> Tensor:
        """Return states mirrored at the x axis."""
        return state - 2.0 * (state - self.origin) * self.is_y

    def vectors(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return x and y of all vectors in states `[*B, observation_dim]`, `[*B, num_vectors]` each."""
        relative = state - self.origin
        x, y = (relative.mT.index_select(-2, entry).mT for entry in (self.x, self.y))
        return x, y
