"""How one environment of a problem looks to Gymnasium: its spaces, and the way from observations and to actions.

An agent that acts in a Gymnasium environment reads its observations and writes its actions with a `GymnasiumForm`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from gymnasium import spaces
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from hpamdp import keys
from hpamdp.messages import as_code

if TYPE_CHECKING:
    from hpamdp.env.base import PAMDPEnv


@dataclass(frozen=True)
class VectorScaling:
    """What a vector of numbers goes through before policies see it. All parts are float64 `[dim]`.

    Attributes:
        low, high: bounds to which the vector is clipped first.
        centre, width: of the linear map (x - centre) / width, which follows.
        limit: the largest absolute value of the result, to which it is clipped last.
    """

    low: np.ndarray
    high: np.ndarray
    centre: np.ndarray
    width: np.ndarray
    limit: np.ndarray


@dataclass(frozen=True)
class ParameterMap:
    """How an agent's parameters become the numbers of the action space. All parts have shape `[num_parameters]`.

    Attributes:
        low, high: bounds of the space's numbers, float64.
        shift: added to a large integer, which the agent counts from the lower bound, float64. Otherwise 0.
        is_unit: whether the agent's parameter lies in [-1, 1] and stands for a place between the bounds, bool.
        is_many: whether [-1, 1] is divided into a cell for each integer between the bounds, bool.
        is_whole: whether the space's number is an integer, bool.
    """

    low: np.ndarray
    high: np.ndarray
    shift: np.ndarray
    is_unit: np.ndarray
    is_many: np.ndarray
    is_whole: np.ndarray

    @classmethod
    def joined(cls, maps: Sequence[ParameterMap]) -> ParameterMap:
        """Return the map of all parameters, side by side."""
        columns = zip(*(vars(each).values() for each in maps), strict=True)
        return cls(*map(np.concatenate, columns)) if maps else cls(*[np.zeros(0)] * 3, *[np.zeros(0, bool)] * 3)

    @property
    def is_identity(self) -> bool:
        """Whether the agent's parameters are the numbers of the space."""
        return not (self.is_unit.any() or self.shift.any())

    @property
    def is_integer(self) -> np.ndarray:
        """Which of the agent's parameters are integers, bool `[num_parameters]`."""
        return self.is_whole & ~self.is_many

    @property
    def agent_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of the agent's parameters, float64 `[num_parameters]` each."""
        return np.where(self.is_unit, -1.0, self.low - self.shift), np.where(self.is_unit, 1.0, self.high - self.shift)

    def numbers(self, parameters: np.ndarray) -> np.ndarray:
        """Return the space's numbers, given the agent's parameters, `[*M, num_parameters]`."""
        fraction = 0.5 * (np.clip(parameters.astype(np.float64), -1.0, 1.0) + 1.0)
        width = self.high - self.low
        offset = np.where(self.is_many, np.floor(fraction * (width + 1.0)), fraction * width)
        shifted = np.where(self.shift != 0.0, parameters + self.shift, parameters)
        return np.where(self.is_unit, self.low + offset, shifted)

    def parameters(self, numbers: np.ndarray) -> np.ndarray:
        """Return the agent's parameters, float64, given the space's numbers, `[*M, num_parameters]`."""
        half_cell = np.where(self.is_many, 0.5, 0.0)
        width = np.maximum(self.high - self.low + 2.0 * half_cell, np.finfo(float).tiny)
        with np.errstate(invalid="ignore"):
            unit = 2.0 * (numbers - self.low + half_cell) / width - 1.0
        return np.where(self.is_unit, unit, numbers - self.shift)


class GymnasiumForm(ABC):
    """The spaces of one environment.

    Attributes:
        observation_space, action_space: of one environment.
    """

    observation_space: spaces.Space
    action_space: spaces.Space

    @abstractmethod
    def read(self, observation: Any, info: Mapping[str, Any] | None = None) -> tuple[TensorDict, bool]:
        """Return what policies read, `[N]`, and whether the observation is a batch.

        Args:
            observation: one observation, or a batch in Gymnasium's form, in which every leaf has a leading `[N]`.
            info: of the same step; its masks count if the problem gives them there.

        Raises:
            ValueError: the observation is not in the space.
        """

    @abstractmethod
    def write(self, acted: TensorDictBase, *, is_batch: bool) -> Any:
        """Return the actions of rows `[N]` in Gymnasium's form; without `is_batch`, the action of the only row."""

    def scaling(self) -> VectorScaling | None:
        """Return how flattened observations are scaled; None if policies see them as they are."""
        return None

    def observed_dtype(self) -> torch.dtype:
        """Return the dtype that holds flattened observations without loss, float32 or float64."""
        return torch.float32

    def parameter_map(self) -> ParameterMap | None:
        """Return how parameters become the numbers of the action space; None if they are these numbers."""
        return None

    def starts(self) -> tuple[tuple[int, ...], int]:
        """Return the number of each component's first discrete action, and that of the first option."""
        return (), 0


class VectorForm(GymnasiumForm):
    """The form of a problem that Gymnasium sees as this package does.

    An observation is a vector, or a picture if there is nothing else. An action is
    `(discrete, (parameters of action 0, ..., of action K - 1))`. If the agent chooses an option of the problem, the
    option comes first. If there are several components, the action is a tuple of these forms, one for each component. A
    box, which is a component of one discrete action, is its parameters alone. Parameters are float32, or int64 if all
    of a discrete action's parameters are whole.

    Args:
        env: the problem, of any number of environments.
    """

    def __init__(self, env: PAMDPEnv) -> None:
        self._has_option = env.has_choice and env.option_actions is None  # grouped actions need no option to be taken
        self._device = env.device
        self._ends = np.cumsum(env.parameter_dims)[:-1]
        self._components = env.components
        observed = env.observation_spec_unbatched
        self._mask_shapes = {
            name: tuple(observed[name].shape)
            for name in (keys.ACTION_MASK, keys.OPTION_MASK, keys.PAIR_MASK)
            if name in observed.keys()
        }
        self._bounds = [name for name in (keys.PARAMETER_LOW, keys.PARAMETER_HIGH) if name in observed.keys()]
        self._needs_trips = env.card.has_trips and env.has_choice  # with which options end
        self._num_parameters = sum(env.parameter_dims)
        self.num_entries = observed[keys.OBSERVATION].shape[-1]
        entries = env.observation_entries
        self._picture = entries[0].shape if len(entries) == 1 and entries[0].is_picture else None
        self._dtype = observed[keys.OBSERVATION].dtype
        self.observation_space: spaces.Space = spaces.Box(-np.inf, np.inf, (self.num_entries,), np.float32)
        if self._dtype == torch.uint8:
            self.observation_space = spaces.Box(0, 255, self._picture or (self.num_entries,), np.uint8)
        bounds = env.full_action_spec_unbatched[keys.PARAMETERS].space
        lows, highs = (np.split(side.cpu().numpy().reshape(-1), self._ends) for side in (bounds.low, bounds.high))
        is_whole = np.array(env.integer_parameters or (False,) * self._num_parameters, bool)
        self._dtypes = [
            np.dtype(np.int64 if own.size and own.all() else np.float32) for own in np.split(is_whole, self._ends)
        ]
        boxes = [
            spaces.Box(low.astype(dtype), high.astype(dtype), dtype=dtype.type)
            for low, high, dtype in zip(lows, highs, self._dtypes, strict=True)
        ]
        parts: list[spaces.Space] = self._grouped([spaces.Discrete(size) for size in self._components.sizes], boxes)
        if self._has_option:
            parts.insert(0, spaces.Discrete(len(env.option_names)))
        self.action_space = spaces.Tuple(parts)

    def _grouped(self, discrete: Sequence[Any], own: Sequence[Any]) -> list[Any]:
        """Return the parts of the action, of each component's discrete action and all discrete actions' parameters.

        The parts are spaces if these are spaces, and values otherwise.
        """
        of_spaces = isinstance(discrete[0], spaces.Space)
        joined: Any = spaces.Tuple if of_spaces else tuple
        components = self._components
        if components.is_single:
            return [discrete[0], joined(own)]
        parts = []
        for number, start, size in zip(discrete, components.starts, components.sizes, strict=True):
            of_component = joined(own[start : start + size])
            parts.append(own[start] if size == 1 else joined((number, of_component)))
        return parts

    def read(self, observation: Any, info: Mapping[str, Any] | None = None) -> tuple[TensorDict, bool]:
        """Return the rows of `GymnasiumForm.read`."""
        vectors, is_batch = self._vectors(observation)
        num = len(vectors)
        rows = {keys.OBSERVATION: torch.from_numpy(vectors)}
        for name, shape in self._mask_shapes.items():
            mask = self._entry(name, "forbids some choices", info, (num, *shape))
            if not np.isin(mask, (0, 1)).all():
                raise ValueError(f"{name} must be 0 or 1, but is {as_code(info and info[name])}")
            sizes = self._components.sizes if name == keys.ACTION_MASK and not self._components.is_single else ()
            rows[name] = checked_mask(name, mask, sizes)
        for name in self._bounds:
            bound = self._entry(name, "has other bounds in each state", info, (num, self._num_parameters))
            rows[name] = torch.from_numpy(bound.astype(np.float32))
        if self._needs_trips:
            ended = self._entry(keys.TRIP_ENDED, "has options that end with trips", info, (num,))
            rows[keys.TRIP_ENDED] = torch.from_numpy(ended.astype(bool)).unsqueeze(-1)
        return TensorDict(rows, batch_size=[num]).to(self._device), is_batch

    def _vectors(self, observation: Any) -> tuple[np.ndarray, bool]:
        try:
            given = np.asarray(observation)
            if given.dtype.kind not in "biuf":
                raise TypeError("not made of real numbers")
            vectors = np.array(given, np.float32)
            if self._picture is not None and vectors.shape[-len(self._picture) :] == self._picture:
                vectors = vectors.reshape(*vectors.shape[: -len(self._picture)], -1)
        except (TypeError, ValueError, RuntimeError) as error:  # a TensorDict gives the last
            raise ValueError(
                f"the observation must hold {self.num_entries} numbers, but is {as_code(observation)}"
            ) from error
        if vectors.ndim not in (1, 2) or vectors.shape[-1] != self.num_entries or not vectors.size:
            one = ", ".join(map(str, self._picture or (self.num_entries,)))
            expected = f"[{one}] or [N, {one}]"
            raise ValueError(f"the observation has shape {list(vectors.shape)}, but must have {expected}")
        if not np.isfinite(vectors).all():
            raise ValueError(f"entry {int(np.argwhere(~np.isfinite(vectors))[0][-1])} of the observation is not finite")
        if self._dtype == torch.uint8:
            if ((vectors < 0) | (vectors > 255) | (vectors != np.floor(vectors))).any():
                raise ValueError("pixels of the observation must be whole numbers from 0 to 255")
            vectors = vectors.astype(np.uint8)
        return vectors.reshape(-1, self.num_entries), vectors.ndim == 2

    def _entry(self, name: str, why: str, info: Mapping[str, Any] | None, shape: tuple[int, ...]) -> np.ndarray:
        """Return an entry of the info, whose first dimension may be left out if it is 1."""
        if info is None or name not in info:
            raise ValueError(f"the problem {why}, so give the info of the step with its {name}")
        array = np.asarray(info[name])
        if array.shape not in (shape, shape[1:] if shape[0] == 1 else shape) or array.dtype.kind not in "biuf":
            raise ValueError(f"{name} must be numbers in shape {list(shape)}, but is {as_code(info[name])}")
        return array.reshape(shape)

    def write(self, acted: TensorDictBase, *, is_batch: bool) -> Any:
        """Return the action of `GymnasiumForm.write`."""
        discrete, parameters = (acted.get(key).cpu().numpy() for key in (keys.DISCRETE, keys.PARAMETERS))
        parts = np.split(parameters, self._ends, axis=-1)
        own = [part.astype(dtype, copy=False) for part, dtype in zip(parts, self._dtypes, strict=True)]
        numbers = [discrete] if self._components.is_single else list(discrete.T)
        if not is_batch:
            numbers, own = [each[0] for each in numbers], [each[0] for each in own]
        action = tuple(self._grouped(numbers, own))
        if not self._has_option:
            return action
        option = acted.get(keys.OPTION).cpu().numpy()
        return (option if is_batch else option[0]), *action


def checked_mask(name: str, mask: np.ndarray, component_sizes: Sequence[int] = ()) -> Tensor:
    """Return a mask `[N, K]` as a bool tensor.

    Args:
        name: of the mask.
        mask: 0 or 1 for each choice.
        component_sizes: numbers of choices of which something must be allowed each; empty: of all together.

    Raises:
        ValueError: a row allows nothing, or nothing of one component.
    """
    allowed = torch.from_numpy(mask != 0)
    parts = allowed.split([*component_sizes] or allowed.shape[-1], -1)
    is_empty = ~torch.stack([part.any(-1) for part in parts], -1)
    if is_empty.any():
        row, component = is_empty.nonzero()[0].tolist()
        of_component = f" of component {component}" if component_sizes else ""
        raise ValueError(f"{name} of row {row} allows nothing{of_component}")
    return allowed
