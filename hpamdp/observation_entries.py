"""Entries of observations with pictures, and how such observations are stored as bytes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

# Smallest height and width of a picture. Smaller arrays, such as boards of a game, are vectors.
SMALLEST_PICTURE = 16


@dataclass(frozen=True)
class ObservationEntry:
    """A part of an observation.

    Attributes:
        name: name in errors and in encoders, such as `camera`.
        start: place of its first number in the observation.
        shape: shape before it was flattened. A picture has 2 or 3 dimensions, a stack of colour pictures 4.
        is_picture: whether the numbers are pixels, whole numbers from 0 to 255.
    """

    name: str
    start: int
    shape: tuple[int, ...]
    is_picture: bool = False

    @property
    def size(self) -> int:
        """How many numbers it has."""
        return math.prod(self.shape)

    @property
    def place(self) -> slice:
        """Which numbers of the observation belong to the entry."""
        return slice(self.start, self.start + self.size)

    @property
    def has_channels_last(self) -> bool:
        """Whether a picture has the shape `[H, W, C]`, or `[K, H, W, C]`."""
        return channels_axis(self.shape[-3:]) == 2

    @property
    def picture_shape(self) -> tuple[int, int, int]:
        """Channels, height and width of a picture. A stack of K pictures has K times the channels of one."""
        if len(self.shape) == 2:
            return 1, self.shape[0], self.shape[1]
        first, second, third = self.shape[-3:]
        channels, height, width = (third, first, second) if self.has_channels_last else (first, second, third)
        return math.prod(self.shape[:-3]) * channels, height, width

    def picture(self, observation: Tensor) -> Tensor:
        """Return the pictures `[*B, C, H, W]` of observations `[*B, observation_dim]`, in the observations' dtype."""
        flat = observation[..., self.place]
        if self.has_channels_last:
            picture = flat.unflatten(-1, self.shape).movedim(-1, -3)
            return picture.flatten(-4, -3) if len(self.shape) == 4 else picture
        return flat.unflatten(-1, self.picture_shape)


def channels_axis(shape: Sequence[int]) -> int | None:
    """Return the axis of the channels of a picture with this shape: 0, 2, or None if it has two dimensions.

    The shorter one of the first and the last axis holds the channels; the last one if they are equal. Stable-Baselines3
    (Raffin et al. 2021) decides by the smallest axis, too.
    """
    if len(shape) == 2:
        return None
    return 0 if shape[0] < shape[2] else 2


def is_picture_shape(shape: Sequence[int]) -> bool:
    """Return whether a uint8 array of this shape counts as a picture: `[H, W]`, `[H, W, C]` or `[C, H, W]`.

    A stack of colour pictures, whose first axis is that of the stack, does, too.
    """
    shape = shape[1:] if len(shape) == 4 else shape
    if len(shape) not in (2, 3):
        return False
    axis = channels_axis(shape)
    sides = [size for number, size in enumerate(shape) if number != axis]
    return min(sides) >= SMALLEST_PICTURE


def observation_dtype(entries: Sequence[ObservationEntry]) -> torch.dtype:
    """Return the dtype of observations with these entries: uint8 if all are pictures, otherwise float32."""
    return torch.uint8 if entries and all(entry.is_picture for entry in entries) else torch.float32


def packed(observation: Tensor, entries: Sequence[ObservationEntry]) -> Tensor:
    """Return observations `[*B, observation_dim]` with pictures among vectors as bytes, uint8 `[*B, num_bytes]`.

    A pixel takes one byte, and any other number four. `unpacked` is the inverse.
    """
    parts = []
    for entry in entries:
        part = observation[..., entry.place]
        if entry.is_picture:
            parts.append(part.to(torch.uint8))
        else:
            parts.append(part.float().contiguous().view(torch.uint8))
    return torch.cat(parts, -1)


def unpacked(stored: Tensor, entries: Sequence[ObservationEntry]) -> Tensor:
    """Return the observations float32 `[*B, observation_dim]` of what `packed` returned."""
    sizes = [entry.size if entry.is_picture else 4 * entry.size for entry in entries]
    parts = []
    for entry, part in zip(entries, stored.split(sizes, -1), strict=True):
        # Cloned, because bytes can only be viewed as float32 from an aligned address.
        parts.append(part.float() if entry.is_picture else part.clone().view(torch.float32))
    return torch.cat(parts, -1)
