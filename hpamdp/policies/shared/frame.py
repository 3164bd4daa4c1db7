"""The plane's part in learning: states turned until an action points along +x, lengths, and random symmetries."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from hpamdp.geometry import Symmetries
from hpamdp.specs import PAMDPSpecs


def joined(*parts: Tensor) -> Tensor:
    """Join features `[*B, N, F_i]` to `[*B, N, F]`, so that in memory each feature lies in one piece.

    There are few features and many rows. What handles each feature by itself is several times as fast this way, and
    the results of arithmetic lie in memory as their arguments do.
    """
    return torch.cat([part.mT for part in parts], -2).mT


class CanonicalFrame(nn.Module):
    """Turns the plane until the discrete action points along +x; leaves it alone where that means nothing.

    So (state, action) pairs that are the same but for a turn become one, and a model needs to learn it but once.

    Args:
        specs: of the problem.
        is_used: false: turn nothing, whatever the problem declares.
    """

    directions: Tensor
    kind: Tensor
    x: Tensor
    y: Tensor
    origin: Tensor
    is_vector: Tensor
    is_y: Tensor
    partner: Tensor
    partner_sign: Tensor

    def __init__(self, specs: PAMDPSpecs, *, is_used: bool = True) -> None:
        super().__init__()
        geometry = specs.geometry if is_used else None
        self.geometry = geometry
        self.turns = geometry is not None and geometry.directions is not None
        pairs = geometry.vectors if geometry is not None else ()
        origins = geometry.origins if geometry is not None and geometry.origins else [(0.0, 0.0)] * len(pairs)
        directions = torch.zeros(1, specs.num_discrete, 2, dtype=torch.float32)
        kind = torch.arange(specs.num_discrete)
        if geometry is not None and geometry.directions is not None:
            directions = geometry.directions
            kind = torch.tensor(geometry.kinds) if geometry.kinds else kind
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
        buffers = {
            "directions": directions,
            "kind": kind,
            "x": x,
            "y": y,
            "origin": origin,
            "is_vector": zeros.index_fill(0, torch.cat([x, y]), 1.0),
            "is_y": zeros.index_fill(0, y, 1.0),
            "partner": partner,
            "partner_sign": partner_sign,
        }
        for name, value in buffers.items():
            self.register_buffer(name, value, persistent=False)

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


class RandomSymmetry:
    """Maps stored transitions by random symmetries of the problem.

    Args:
        specs: of the problem.
        device: of the transitions.

    Raises:
        ValueError: the problem declares no symmetries.
    """

    def __init__(self, specs: PAMDPSpecs, device: torch.device) -> None:
        if specs.symmetries is None:
            raise ValueError("augment=true: the problem declares no symmetries; use augment=false")
        self.maps: Symmetries = specs.symmetries.to(device)

    def __call__(self, rows: TensorDictBase) -> TensorDictBase:
        """Return rows `[N, *]`, each with states, action and options (where it has any) mapped by one map."""
        number = torch.randint(len(self.maps), rows.batch_size[:1], device=rows["state"].device)
        shape = rows.batch_size
        number = number.reshape(-1, *[1] * (len(shape) - 1)).expand(shape)
        return self.mapped(number, rows)

    def mapped(self, number: Tensor, rows: TensorDictBase) -> TensorDictBase:
        """Return rows `[*B]` under the maps int64 `[*B]`."""
        context = self.maps.context(rows["state"])
        discrete, unit = self.maps.map_action(number, context, rows["discrete"], rows["unit"])
        rows = rows.copy()
        for name in ("state", "next_state"):
            rows.set(name, self.maps.map_observation(number, rows[name]))
        for name in ("option", "next_option"):
            if name in rows.keys():
                rows.set(name, self.maps.map_option(number, rows[name]))
        return rows.set("discrete", discrete).set("unit", unit)
