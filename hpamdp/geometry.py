"""Declare a problem's symmetries: the maps that preserve dynamics and rewards, and the actions' directions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F


@dataclass(frozen=True, eq=False)
class Contexts:
    """Contexts, on which the effects of the discrete actions depend.

    Options are contexts: the same discrete action may have a different effect in each of them.

    Attributes:
        num_contexts: number of contexts; 1 if the effects are always the same.
        context_entry: entry of the observation with the context's number, negative while none is chosen; None if there
            is no such entry.
        one_hot_entry: first entry of the one-hot context in the observation; None if there is none.
    """

    num_contexts: int = 1
    context_entry: int | None = None
    one_hot_entry: int | None = None

    def context(self, observation: Tensor) -> Tensor:
        """Return the contexts, int64 `[*B]`, of observations `[*B, observation_dim]`; 0 while none is chosen."""
        if self.one_hot_entry is not None:
            end = self.one_hot_entry + self.num_contexts
            return observation[..., self.one_hot_entry : end].argmax(-1)
        if self.num_contexts == 1 or self.context_entry is None:
            return observation.new_zeros(observation.shape[:-1], dtype=torch.long)
        return observation[..., self.context_entry].round().long().clamp(0, self.num_contexts - 1)

    @property
    def entries_of_contexts(self) -> list[int]:
        """The entries of the observation that hold the context."""
        if self.num_contexts == 1:
            return []
        entries = [] if self.context_entry is None else [self.context_entry]
        if self.one_hot_entry is not None:
            entries += range(self.one_hot_entry, self.one_hot_entry + self.num_contexts)
        return entries

    def _entries_in(self, place: Mapping[int, int]) -> dict[str, Any]:
        """Return the context's new entries, given the new place of each entry."""
        names = ("context_entry", "one_hot_entry")
        entries = {name: getattr(self, name) for name in names}
        return {name: None if entry is None else place.get(entry) for name, entry in entries.items()}


@dataclass(frozen=True)
class RevealedDirections:
    """Where an observation shows in which direction the last discrete action points.

    The problem does not tell the directions. They stay the same for an episode, and may differ in the next.

    Attributes:
        last_action: entries of the one-hot last discrete action, all of them zero before the first one.
        moved: entries x and y of the displacement by the last action, which points where the action does.
        sums_to_zero: whether the directions of all actions sum to zero, so that all but one of them tell the last one.
        last_option: entry with the number of the option that took the last action, if each option has directions of its
            own; None if all have the same.
    """

    last_action: tuple[int, ...]
    moved: tuple[int, int]
    sums_to_zero: bool = False
    last_option: int | None = None

    @property
    def entries(self) -> tuple[int, ...]:
        """All these entries."""
        return (*self.last_action, *self.moved, *(() if self.last_option is None else (self.last_option,)))

    def moved_to(self, place: Mapping[int, int]) -> RevealedDirections | None:
        """Return what shows the directions, given the new place of each entry; None if an entry has none."""
        if any(entry not in place for entry in self.entries):
            return None
        return replace(
            self,
            last_action=tuple(place[entry] for entry in self.last_action),
            moved=(place[self.moved[0]], place[self.moved[1]]),
            last_option=None if self.last_option is None else place[self.last_option],
        )


@dataclass(frozen=True, eq=False)
class PlaneGeometry(Contexts):
    """The vectors of the plane in an observation, and the directions of the discrete actions.

    Discrete actions of one kind differ only in their directions. Turn the plane until one action points where another
    of its kind did: then the change turns with it, and the reward stays the same.

    Attributes:
        vectors: pairs of entries of the observation, x and y.
        origins: origin of each vector; () if all are zero.
        directions: `[num_contexts, num_discrete, 2]`: unit vectors, zero for an action without a direction; None if no
            action has one, or if they are not known.
        revealed: what shows the directions, if they are not known; None if nothing does.
        kinds: the kind of each discrete action, `num_discrete` numbers from 0 on; () if all kinds differ.
        has_mirror: whether mirroring the plane at an action's direction mirrors the change and keeps the reward.
        redundant: entries of the observation that a model does not need: nothing later depends on them, or other
            entries or the revealed directions hold the same information. Both entries of a vector are redundant, or
            neither is.
    """

    vectors: tuple[tuple[int, int], ...] = ()
    origins: tuple[tuple[float, float], ...] = ()
    directions: Tensor | None = None
    revealed: RevealedDirections | None = None
    kinds: tuple[int, ...] = ()
    has_mirror: bool = False
    redundant: tuple[int, ...] = ()

    def of_option(self, option: int) -> PlaneGeometry:
        """Return the geometry of a learner that serves one option."""
        if self.num_contexts == 1:
            return self
        directions = None if self.directions is None else self.directions[option : option + 1]
        return replace(self, directions=directions, num_contexts=1, context_entry=None)

    def with_option_observed(self, observation_dim: int) -> PlaneGeometry:
        """Return the geometry of observations that end in the one-hot option after `observation_dim` entries."""
        return self if self.num_contexts == 1 else replace(self, one_hot_entry=observation_dim)

    def with_entries(self, entries: Sequence[int]) -> PlaneGeometry:
        """Return the geometry of observations reduced to these entries."""
        place = {entry: number for number, entry in enumerate(entries)}
        kept = [number for number, pair in enumerate(self.vectors) if pair[0] in place and pair[1] in place]
        return replace(
            self,
            vectors=tuple((place[self.vectors[number][0]], place[self.vectors[number][1]]) for number in kept),
            origins=tuple(self.origins[number] for number in kept) if self.origins else (),
            revealed=None if self.revealed is None else self.revealed.moved_to(place),
            redundant=(),
            **self._entries_in(place),
        )

    def fits(self, observation_dim: int, parameter_dims: Sequence[int]) -> str:
        """Return in words what does not fit a problem of this size, empty if all does."""
        revealed = self.revealed
        showing, last_action = ((), ()) if revealed is None else (revealed.entries, revealed.last_action)
        entries = [entry for pair in self.vectors for entry in pair]
        expected = [self.num_contexts, len(parameter_dims), 2]
        shape = expected if self.directions is None else list(self.directions.shape)
        dims_of_kinds = set(zip(self.kinds, parameter_dims, strict=False))
        misfits = {
            f"vectors {self.vectors}, but must be different entries of {observation_dim}": (
                any(not 0 <= entry < observation_dim for entry in entries) or len(set(entries)) < len(entries)
            ),
            f"redundant entries {self.redundant}, but must be whole vectors and other entries of {observation_dim}": (
                any(not 0 <= entry < observation_dim for entry in self.redundant)
                or any((x in self.redundant) != (y in self.redundant) for x, y in self.vectors)
            ),
            f"{len(self.origins)} origins for {len(self.vectors)} vectors": (
                len(self.origins) not in (0, len(self.vectors))
            ),
            f"{len(self.kinds)} kinds, but must be {len(parameter_dims)}": (
                len(self.kinds) not in (0, len(parameter_dims))
            ),
            f"kinds {self.kinds} with {tuple(parameter_dims)} parameters, but a kind must have one number of them": (
                len(dims_of_kinds) > len(set(self.kinds))
            ),
            f"directions have shape {shape}, but must be {expected}": shape != expected,
            "directions are both known and revealed, but must be one of them": (
                revealed is not None and self.directions is not None
            ),
            f"revealed by the entries {showing}, but must be different entries of {observation_dim}": (
                any(not 0 <= entry < observation_dim for entry in showing) or len(set(showing)) < len(showing)
            ),
            f"revealed by {len(last_action)} entries of the last action, but must be {len(parameter_dims)}": (
                revealed is not None and len(last_action) != len(parameter_dims)
            ),
        }
        return next((text for text, is_wrong in misfits.items() if is_wrong), "")


@dataclass(frozen=True, eq=False, kw_only=True)
class Symmetries(Contexts):
    """Maps of (observation, discrete action, parameters) under which neither the dynamics nor the reward change.

    If an action leads from one observation to the next, the mapped action leads from the mapped observation to the
    mapped next one. Reward and end of the episode stay the same; in noisy problems, so does the probability. Map 0 is
    the identity. Parameters are scaled to bounds of [-1, 1].

    Attributes:
        weight: `[G, observation_dim, observation_dim]`.
        offset: `[G, observation_dim]`. The map of observation o is `weight @ o + offset`.
        discrete: int64 `[G, num_contexts, num_discrete]`: map of each discrete action.
        source: int64 `[G, num_contexts, num_parameters]`: the parameter that moves to each place.
        sign: `[G, num_parameters]`: factor 1 or -1 for the parameter at its new place.
        shift: `[G, num_parameters]`: offset that is added after the factor.
        is_periodic: bool `[num_parameters]`: whether -1 and 1 are the same value.
        contexts: int64 `[G, num_contexts]`: map of each context; the maps of a single option keep all columns.
    """

    weight: Tensor
    offset: Tensor
    discrete: Tensor
    source: Tensor
    sign: Tensor
    shift: Tensor
    is_periodic: Tensor
    contexts: Tensor

    def __len__(self) -> int:
        return len(self.weight)

    def to(self, device: torch.device | None) -> Symmetries:
        """Return the maps on a device."""
        moved: dict[str, Any] = {name: value.to(device) for name, value in self._tensors().items()}
        return replace(self, **moved)

    def _tensors(self) -> dict[str, Tensor]:
        return {name: value for name, value in vars(self).items() if isinstance(value, Tensor)}

    def map_observation(self, number: Tensor, observation: Tensor) -> Tensor:
        """Return observations `[*B, observation_dim]` under the maps int64 `[*B]`."""
        mapped = torch.einsum("...ij,...j->...i", self.weight[number], observation) + self.offset[number]
        if self.context_entry is not None:
            old = observation[..., self.context_entry]
            renamed = self.contexts[number, old.round().long().clamp(0, self.num_contexts - 1)].to(old)
            mapped[..., self.context_entry] = torch.where(old < 0.0, old, renamed)
        if self.one_hot_entry is not None:
            end = self.one_hot_entry + self.num_contexts
            new = self.contexts[number, self.context(observation)]
            mapped[..., self.one_hot_entry : end] = F.one_hot(new, self.num_contexts).to(mapped)
        return mapped

    def map_action(self, number: Tensor, context: Tensor, discrete: Tensor, unit: Tensor) -> tuple[Tensor, Tensor]:
        """Return discrete actions `[*B]` and parameters `[*B, num_parameters]` under the maps int64 `[*B]`.

        Args:
            number: numbers of the maps.
            context: contexts of the actions, `[*B]`.
            discrete: the actions.
            unit: parameters of the actions in [-1, 1].
        """
        moved = unit.gather(-1, self.source[number, context]) * self.sign[number] + self.shift[number]
        periodic = (moved + 1.0).remainder(2.0) - 1.0
        return self.discrete[number, context, discrete], torch.where(self.is_periodic, periodic, moved)

    def map_option(self, number: Tensor, option: Tensor) -> Tensor:
        """Return options `[*B]` under the maps int64 `[*B]`; unchanged if options are not contexts."""
        return option if self.contexts.shape[-1] == 1 else self.contexts[number, option]

    def of_option(self, option: int) -> Symmetries:
        """Return the maps that keep an option, for a learner of this option."""
        if self.num_contexts == 1:
            return self
        kept = self.contexts[:, option] == option
        tables = {name: value[kept] for name, value in self._tensors().items() if name != "is_periodic"}
        for name in ("discrete", "source"):
            tables[name] = tables[name][:, option : option + 1]
        return replace(self, **tables, num_contexts=1, context_entry=None)  # type: ignore[arg-type]

    def with_option_observed(self, observation_dim: int, num_options: int) -> Symmetries:
        """Return the maps of observations that end in the one-hot option after `observation_dim` entries."""
        weight = torch.eye(observation_dim + num_options, dtype=torch.float32).repeat(len(self), 1, 1)
        weight[:, :observation_dim, :observation_dim] = self.weight
        entry = observation_dim if self.num_contexts > 1 else None
        return replace(self, weight=weight, offset=F.pad(self.offset, (0, num_options)), one_hot_entry=entry)

    def with_entries(self, entries: Sequence[int]) -> Symmetries:
        """Return the maps of observations reduced to these entries, which no map may mix with the others."""
        kept = torch.tensor(entries)
        place = {entry: number for number, entry in enumerate(entries)}
        weight = self.weight[:, kept][:, :, kept]
        return replace(self, weight=weight, offset=self.offset[:, kept], **self._entries_in(place))

    def fits(self, observation_dim: int, num_discrete: int, num_parameters: int) -> str:
        """Return in words what does not fit a problem of this size, empty if all does."""
        num, contexts = len(self), self.num_contexts
        expected = {
            "weight": [num, observation_dim, observation_dim],
            "offset": [num, observation_dim],
            "discrete": [num, contexts, num_discrete],
            "source": [num, contexts, num_parameters],
            "sign": [num, num_parameters],
            "shift": [num, num_parameters],
            "is_periodic": [num_parameters],
            "contexts": [num, contexts],
        }
        for name, shape in expected.items():
            given = list(getattr(self, name).shape)
            if given != shape:
                return f"{name} has shape {given}, but must be {shape}"
        return ""


def make_symmetries(
    weight: Tensor,
    *,
    discrete: Tensor,
    source: Tensor | None = None,
    sign: Tensor | None = None,
    shift: Tensor | None = None,
    offset: Tensor | None = None,
    is_periodic: Sequence[bool] | None = None,
    contexts: Tensor | None = None,
    context_entry: int | None = None,
    num_parameters: int,
) -> Symmetries:
    """Return the symmetries with these tables. An omitted table is the identity.

    With a single context, `discrete` and `source` may lack the contexts' dimension.
    """
    num = len(weight)
    if discrete.ndim == 2:
        discrete = discrete.unsqueeze(1)
    num_contexts = discrete.shape[1]
    if source is None:
        source = torch.arange(num_parameters)
    if source.ndim == 2:
        source = source.unsqueeze(1)
    plain = torch.zeros(num, num_parameters, dtype=torch.float32)
    periodic = torch.zeros(num_parameters, dtype=torch.bool) if is_periodic is None else torch.tensor(is_periodic)
    tables: dict[str, Any] = {
        "weight": weight.float(),
        "offset": torch.zeros(num, weight.shape[-1], dtype=torch.float32) if offset is None else offset.float(),
        "discrete": discrete.long(),
        "source": source.expand(num, num_contexts, -1).long(),
        "sign": plain + 1.0 if sign is None else sign.float(),
        "shift": plain if shift is None else shift.float(),
        "is_periodic": periodic,
        "contexts": torch.arange(num_contexts).expand(num, -1) if contexts is None else contexts.long(),
    }
    return Symmetries(num_contexts=num_contexts, context_entry=context_entry, **tables)


def plane_maps(num_turns: int) -> Tensor:
    """Return rotations `[G, 2, 2]` by multiples of 1 / `num_turns` of a turn, then the same after a mirror x -> -x."""
    angle = 2.0 * torch.pi * torch.arange(num_turns, dtype=torch.float64) / num_turns
    cos, sin = angle.cos(), angle.sin()
    turns = torch.stack([torch.stack([cos, -sin], -1), torch.stack([sin, cos], -1)], -2)
    return torch.cat([turns, turns @ torch.tensor([[-1.0, 0.0], [0.0, 1.0]], dtype=torch.float64)])


def on_observations(
    plane: Tensor,
    observation_dim: int,
    vectors: Sequence[tuple[int, int]],
    origins: Sequence[tuple[float, float]] = (),
) -> tuple[Tensor, Tensor]:
    """Return weight and offset of the observation maps that apply `plane` `[G, 2, 2]` to vectors of the plane."""
    weight = torch.eye(observation_dim, dtype=torch.float64).repeat(len(plane), 1, 1)
    offset = torch.zeros(len(plane), observation_dim, dtype=torch.float64)
    for place, pair in enumerate(vectors):
        for row in range(2):
            for column in range(2):
                weight[:, pair[row], pair[column]] = plane[:, row, column]
        if origins:
            origin = torch.tensor(origins[place], dtype=torch.float64)
            offset[:, list(pair)] = origin - plane @ origin
    return weight.float(), offset.float()


def as_directions(plane: Tensor, directions: Tensor, targets: Tensor) -> Tensor:
    """Return the index of the target `[K, 2]` to which each map `[G, 2, 2]` takes each direction, int64 `[G, K]`."""
    mapped = torch.einsum("gij,kj->gki", plane.to(directions), directions)
    return (mapped.unsqueeze(2) - targets).square().sum(-1).argmin(-1)
