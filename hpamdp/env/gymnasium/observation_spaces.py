"""Gymnasium's observation spaces as vectors and pictures.

Accepted are `Box`, `Discrete`, `MultiDiscrete`, `MultiBinary` and `Tuple` and `Dict` of these. They are flattened by
`gymnasium.spaces.utils.flatten`, which makes discrete values one-hot. Entries of a `Tuple` or `Dict` can be left out.

A `Box` of uint8 from 0 to 255 is a picture if it has 2 or 3 dimensions and at least 16 px a side. Channels may come
first or last, see `hpamdp.observation_entries.channels_axis`. A stack of K of them, `[K, ...]`, is a picture with K
times the channels. Pictures stay uint8 and are never scaled. They follow the vector of all other numbers. A `Box` of
pixels in another form, such as floats from 0 to 1, is refused unless pictures are flattened: it would become a long
vector without a word.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.spaces.utils import flatdim, flatten_space

from hpamdp.env.errors import ProblemError
from hpamdp.env.gymnasium.action_spaces import written
from hpamdp.env.gymnasium.leaves import Leaf, leaves
from hpamdp.env.gymnasium.options import OutOfBounds
from hpamdp.env.gymnasium.values import children
from hpamdp.observation_entries import SMALLEST_PICTURE, ObservationEntry, is_picture_shape
from hpamdp.settings import SettingError

_FLOAT32_BYTES = 4
_MOST_EXACT = 1 << 24  # float32 holds all integers up to this one


class ObservationSpace:
    """A space whose observations are checked and flattened.

    Args:
        space: see the module's docstring.
        entries: of a `Tuple` (numbers from 0) or `Dict` (names), the entries to keep, in this order. If None, all.
        out_of_bounds: what happens to numbers of a `Box` outside its bounds: `refuse`, `clip` or `allow`; see `Leaf`.
        flattens_pictures: whether pictures are part of the vectors.

    Attributes:
        dim: length of the vectors.
        num_pixels: number of pixels of all pictures, each channel counted.

    Raises:
        ValueError: the space or `out_of_bounds` is not accepted, the space has no such entry, or a picture is not made
            of uint8 from 0 to 255.
    """

    def __init__(
        self,
        space: spaces.Space,
        entries: Sequence[int | str] | None = None,
        out_of_bounds: OutOfBounds = "refuse",
        *,
        flattens_pictures: bool = False,
    ) -> None:
        if not _is_flat(space):
            accepted = "Box, Discrete, MultiDiscrete, MultiBinary and Tuple and Dict of these"
            raise SettingError(f"observation space {written(space)}; accepted are {accepted}")
        self._names = list(children(space))
        self.leaves = list(leaves(space, out_of_bounds))
        if entries is not None:
            _check_entries(space, entries)
            self.leaves = [leaf for entry in entries for leaf in self.leaves if leaf.path[0] == entry]
        if not flattens_pictures:
            for leaf in self.leaves:
                _refuse_other_pixels(leaf)
        self._pictures = [] if flattens_pictures else [leaf for leaf in self.leaves if _is_picture(leaf.space)]
        self.leaves = [leaf for leaf in self.leaves if leaf not in self._pictures]
        self._cures = [self._cure(leaf) for leaf in self.leaves]
        self._space = spaces.Tuple([leaf.space for leaf in self.leaves])
        self.dim = flatdim(self._space)
        self.slices = _slices(self.leaves)
        self.num_pixels = sum(leaf.size for leaf in self._pictures)
        self._picture_slices = _slices(self._pictures)

    def entries(self, num_bounds: int = 0) -> tuple[ObservationEntry, ...]:
        """Return the entries of observations in which the pictures follow the vector; none without a picture.

        Args:
            num_bounds: how many bounds of parameters stand between the two.
        """
        if not self._pictures:
            return ()
        vectors = [
            ObservationEntry(_name(leaf), own.start, (leaf.size,))
            for leaf, own in zip(self.leaves, self.slices, strict=True)
        ]
        if num_bounds:
            vectors.append(ObservationEntry("parameter_bounds", self.dim, (num_bounds,)))
        pictures = [
            ObservationEntry(_name(leaf), self.dim + num_bounds + own.start, leaf.space.shape or (), is_picture=True)
            for leaf, own in zip(self._pictures, self._picture_slices, strict=True)
        ]
        return (*vectors, *pictures)

    def places(self, entries: Sequence[int | str]) -> np.ndarray:
        """Return which numbers of the vectors belong to these entries, bool `[dim]`.

        Args:
            entries: of a `Tuple` (numbers from 0) or `Dict` (names); of any other space, numbers of the vector.

        Raises:
            ValueError: there is no such entry.
        """
        observed = [*self.leaves, *self._pictures]
        allowed = list(dict.fromkeys(leaf.path[0] for leaf in observed)) if self._names else [*range(self.dim)]
        wrong = [entry for entry in entries if entry not in allowed]
        if wrong:
            named = str(allowed) if self._names else f"0 to {self.dim - 1}" if self.dim else "none of a picture"
            raise SettingError(f"raw_observations={list(entries)}: must name observed entries, which are {named}")
        is_place = np.zeros(self.dim, bool)
        if not self._names:
            is_place[[int(entry) for entry in entries]] = True
        for leaf, own in zip(self.leaves, self.slices, strict=True):
            is_place[own] |= bool(leaf.path) and leaf.path[0] in entries
        return is_place

    def name_of(self, place: int) -> str:
        """Return what errors call a number of the vectors, such as `speed[0]`."""
        leaf, own = next(each for each in zip(self.leaves, self.slices, strict=True) if place < each[1].stop)
        return f"{_name(leaf)}[{place - own.start}]"

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the bounds of the vectors, float64 `[dim]` each."""
        if not self.leaves:
            return np.zeros(0), np.zeros(0)
        box = flatten_space(self._space)
        assert isinstance(box, spaces.Box)  # as are all spaces that `_is_flat` lets pass
        return box.low.astype(np.float64), box.high.astype(np.float64)

    def quick(self, observations: Sequence[Any]) -> tuple[np.ndarray, np.ndarray] | None:
        """Return what `read` returns for M observations, stacked; None if `read` has to check them, one by one."""
        num = len(observations)
        with suppress(ProblemError):  # an entry is missing
            vectors = [leaf.quick(observations) for leaf in self.leaves]
            pixels = [leaf.quick_pixels(observations) for leaf in self._pictures]
            if all(part is not None for part in (*vectors, *pixels)):
                return (
                    np.concatenate([np.zeros((num, 0)), *vectors], 1),
                    np.concatenate([np.zeros((num, 0), np.uint8), *pixels], 1),
                )
        return None

    def read(self, observation: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the vector of an observation, float64 `[dim]`, and its pixels, uint8 `[num_pixels]`.

        Raises:
            ProblemError: an entry is missing or not in its space: see `Leaf`.
        """
        vectors = [leaf.flat(observation, cure) for leaf, cure in zip(self.leaves, self._cures, strict=True)]
        pixels = [leaf.picture(observation).astype(np.uint8) for leaf in self._pictures]
        return _joined(vectors), np.concatenate([np.zeros(0, np.uint8), *pixels])

    @property
    def is_precise(self) -> bool:
        """Whether the vectors have numbers that float32 cannot hold: float64, or integers beyond 16,777,216."""
        boxes = [leaf.space for leaf in self.leaves if isinstance(leaf.space, spaces.Box)]
        return any(
            box.dtype.itemsize > _FLOAT32_BYTES
            if box.dtype.kind == "f"
            else max(-int(box.low.min()), int(box.high.max())) > _MOST_EXACT
            for box in boxes
            if box.low.size
        )

    def clip_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the bounds to which numbers are clipped, float64 `[dim]` each; infinite if they are not."""
        return _joined([leaf.clip_low for leaf in self.leaves]), _joined([leaf.clip_high for leaf in self.leaves])

    def _cure(self, leaf: Leaf) -> str:
        """Return how to leave out the leaf's entry, as the end of a message; empty if there is no other entry."""
        others = [name for name in self._names if leaf.path and name != leaf.path[0]]
        return f"; env.observation_keys={others} leaves the entry out" if others else ""


def _slices(parts: Sequence[Leaf]) -> list[slice]:
    ends = np.cumsum([leaf.size for leaf in parts], dtype=np.int64).tolist()
    return [slice(end - leaf.size, end) for end, leaf in zip(ends, parts, strict=True)]


def _joined(vectors: Sequence[np.ndarray]) -> np.ndarray:
    return np.concatenate(vectors) if vectors else np.zeros(0)


def _name(leaf: Leaf) -> str:
    return ".".join(map(str, leaf.path)) or "observation"


def _is_picture(space: spaces.Space) -> bool:
    if not isinstance(space, spaces.Box) or space.dtype != np.uint8 or not is_picture_shape(space.shape):
        return False
    return bool((space.low == 0).all() and (space.high == 255).all())


def _refuse_other_pixels(leaf: Leaf) -> None:
    """Refuse a box as large as a colour picture whose numbers are pixels in another form.

    Raises:
        SettingError: they lie between 0 and 1 or between 0 and 255, but make no picture of uint8 from 0 to 255.
    """
    space = leaf.space
    if not isinstance(space, spaces.Box) or _is_picture(space) or len(space.shape) < 3:
        return
    is_large = sum(size >= SMALLEST_PICTURE for size in space.shape) >= 2
    if is_large and (space.low == 0).all() and any((space.high == highest).all() for highest in (1, 255)):
        raise SettingError(
            f"observation {_name(leaf)}: {written(space)} has the shape of a picture, whose pixels must be uint8 from "
            "0 to 255, in [H, W], [H, W, C], [C, H, W] or a stack [K, ...] of these; encoder=mlp reads it as a vector"
        )


def _check_entries(space: spaces.Space, entries: Sequence[int | str]) -> None:
    names = list(children(space))
    if not names:
        raise SettingError(
            f"observation_keys={list(entries)}: the observation {written(space)} has no entries; use null"
        )
    wrong = [entry for entry in entries if entry not in names]
    if wrong or not entries or len(set(entries)) < len(entries):
        raise SettingError(f"observation_keys={list(entries)}: must name different entries of {names}; null: all")


def _is_flat(space: spaces.Space) -> bool:
    """Return whether flattening the space gives a Box."""
    if isinstance(space, spaces.Tuple | spaces.Dict):
        return all(map(_is_flat, children(space).values()))
    return isinstance(space, spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary)
