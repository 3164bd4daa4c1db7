"""Read Gymnasium's action spaces as components, each a discrete choice or a box, with all parameters side by side.

Accepted is any tree of `Discrete`, `MultiDiscrete`, `MultiBinary`, `Box`, `Tuple`, `Dict` and `OneOf`. A `Discrete` may
have any `start`. A `Box` may have any shape, and floats or integers with finite bounds.

**One choice.** Some spaces are one discrete choice among K discrete actions with parameters of their own:

- a `Tuple` of a `Discrete(K)`, which comes first, and the parameters;
- a `Dict` of a `Discrete(K)` and the parameters, with any names;
- a `OneOf` of K parts, the parameters of the K discrete actions.

In a `Tuple` or a `Dict`, the parameters are one of these:

- a `Tuple` of K parts, one for each discrete action: `Tuple(Discrete(K), Tuple(Box, ...))` is the field's convention. A
  discrete action without parameters has a box of shape `(0,)`. In a `Tuple` K boxes may also follow the `Discrete`
  directly.
- a `Dict` of K parts, which belong to the discrete actions in the order of the space. Gymnasium sorts the names of a
  plain dict. If all names end in different numbers, the order is that of these numbers. K boxes may also be entries
  beside the `Discrete`: in `Dict(mode=Discrete(2), a=Box, b=Box)`, `a` belongs to the first discrete action.
- one `Box` for all discrete actions. With `parameter_dims` its numbers are divided among them, side by side, and the
  environment always gets the whole box. Without, each discrete action has the whole box. The parameters then hold a
  copy of it for each discrete action, and the environment gets the copy of the chosen one.

A part may be any tree of spaces. Its discrete entries become integer parameters: see
`hpamdp.env.gymnasium.parameter_trees`, which also says how numbers that float32 cannot hold are mapped.

**Several components.** Every other tree has the components of its parts, one after another:

- a `Discrete` is a component without parameters, and so is every entry of a `MultiDiscrete` or `MultiBinary`. With
  more than 1,000 values they are read as a `Box` of integers;
- a `Box` is a component of one discrete action, whose parameters are its numbers;
- a `Tuple` or `Dict` that has one of the forms above by itself is one component. Otherwise it has the components of its
  parts. A `Discrete(2)` and `Tuple(Discrete(K), Tuple(K parts))` are two components, since the latter is a choice.

If a space looks like one choice but has independent parts, `form="components"` reads it as the components of its parts.
Then only a `OneOf` is a choice with parameters of its own.

A space may have one more entry, a `Discrete`: the option, which the agent chooses less often than the action. It is the
entry `option` of a `Dict`, or the entry that `option_key` names.

Parameters have two forms. The agent's are float32, within `low` and `high`. The space's own are the numbers that the
environment gets, float64, within `own_low` and `own_high`.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from hpamdp.env.gymnasium.action_parts import MOST_VALUES, Bounds, Choice, Part, choice_form, read_part
from hpamdp.env.gymnasium.options import ActionForm
from hpamdp.env.gymnasium.parameter_trees import NotAcceptedError
from hpamdp.env.gymnasium.values import MisfitError, as_numbers, children
from hpamdp.env.gymnasium_form import ParameterMap
from hpamdp.settings import SettingError

_ACCEPTED = (
    "accepted are trees of Discrete, MultiDiscrete, MultiBinary, Box with finite bounds, Tuple, Dict and OneOf, "
    "such as Tuple(Discrete(K), Tuple(K Boxes)) or Tuple(Discrete(2), Discrete(3), Box)"
)


class ActionSpace:
    """An action space, and the conversion of discrete actions and parameters to the space's own format.

    Args:
        space: see the module's docstring.
        parameter_dims: number of parameters of each discrete action, if one box for all is divided among them.
        form: `auto`: a `Discrete` and the parameters beside it are read as one choice; `components`: all parts are
            independent.

    Attributes:
        component_sizes: number of discrete actions of each component; empty if there is one component.
        num_components: number of components.
        parameter_dims: number of parameters of each discrete action.
        integer_parameters: which of the agent's parameters are integers; empty if all are real numbers.
        starts: number of the first discrete action of each component in the space.
        low, high: bounds of the agent's parameters, float32 `[sum(parameter_dims)]`.
        map: how the agent's parameters become the space's own.
        own_low, own_high: bounds of the space's own parameters, float64 `[sum(parameter_dims)]`.
        is_whole: which of the space's own parameters are integers, bool `[sum(parameter_dims)]`.

    Raises:
        ValueError: the space is not accepted, or its box cannot be divided as `parameter_dims` says.
    """

    def __init__(
        self, space: spaces.Space, parameter_dims: Sequence[int] | None = None, form: ActionForm = "auto"
    ) -> None:
        self._space = space
        try:
            self._part = self._read(parameter_dims, form)
        except NotAcceptedError as error:
            raise self._refusal(str(error)) from error
        sizes = self._part.sizes
        if not sizes:
            raise self._refusal("has nothing to choose")
        self.num_components = len(sizes)
        self.component_sizes = sizes if len(sizes) > 1 else ()
        self.starts = self._part.starts
        self.parameter_dims = self._part.parameter_dims
        self.map = ParameterMap.joined([tree.map for tree in self._part.trees])
        self.low, self.high = (side.astype(np.float32) for side in self.map.agent_bounds)
        is_integer = self.map.is_integer
        self.integer_parameters = tuple(is_integer.tolist()) if is_integer.any() else ()
        self.own_low, self.own_high, self.is_whole = self.map.low, self.map.high, self.map.is_whole
        self._choice = self._part if isinstance(self._part, Choice) else None

    def _read(self, parameter_dims: Sequence[int] | None, form: ActionForm) -> Part:
        if parameter_dims is None:
            return read_part(self._space, finds_choices=form == "auto")
        given = f"parameter_dims={list(parameter_dims)}"
        found = choice_form(self._space) if form == "auto" else None
        if found is None or not found.is_shared:
            why = "each has a Box of its own" if found is not None else "there is none"
            raise self._refusal(f"{given} is for one Box for all discrete actions, but {why}")
        (box,) = found.parts
        size, num_discrete = int(np.prod(box.shape or ())), int(found.discrete.n)
        if len(parameter_dims) != num_discrete or min(parameter_dims) < 0 or sum(parameter_dims) != size:
            allowed = f"{num_discrete} numbers of at least 0 that add up to {size}"
            raise SettingError(f"{given}, but must be {allowed}, with the action space {written(self._space)}")
        return Choice(self._space, parameter_dims)

    def to_native(self, discrete: np.ndarray, parameters: np.ndarray, bounds: Bounds | None = None) -> list[Any]:
        """Return actions in the space's own format.

        Args:
            discrete: the discrete actions, counted from 0 in each component, int64 `[M]` if there is one component,
                else `[M, num_components]`.
            parameters: of all discrete actions, `[M, sum(parameter_dims)]`. Values outside their bounds are clipped;
                NaN becomes the lower bound. Integer parameters are rounded to the nearest integer.
            bounds: narrower bounds of the space's own parameters, float64 `[M, sum(parameter_dims)]` each.
        """
        if self._choice is not None:
            return self._choice.chosen_natives(discrete, parameters, bounds)
        return self._part.natives(discrete.reshape(len(discrete), -1), parameters, bounds)

    def read_mask(self, given: Any) -> np.ndarray:
        """Return a mask as bool, with an entry for each discrete action of all components.

        Args:
            given: the numbers 0 or 1 side by side, or in the structure of the masks of Gymnasium's `sample`.

        Raises:
            MisfitError: the mask has neither form.
        """
        mask = np.ones(len(self.parameter_dims), bool)
        numbers = as_numbers(given)
        is_flat = numbers is not None and numbers.shape == mask.shape
        is_structured = isinstance(given, tuple | list | Mapping) or isinstance(self._space, spaces.MultiBinary)
        if numbers is not None and not isinstance(self._space, spaces.MultiBinary):
            # Numbers in nested tuples make an array of two dimensions, and so they have the structure of `sample`. The
            # structure of one choice also has a None, so it never is an array of numbers.
            is_structured &= numbers.ndim > 1 and self._choice is None
        if is_flat or not is_structured:
            if numbers is None or not is_flat or ((numbers != 0) & (numbers != 1)).any():
                raise MisfitError(given, f"{len(mask)} numbers, 0 or 1")
            return numbers != 0
        self._part.fill_mask(given, mask)
        return mask

    def read_bounds(self, given: Any, static: np.ndarray) -> np.ndarray:
        """Return lower or upper bounds of the space's own parameters, float64 `[sum(parameter_dims)]`.

        Args:
            given: the numbers side by side, or in the structure of the space. Parts may be None or, in a dict, missing.
            static: the bounds of parts that are None or missing, `[sum(parameter_dims)]`.

        Raises:
            MisfitError: the bounds have neither form.
        """
        numbers = as_numbers(given)
        if numbers is not None and numbers.shape == static.shape:
            return numbers.astype(np.float64)
        bound = static.copy()
        self._part.fill_bounds(given, bound)
        return bound

    def _refusal(self, reason: str) -> ValueError:
        return ValueError(f"action space {written(self._space)}: {reason}; {_ACCEPTED}")


class OptionSpace:
    """Takes the option out of an action space, and puts it back into actions.

    Args:
        space: of the environment's actions.
        option_key: the option's name in a `Dict` or its number in a `Tuple`. If None, the entry `option` of a `Dict`.

    Attributes:
        rest: the space without the option.
        num_options: number of options; 0 if the space has no option.
        start: number of the first option in the space.

    Raises:
        ValueError: the space has no such entry, or the entry is not a `Discrete`.
    """

    def __init__(self, space: spaces.Space, option_key: int | str | None = None) -> None:
        entries = children(space)
        self.rest = space
        self.num_options = 0
        self.start = 0
        self._is_dict = isinstance(space, spaces.Dict)
        if option_key is None:
            others = [entry for name, entry in entries.items() if name != "option"]
            # If only boxes are left, or one entry that is no action by itself, `option` is the discrete action.
            is_action = all(isinstance(other, spaces.Box) for other in others)
            is_action |= len(others) == 1 and not _is_action(others[0])
            if not self._is_dict or len(others) == len(entries) or is_action:
                return
            option_key = "option"
        option = entries.pop(option_key, None)
        if not isinstance(option, spaces.Discrete) or option.n > MOST_VALUES or not entries:
            raise SettingError(
                f"option_key={option_key}: must name a Discrete beside the action, of at most {MOST_VALUES:,} options, "
                f"in the action space {written(space)}"
            )
        self._key = option_key
        self._option = option
        self._names = list(entries)
        self.num_options = int(option.n)
        self.start = int(option.start)
        if len(entries) == 1:
            (self.rest,) = entries.values()
        else:
            self.rest = (
                spaces.Dict({str(name): entry for name, entry in entries.items()})
                if self._is_dict
                else spaces.Tuple(list(entries.values()))
            )

    def with_option(self, action: Any, option: int) -> Any:
        """Return an action of the space: one of `rest` with an option, 0 to `num_options` - 1."""
        native = self._option.dtype.type(self.start + option)
        if self._is_dict:
            parts = {self._names[0]: action} if len(self._names) == 1 else dict(action)
            return {**parts, self._key: native}
        values = [action] if len(self._names) == 1 else list(action)
        values.insert(int(self._key), native)
        return tuple(values)


def _is_action(space: spaces.Space) -> bool:
    """Return whether a space holds a discrete action of its own."""
    return isinstance(space, spaces.OneOf) or any(
        isinstance(part, spaces.Discrete) for part in children(space).values()
    )


def written(space: spaces.Space) -> str:
    """Return a space as one line of text, for an error."""
    return textwrap.shorten(repr(space), 300, placeholder=" ...")
