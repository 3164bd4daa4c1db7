"""What a problem declares of its symmetry: the maps that change nothing, and where its actions point in the plane."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F


@dataclass(frozen=True, eq=False)
class Contexts:
    """Which of several sets of discrete actions an observation belongs to, where actions mean different things in each.

    Options are contexts: with each of them, the same discrete action may do something else.

    Attributes:
        num_contexts: how many there are; 1 where actions always mean the same.
        context_entry: of the observation: the number of the context, negative while it is open; None: it has none.
        one_hot_entry: of the observation: where the one-hot context begins; None: it has none.
    """

    num_contexts: int = 1
    context_entry: int | None = None
    one_hot_entry: int | None = None

    def context(self, observation: Tensor) -> Tensor:
        """Return the contexts, int64 `[*B]`, of observations `[*B, observation_dim]`; 0 while they are open."""
        if self.one_hot_entry is not None:
            end = self.one_hot_entry + self.num_contexts
            return observation[..., self.one_hot_entry : end].argmax(-1)
        if self.num_contexts == 1 or self.context_entry is None:
            return observation.new_zeros(observation.shape[:-1], dtype=torch.long)
        return observation[..., self.context_entry].round().long().clamp(0, self.num_contexts - 1)

    @property
    def entries_of_contexts(self) -> list[int]:
        """The entries of the observation that say which of several contexts holds."""
        if self.num_contexts == 1:
            return []
        entries = [] if self.context_entry is None else [self.context_entry]
        if self.one_hot_entry is not None:
            entries += range(self.one_hot_entry, self.one_hot_entry + self.num_contexts)
        return entries

    def _entries_in(self, place: Mapping[int, int]) -> dict[str, Any]:
        """Return where the context lies among other entries, by their places."""
        names = ("context_entry", "one_hot_entry")
        entries = {name: getattr(self, name) for name in names}
        return {name: None if entry is None else place.get(entry) for name, entry in entries.items()}


@dataclass(frozen=True, eq=False)
class PlaneGeometry(Contexts):
    """Where vectors of the plane lie in an observation, and where the discrete actions point.

    Where actions point, it says more: discrete actions of one kind differ in their directions alone. A plane turned
    until one of them points where the other did gives the same change, turned, and the same reward.

    Attributes:
        vectors: pairs of entries of the observation, x and y.
        origins: what a vector is measured from, for each of them; () if from zero.
        directions: `[num_contexts, num_discrete, 2]`: unit vectors, zero where an action points nowhere; None where
            none of them points anywhere.
        kinds: the kind of each discrete action, `num_discrete` numbers from 0 on; () if each is a kind of its own.
        has_mirror: whether a plane that is mirrored at an action's direction gives the same change, mirrored, and the
            same reward.
        redundant: entries of the observation that a model can do without: nothing that follows depends on them, or
            other entries tell as much. None of them shares a vector with an entry that is not.
    """

    vectors: tuple[tuple[int, int], ...] = ()
    origins: tuple[tuple[float, float], ...] = ()
    directions: Tensor | None = None
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
        """Return the geometry of observations that have these entries alone."""
        place = {entry: number for number, entry in enumerate(entries)}
        kept = [number for number, pair in enumerate(self.vectors) if pair[0] in place and pair[1] in place]
        return replace(
            self,
            vectors=tuple((place[self.vectors[number][0]], place[self.vectors[number][1]]) for number in kept),
            origins=tuple(self.origins[number] for number in kept) if self.origins else (),
            redundant=(),
            **self._entries_in(place),
        )

    def fits(self, observation_dim: int, parameter_dims: Sequence[int]) -> str:
        """Return in words what does not fit a problem of this size, empty if all does."""
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
            f"kinds {self.kinds} with {tuple(parameter_dims)} parameters, but those of a kind must have as many": (
                len(dims_of_kinds) > len(set(self.kinds))
            ),
            f"directions have shape {shape}, but must be {expected}": shape != expected,
        }
        return next((text for text, is_wrong in misfits.items() if is_wrong), "")


@dataclass(frozen=True, eq=False, kw_only=True)
class Symmetries(Contexts):
    """Maps of (observation, discrete action, parameters) under which neither the dynamics nor the reward change.

    If an action leads from one observation to the next, then the mapped action leads from the mapped observation to
    the mapped next one, with the same reward and the same end; in noisy problems, with the same probability. Map 0 is
    the identity. Parameters are in units where their bounds are [-1, 1].

    Attributes:
        weight: `[G, observation_dim, observation_dim]`.
        offset: `[G, observation_dim]`. Observation o becomes `weight @ o + offset`.
        discrete: int64 `[G, num_contexts, num_discrete]`: what each discrete action becomes.
        source: int64 `[G, num_contexts, num_parameters]`: which parameter takes each place.
        sign: `[G, num_parameters]`: 1 or -1, of the parameter that takes the place.
        shift: `[G, num_parameters]`: what is added to it then.
        is_periodic: bool `[num_parameters]`: whether -1 and 1 are the same.
        contexts: int64 `[G, num_contexts]`: what each context becomes; the maps of one option keep all columns.
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
            number: of the maps.
            context: of the actions, `[*B]`.
            discrete: the actions.
            unit: their parameters in [-1, 1].
        """
        moved = unit.gather(-1, self.source[number, context]) * self.sign[number] + self.shift[number]
        periodic = (moved + 1.0).remainder(2.0) - 1.0
        return self.discrete[number, context, discrete], torch.where(self.is_periodic, periodic, moved)

    def map_option(self, number: Tensor, option: Tensor) -> Tensor:
        """Return options `[*B]` under the maps int64 `[*B]`; they stay as they are where they are no contexts."""
        return option if self.contexts.shape[-1] == 1 else self.contexts[number, option]

    def of_option(self, option: int) -> Symmetries:
        """Return the maps of a learner that serves one option: those that keep it."""
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
        """Return the maps of observations that have these entries alone, which no map mixes with the others."""
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
    """Return the symmetries with these tables; what is left out is the identity.

    `discrete` and `source` may lack the dimension of the contexts where there is but one.
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


def plane_maps(num_turns: int, *, has_mirror: bool = True) -> Tensor:
    """Return the turns by multiples of a full turn / `num_turns`, then the same after a mirror x -> -x, `[G, 2, 2]`."""
    angle = 2.0 * torch.pi * torch.arange(num_turns, dtype=torch.float64) / num_turns
    cos, sin = angle.cos(), angle.sin()
    turns = torch.stack([torch.stack([cos, -sin], -1), torch.stack([sin, cos], -1)], -2)
    if not has_mirror:
        return turns
    return torch.cat([turns, turns @ torch.tensor([[-1.0, 0.0], [0.0, 1.0]], dtype=torch.float64)])


def on_observations(
    plane: Tensor,
    observation_dim: int,
    vectors: Sequence[tuple[int, int]],
    origins: Sequence[tuple[float, float]] = (),
) -> tuple[Tensor, Tensor]:
    """Return weight and offset of the maps of observations that map vectors of the plane by `plane` `[G, 2, 2]`."""
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
    """Return which of `targets` `[K, 2]` the `directions` `[K, 2]` become under maps `[G, 2, 2]`, int64 `[G, K]`."""
    mapped = torch.einsum("gij,kj->gki", plane.to(directions), directions)
    return (mapped.unsqueeze(2) - targets).square().sum(-1).argmin(-1)
