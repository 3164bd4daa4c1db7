"""How an agent reads and writes the spaces of the Gymnasium environment that it was trained in."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import Any, TypeAlias

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array, iterate
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from hpamdp import keys
from hpamdp.env.gymnasium.action_spaces import ActionSpace
from hpamdp.env.gymnasium.copies import Copies
from hpamdp.env.gymnasium.masks import Masks, as_leaf
from hpamdp.env.gymnasium.options import GymnasiumOptions
from hpamdp.env.gymnasium.parameter_bounds import ParameterBounds, agent_bounds
from hpamdp.env.gymnasium.processes import ProcessCopies
from hpamdp.env.gymnasium.scaling import ObservationScaling
from hpamdp.env.gymnasium.values import children
from hpamdp.env.gymnasium_form import GymnasiumForm, ParameterMap, VectorScaling, checked_mask

_Shape: TypeAlias = tuple[int, ...]


class NativeForm(GymnasiumForm):
    """The form of any Gymnasium environment: its own spaces.

    Args:
        copies: the copies of the environment.
        scaling: how their observations are scaled.
        settings: how their spaces are read.
    """

    def __init__(self, copies: Copies | ProcessCopies, scaling: ObservationScaling, settings: GymnasiumOptions) -> None:
        self._env = copies.example
        self.observation_space, self.action_space = self._env.observation_space, self._env.action_space
        self._observations, self._actions, self._options = copies.observations, copies.actions, copies.options
        self._scaling, self._settings, self._first_info = scaling, settings, copies.first_info

    def read(self, observation: Any, info: Mapping[str, Any] | None = None) -> tuple[TensorDict, bool]:
        """Return the rows of `GymnasiumForm.read`."""
        num = num_in_batch(self.observation_space, observation)
        space: Any = self.observation_space
        singles = [observation] if num is None else list(iterate(batch_space(space, num), observation))
        read = (self._observations.read(single) for single in singles)
        vectors, pixels = self._observations.quick(singles) or map(np.stack, zip(*read, strict=True))
        observed = self._scaling.rescaled(vectors)
        settings, actions = self._settings, self._actions
        sources = settings.action_mask, settings.pair_mask
        masks = Masks(self._env, len(singles), actions, self._options.num_options, self._first_info, *sources)
        bounds = ParameterBounds(self._env, len(singles), actions, self._first_info, settings.parameter_bounds)
        in_info = [*masks.needs_info, *(() if bounds.in_observation else bounds.names)]
        if in_info and info is None:
            raise ValueError(f"give the info of the step, which holds {' and '.join(in_info)}")
        for row, single in enumerate(singles if masks.rows or bounds.names else ()):
            of_row = info or {}
            if num is not None:
                flags = [f"_{name}" for name in in_info]
                of_row = _of_row({name: of_row[name] for name in (*in_info, *flags) if name in of_row}, row)
            masks.keep(row, single, of_row)
            bounds.keep(row, single, of_row)
        rows = {}
        for name, mask in masks.rows.items():
            component_sizes = actions.component_sizes if name == keys.ACTION_MASK else ()
            rows[name] = as_leaf(name, checked_mask(name, mask, component_sizes), len(actions.parameter_dims))
        rows |= observed_leaves(observed, (bounds.low, bounds.high) if bounds.names else None, pixels, actions)
        return TensorDict(rows, batch_size=[len(singles)]), num is not None

    def scaling(self) -> VectorScaling:
        """Return how flattened observations are scaled."""
        return VectorScaling(*self._observations.clip_bounds(), *self._scaling.linear_map())

    def observed_dtype(self) -> torch.dtype:
        """Return float64 if an observed `Box` has numbers that float32 cannot hold, otherwise float32."""
        return torch.float64 if self._observations.is_precise else torch.float32

    def parameter_map(self) -> ParameterMap | None:
        """Return how parameters become the numbers of the action space; None if they are these numbers."""
        return None if self._actions.map.is_identity else self._actions.map

    def starts(self) -> tuple[tuple[int, ...], int]:
        """Return the number of each component's first discrete action, and that of the first option."""
        return self._actions.starts, self._options.start

    def write(self, acted: TensorDictBase, *, is_batch: bool) -> Any:
        """Return the action of `GymnasiumForm.write`."""
        actions = self._actions.to_native(*(acted.get(key).cpu().numpy() for key in (keys.DISCRETE, keys.PARAMETERS)))
        if self._options.num_options:
            options = acted.get(keys.OPTION).tolist()
            actions = [self._options.with_option(*each) for each in zip(actions, options, strict=True)]
        if not is_batch:
            return actions[0]
        batch: Any = create_empty_array(self.action_space, len(actions))
        return concatenate(self.action_space, actions, batch)


def _of_row(batch: Any, row: int) -> Any:
    """Return one row of a batch of arrays, in tuples and dicts of any depth.

    An array `_name` beside an entry `name` says which rows have it, as in the infos of Gymnasium's vector environments.
    """
    if isinstance(batch, Mapping):
        flags = {name: batch[f"_{name}"] for name in batch if f"_{name}" in batch}
        missing = {name for name, has_entry in flags.items() if not has_entry[row]}
        left_out = {*missing, *(f"_{name}" for name in flags)}
        return {name: _of_row(part, row) for name, part in batch.items() if name not in left_out}
    if isinstance(batch, tuple):
        return tuple(_of_row(part, row) for part in batch)
    return None if batch is None else batch[row]


def observed_leaves(
    vectors: np.ndarray, bounds: tuple[np.ndarray, np.ndarray] | None, pixels: np.ndarray, actions: ActionSpace
) -> dict[str, Tensor]:
    """Return the observations of scaled vectors, bounds and pictures, and the bounds of the agent's parameters.

    Args:
        vectors: float32 `[N, dim]`.
        bounds: of the space's own parameters in these states, float64 `[N, num_parameters]` each, if there are any.
        pixels: of all pictures, uint8 `[N, num_pixels]`.
        actions: the action space.
    """
    leaves = {}
    if bounds is not None:
        low, high, seen = agent_bounds(actions, *bounds)
        vectors = np.concatenate([vectors, seen], axis=-1)
        leaves = {keys.PARAMETER_LOW: torch.from_numpy(low), keys.PARAMETER_HIGH: torch.from_numpy(high)}
    parts = [part for part in (vectors, pixels) if part.shape[1]] or [vectors]
    return {keys.OBSERVATION: torch.from_numpy(np.concatenate(parts, axis=-1)), **leaves}


def num_in_batch(space: spaces.Space, observation: Any) -> int | None:
    """Return the number of observations in a batch; None for one observation.

    Raises:
        ValueError: an entry is missing or has neither form, the entries hold different numbers of observations, or
            none. The message names the entry.
    """
    first, first_num = None, None
    for name, shape, given in _shapes(space, observation, ""):
        entry, own = f"the entry {name}" if name else "the observation", ", ".join(map(str, shape))
        is_batch = len(given) == len(shape) + 1
        if not (is_batch or len(given) == len(shape)) or (is_batch and given[0] == 0):
            allowed = f"[{own}] or [N, {own}]" if shape else "[] or [N]"
            raise ValueError(f"{entry} has the shape {list(given)}, but must have {allowed}, with N from 1 on")
        num = given[0] if is_batch else None
        if first is None:
            first, first_num = entry, num
        elif num != first_num:
            held = "one observation" if first_num is None else f"{first_num} observations"
            wanted = list(shape) if first_num is None else [first_num, *shape]
            raise ValueError(f"{entry} has the shape {list(given)}, but {first} holds {held}, so it must have {wanted}")
    return first_num


def _shapes(space: spaces.Space, observation: Any, name: str) -> Iterator[tuple[str, _Shape, _Shape]]:
    """Yield the name of each entry, its shape in the space and the given shape."""
    if isinstance(space, spaces.Dict | spaces.Tuple):
        for part, its_space in children(space).items():
            own = f"{name}.{part}" if name else str(part)
            try:
                given = observation[part]
            except (KeyError, IndexError, TypeError) as error:
                raise ValueError(f"the observation lacks the entry {own}") from error
            yield from _shapes(its_space, given, own)
    else:
        with suppress(ValueError, TypeError):  # no array: refused where it is read
            yield name, space.shape or (), np.shape(observation)
