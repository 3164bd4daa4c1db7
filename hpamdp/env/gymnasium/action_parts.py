"""The parts of an action space: discrete choices, with or without parameters of their own, boxes, and groups of these.

Each class reads one kind of part. All have the attributes and methods of `Part`.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from hpamdp.env.gymnasium.parameter_trees import NotAcceptedError, ParameterTree, by_row
from hpamdp.env.gymnasium.values import MisfitError, as_numbers, children, parts_of
from hpamdp.messages import warn_once

# Discrete actions of one choice, each of which has outputs of networks. More are too many to learn one by one.
MOST_VALUES = 1000
# Lower and upper bounds in the current state, in the space's own numbers, float64 `[M, size]` each.
Bounds = tuple[np.ndarray, np.ndarray]


class Part(ABC):
    """A part of an action space, with one or more components.

    Attributes:
        sizes: number of discrete actions of each component.
        starts: number of the first discrete action of each component in the space.
        parameter_dims: number of parameters of each discrete action of all components.
        trees: the spaces of the parameters, in the order of the parameters.
    """

    sizes: tuple[int, ...]
    starts: tuple[int, ...]
    parameter_dims: tuple[int, ...]
    trees: tuple[ParameterTree, ...]

    @property
    def num_parameters(self) -> int:
        """Number of all parameters."""
        return sum(self.parameter_dims)

    @abstractmethod
    def natives(self, discrete: np.ndarray, parameters: np.ndarray, bounds: Bounds | None) -> list[Any]:
        """Return M values of the part, in the format of its space.

        Args:
            discrete: the discrete actions, counted from 0 in each component, int64 `[M, len(sizes)]`.
            parameters: the agent's, `[M, num_parameters]`.
            bounds: narrower bounds of the parameters. If None, those of the space.
        """

    @abstractmethod
    def fill_bounds(self, given: Any, numbers: np.ndarray) -> None:
        """Write bounds in the part's structure into a vector; see `ParameterTree.fill`."""

    @abstractmethod
    def fill_mask(self, given: Any, mask: np.ndarray) -> None:
        """Write a mask in the part's structure into a vector, bool, with an entry for each discrete action.

        The structure is that of the masks of Gymnasium's `sample`. None in place of a part allows everything.

        Raises:
            MisfitError: `given` has another structure.
        """


class Choice(Part):
    """One discrete choice, whose discrete actions have parameters of their own.

    Args:
        space: see the docstring of `hpamdp.env.gymnasium.action_spaces`.
        parameter_dims: number of parameters of each discrete action, if one box for all is divided among them.

    Raises:
        NotAcceptedError: the parameters are not accepted.
    """

    def __init__(self, space: spaces.Space, parameter_dims: Sequence[int] | None = None) -> None:
        form = choice_form(space)
        assert form is not None
        self._form = form
        num = int(form.discrete.n)
        parts = form.parts
        self._is_split = parameter_dims is not None
        if form.is_shared and not self._is_split:
            parts = parts * num
        self._tree = ParameterTree(spaces.Tuple(parts))
        self.trees = (self._tree,)
        self.sizes = (num,)
        self.parameter_dims = tuple(parameter_dims or [ParameterTree(part).size for part in parts])
        self._first = int(form.discrete.start)
        self.starts = (self._first,)
        self._copies = 1 if self._is_split else num

    def natives(self, discrete: np.ndarray, parameters: np.ndarray, bounds: Bounds | None) -> list[Any]:
        """Return values of the part; see `Part.natives`."""
        return self.chosen_natives(discrete[:, 0], parameters, bounds)

    def chosen_natives(self, chosen: np.ndarray, parameters: np.ndarray, bounds: Bounds | None = None) -> list[Any]:
        """Return what `natives` returns, given discrete actions `[M]`."""
        form = self._form
        numbers = self._first + chosen if self._first else chosen
        natives = list(numbers.astype(form.discrete.dtype, copy=False))
        values: list[Any] = self._tree.natives(parameters, bounds)
        if form.is_shared:
            places = [0] * len(values) if self._is_split else chosen.tolist()
            values = [boxes[place] for boxes, place in zip(values, places, strict=True)]
        elif form.part_names is not None:
            values = [dict(zip(form.part_names, boxes, strict=True)) for boxes in values]
        if form.is_one_of:
            values = [parts[index] for parts, index in zip(values, chosen.tolist(), strict=True)]
            return list(zip(natives, values, strict=True))
        if form.names is not None and form.is_flat:
            (name, _) = form.names
            return [{name: native, **parts} for native, parts in zip(natives, values, strict=True)]
        if form.names is not None:
            first, second = form.names
            return [{first: native, second: parts} for native, parts in zip(natives, values, strict=True)]
        if form.is_flat:
            return [(native, *parts) for native, parts in zip(natives, values, strict=True)]
        return list(zip(natives, values, strict=True))

    def fill_bounds(self, given: Any, numbers: np.ndarray) -> None:
        """Write bounds; the bounds of one box for all hold for every discrete action."""
        if given is None:
            return
        form = self._form
        _, of_parts = self._divided(given)
        if form.is_shared:
            of_parts = [of_parts] * self._copies
        elif form.part_names is not None and isinstance(of_parts, Mapping):
            of_parts = parts_of(of_parts, len(form.part_names), form.part_names)
        self._tree.fill(of_parts, numbers)

    def fill_mask(self, given: Any, mask: np.ndarray) -> None:
        """Write the mask of the discrete actions: given alone, or in the structure, in place of the `Discrete`."""
        if given is None:
            return
        numbers = as_numbers(given)
        if numbers is None or numbers.shape != mask.shape:
            if self._form.is_one_of and not _are_masks(given, len(mask)):
                raise MisfitError(given, f"{len(mask)} numbers, 0 or 1, or a tuple of {len(mask)} masks")
            given = self._divided(given)[0]
        if given is not None:
            _write_mask(given, mask)

    def _divided(self, given: Any) -> tuple[Any, Any]:
        """Return what is given in place of the `Discrete`, and what is given in place of the parameters."""
        form = self._form
        if form.is_one_of:
            return None, given
        if form.names is not None:
            first, second = form.names
            names = [first, *(form.part_names or ())] if form.is_flat else [first, second]
            chosen, *rest = parts_of(given, len(names), names)
            return chosen, dict(zip(names[1:], rest, strict=True)) if form.is_flat else rest[0]
        chosen, *rest = parts_of(given, 1 + len(form.parts) if form.is_flat else 2)
        return chosen, rest if form.is_flat else rest[0]


class PlainChoices(Part):
    """A `Discrete`, `MultiDiscrete` or `MultiBinary`: for each of its numbers a choice without parameters."""

    trees = ()

    def __init__(self, space: spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary) -> None:
        self._space = space
        if isinstance(space, spaces.Discrete):
            start: Any = np.array([space.start])
            sizes: Any = np.array([space.n])
        elif isinstance(space, spaces.MultiDiscrete):
            start, sizes = space.start.ravel(), space.nvec.ravel()
        else:
            sizes = np.full(int(np.prod(space.shape)), 2)
            start = np.zeros_like(sizes)
        self._start = start.astype(np.int64)
        self.starts = tuple(self._start.tolist())
        self.sizes = tuple(sizes.tolist())
        self.parameter_dims = (0,) * sum(self.sizes)

    def natives(self, discrete: np.ndarray, parameters: np.ndarray, bounds: Bounds | None) -> list[Any]:
        """Return values of the part; see `Part.natives`."""
        assert self._space.dtype is not None and self._space.shape is not None
        values = (discrete + self._start).astype(self._space.dtype)
        return list(values[:, 0]) if isinstance(self._space, spaces.Discrete) else by_row(values, self._space.shape)

    def fill_bounds(self, given: Any, numbers: np.ndarray) -> None:
        """Do nothing: there are no parameters."""

    def fill_mask(self, given: Any, mask: np.ndarray) -> None:
        """Write the mask: a tuple with one array for each number. A `MultiBinary` has one array of 0, 1 or 2 (both)."""
        if given is None:
            return
        if isinstance(self._space, spaces.Discrete):
            _write_mask(given, mask)
        elif isinstance(self._space, spaces.MultiBinary):
            values = as_numbers(given)
            if values is None or values.shape != self._space.shape or not np.isin(values, (0, 1, 2)).all():
                raise MisfitError(given, f"0, 1 or 2 (both) in shape {self._space.shape}")
            allowed = values.ravel()[:, None]
            mask[:] = ((allowed == (0, 1)) | (allowed == 2)).ravel()
        else:
            start = 0
            for size, of_number in zip(self.sizes, _leaves_of(given, self._space.shape or ()), strict=True):
                _write_mask(of_number, mask[start : start + size])
                start += size


class BoxComponent(Part):
    """A `Box`: a component with one discrete action, whose parameters are the numbers of the box.

    Whole numbers with more than `MOST_VALUES` values are read as such a box, with a warning.
    """

    sizes = (1,)
    starts = (0,)

    def __init__(self, space: spaces.Box | spaces.Discrete | spaces.MultiDiscrete) -> None:
        if not isinstance(space, spaces.Box):
            warn_once(f"action space: {space} has more than {MOST_VALUES:,} values, so it is an ordered parameter")
        self._tree = ParameterTree(space)
        self.trees = (self._tree,)
        self.parameter_dims = (self._tree.size,)

    def natives(self, discrete: np.ndarray, parameters: np.ndarray, bounds: Bounds | None) -> list[Any]:
        """Return values of the part; see `Part.natives`."""
        return self._tree.natives(parameters, bounds)

    def fill_bounds(self, given: Any, numbers: np.ndarray) -> None:
        """Write bounds in the shape of the box."""
        self._tree.fill(given, numbers)

    def fill_mask(self, given: Any, mask: np.ndarray) -> None:
        """Refuse a mask: a box has nothing to choose."""
        if given is not None:
            raise MisfitError(given, "None for a Box")


class Group(Part):
    """A `Tuple` or `Dict`: the components of its parts, one part after another."""

    def __init__(self, space: spaces.Tuple | spaces.Dict, parts: Sequence[Part]) -> None:
        self._names = list(space.spaces) if isinstance(space, spaces.Dict) else None
        self._parts = list(parts)
        self.sizes = tuple(size for part in parts for size in part.sizes)
        self.starts = tuple(start for part in parts for start in part.starts)
        self.parameter_dims = tuple(dim for part in parts for dim in part.parameter_dims)
        self.trees = tuple(tree for part in parts for tree in part.trees)
        self._components = _slices([len(part.sizes) for part in parts])
        self._discrete = _slices([len(part.parameter_dims) for part in parts])
        self._parameters = _slices([part.num_parameters for part in parts])

    def natives(self, discrete: np.ndarray, parameters: np.ndarray, bounds: Bounds | None) -> list[Any]:
        """Return values of the part; see `Part.natives`."""
        values = []
        for part, chosen, own in zip(self._parts, self._components, self._parameters, strict=True):
            of_part = None if bounds is None else (bounds[0][:, own], bounds[1][:, own])
            values.append(part.natives(discrete[:, chosen], parameters[:, own], of_part))
        rows = list(zip(*values, strict=True)) if values else [()] * len(discrete)
        return rows if self._names is None else [dict(zip(self._names, row, strict=True)) for row in rows]

    def fill_bounds(self, given: Any, numbers: np.ndarray) -> None:
        """Write the parts' bounds."""
        values = parts_of(given, len(self._parts), self._names)
        for part, value, own in zip(self._parts, values, self._parameters, strict=True):
            part.fill_bounds(value, numbers[own])

    def fill_mask(self, given: Any, mask: np.ndarray) -> None:
        """Write the parts' masks."""
        values = parts_of(given, len(self._parts), self._names)
        for part, value, own in zip(self._parts, values, self._discrete, strict=True):
            part.fill_mask(value, mask[own])


class ChoiceForm:
    """The form in which a space has a choice with parameters of its own.

    Attributes:
        discrete: the discrete actions.
        parts: the parameters of each discrete action, or the one box for all.
        is_shared: whether there is one box for all.
        is_one_of: whether the space is a `OneOf`.
        is_flat: whether the parts stand beside the `Discrete`, as in `Tuple(Discrete(2), Box, Box)`.
        names: if the space is a `Dict`, the names of the `Discrete` and of the parameters. The second name is empty if
            the form is flat.
        part_names: names of the parts, in the order of `parts`, if the parts are entries of a `Dict`.
    """

    def __init__(
        self,
        discrete: spaces.Discrete,
        parameters: spaces.Space,
        *,
        names: tuple[str, str] | None = None,
        is_flat: bool = False,
        is_one_of: bool = False,
    ) -> None:
        self.discrete = discrete
        self.names = names
        self.is_flat = is_flat
        self.is_one_of = is_one_of
        self.part_names: list[str] | None = None
        self.is_shared = isinstance(parameters, spaces.Box)
        if isinstance(parameters, spaces.Dict):
            self.part_names = _in_order(list(parameters.spaces))
            self.parts = [parameters.spaces[name] for name in self.part_names]
        elif isinstance(parameters, spaces.Tuple):
            self.parts = list(parameters.spaces)
        else:
            self.parts = [parameters]


def choice_form(space: spaces.Space) -> ChoiceForm | None:
    """Return the form of a space that is one choice with parameters of its own; None for any other space."""
    if isinstance(space, spaces.OneOf):
        return ChoiceForm(spaces.Discrete(len(space.spaces)), spaces.Tuple(space.spaces), is_one_of=True)
    if isinstance(space, spaces.Dict) and len(space.spaces) == 2:
        # The sort is stable: it puts the Discrete first, and keeps the order if both entries are one, or neither is.
        names = sorted(space.spaces, key=lambda name: not isinstance(space.spaces[name], spaces.Discrete))
        return _form_of_two(space.spaces[names[0]], space.spaces[names[1]], (names[0], names[1]))
    if isinstance(space, spaces.Dict):
        chosen = [(name, part) for name, part in space.spaces.items() if isinstance(part, spaces.Discrete)]
        boxes = [(name, part) for name, part in space.spaces.items() if isinstance(part, spaces.Box)]
        if len(chosen) == 1 and len(chosen) + len(boxes) == len(space.spaces):
            ((name, discrete),) = chosen
            if len(boxes) == discrete.n:
                return ChoiceForm(discrete, spaces.Dict(boxes), names=(name, ""), is_flat=True)
    elif isinstance(space, spaces.Tuple) and len(space.spaces) == 2:
        return _form_of_two(*space.spaces)
    elif isinstance(space, spaces.Tuple) and len(space.spaces) > 2:
        first, *rest = space.spaces
        are_boxes = all(isinstance(part, spaces.Box) for part in rest)
        if are_boxes and isinstance(first, spaces.Discrete) and len(rest) == first.n:
            return ChoiceForm(first, spaces.Tuple(rest), is_flat=True)
    return None


def _form_of_two(first: spaces.Space, second: spaces.Space, names: tuple[str, str] | None = None) -> ChoiceForm | None:
    """Return the form of a `Discrete` and the parameters of its discrete actions; None if the spaces are not these."""
    if not isinstance(first, spaces.Discrete):
        return None
    is_divided = isinstance(second, spaces.Tuple | spaces.Dict) and len(second.spaces) == first.n
    if is_divided and not _is_conventional(second):
        return ChoiceForm(first, second, names=names)
    is_shared = isinstance(second, spaces.Box) and first.n <= MOST_VALUES
    return ChoiceForm(first, second, names=names) if is_shared else None


def _is_conventional(space: spaces.Space) -> bool:
    """Return whether a space is a `Discrete(K)` and the `Tuple` or `Dict` of its K parts, a choice by itself."""
    form = choice_form(space)
    return form is not None and not (form.is_shared or form.is_flat)


def max_values(space: spaces.Discrete | spaces.MultiDiscrete) -> int:
    """Return how many values a `Discrete` has, or the number of a `MultiDiscrete` with most values."""
    return int(space.n if isinstance(space, spaces.Discrete) else space.nvec.max())


def read_part(space: spaces.Space, *, finds_choices: bool) -> Part:
    """Return the part that a space is.

    Args:
        space: any tree of the accepted spaces.
        finds_choices: whether a `Discrete` and the parameters beside it can be one choice.

    Raises:
        NotAcceptedError: the tree has a space of another kind, or a box whose bounds are not finite.
    """
    if isinstance(space, spaces.OneOf) or (finds_choices and choice_form(space) is not None):
        return Choice(space)
    if isinstance(space, spaces.Discrete | spaces.MultiDiscrete) and max_values(space) > MOST_VALUES:
        return BoxComponent(space)
    if isinstance(space, spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary):
        return PlainChoices(space)
    if isinstance(space, spaces.Box):
        return BoxComponent(space)
    if isinstance(space, spaces.Tuple | spaces.Dict):
        return Group(space, [read_part(part, finds_choices=finds_choices) for part in children(space).values()])
    raise NotAcceptedError(f"has a {type(space).__name__}")


def _write_mask(given: Any, mask: np.ndarray) -> None:
    """Write numbers, 0 or 1 for each discrete action, into a mask."""
    numbers = as_numbers(given)
    if numbers is None or numbers.shape != mask.shape or ((numbers != 0) & (numbers != 1)).any():
        raise MisfitError(given, f"{len(mask)} numbers, 0 or 1")
    mask[:] = numbers != 0


def _are_masks(given: Any, num: int) -> bool:
    """Return whether these are masks of the `num` parts of a `OneOf`, each None or in the structure of its part."""
    is_divided = isinstance(given, tuple | list) and len(given) == num
    return is_divided and not any(isinstance(each, str) or np.isscalar(each) for each in given)


def _leaves_of(given: Any, shape: tuple[int, ...]) -> list[Any]:
    """Return the innermost parts of nested tuples of this shape, in order. A None stands for all parts below it."""
    if not shape:
        return [given]
    if given is None:
        return [None] * int(np.prod(shape))
    if not isinstance(given, tuple | list) or len(given) != shape[0]:
        raise MisfitError(given, f"a tuple of {shape[0]} masks")
    return [leaf for part in given for leaf in _leaves_of(part, shape[1:])]


def _slices(sizes: Sequence[int]) -> list[slice]:
    return [slice(end - size, end) for size, end in zip(sizes, np.cumsum(sizes).tolist(), strict=True)]


def _in_order(names: list[str]) -> list[str]:
    """Sort names by the numbers they end in, if all end in different numbers. Otherwise keep their order."""
    endings = [re.search(r"\d+$", str(name)) for name in names]
    numbers = [int(ending.group()) for ending in endings if ending is not None]
    if len(set(numbers)) < len(names):
        return names
    return [name for _, name in sorted(zip(numbers, names, strict=True))]
