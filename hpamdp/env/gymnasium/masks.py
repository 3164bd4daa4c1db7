"""Read the masks of allowed discrete actions and options, and refuse masks in places that are not read."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache
from itertools import chain
from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium import spaces
from torch import Tensor

from hpamdp import keys
from hpamdp.env.errors import ProblemError
from hpamdp.env.gymnasium.action_spaces import ActionSpace
from hpamdp.env.gymnasium.leaves import leaves
from hpamdp.env.gymnasium.values import MisfitError, as_numbers, shown
from hpamdp.settings import SettingError

MaskSource = Literal["info", "ignore"]

_DEPTH = 4  # of nested dictionaries that are searched
# Names of masks, and of lists of allowed or forbidden choices, in lower case without punctuation.
_VERBS = "(?:get|compute|current)?"
_ADJECTIVES = "(?:avail|available|legal|valid|allowed|permitted|possible|feasible|invalid|illegal|forbidden)"
_MEANINGS = {
    keys.ACTION_MASK: f"{_VERBS}(?:{_ADJECTIVES}actions?(?:masks?)?|actions?masks?|masks?actions?)",
    keys.OPTION_MASK: f"{_VERBS}(?:{_ADJECTIVES}options?(?:masks?)?|options?masks?|masks?options?)",
    keys.PAIR_MASK: f"{_VERBS}(?:{_ADJECTIVES}pairs?(?:masks?)?|pairs?masks?|masks?pairs?)",
}
# The setting that says where a mask is.
_SETTINGS = {
    keys.ACTION_MASK: "env.action_mask",
    keys.OPTION_MASK: "env.action_mask",
    keys.PAIR_MASK: "env.pair_mask",
}
# Types that need no search, which takes longer.
_NO_MAPPINGS = frozenset((bool, int, float, str, tuple, list, np.ndarray, np.float32, np.float64, np.int64, type(None)))
# These names may also mean something else, so the values decide.
_VAGUE = ("mask", "masks")


class Masks:
    """The masks of the copies of an environment, with a check for masks in places that are not read.

    Args:
        env: one of the copies.
        num_envs: number of copies.
        actions: their action space, without the option.
        num_options: number of options; 0 without options.
        source: where `action_mask` and `option_mask` are. `info`: they come with the info of every reset and step;
            `ignore`: they are ignored. If None, they are entries of the observation, a `Dict`, if it has them.
        pair_source: the same for `pair_mask`.

    Attributes:
        rows: the masks that are read, by name, bool `[N, K]` each; `pair_mask` is flattened, `[N, K * K]`. `as_leaf`
            gives it its own shape.
        in_observation: names of the masks that come with the observation.

    Raises:
        ValueError: a source is none of these, or the environment has a mask in a place that is not read.
    """

    def __init__(
        self,
        env: gymnasium.Env,
        num_envs: int,
        actions: ActionSpace,
        num_options: int,
        source: MaskSource | None = None,
        pair_source: MaskSource | None = None,
    ) -> None:
        for setting, given in (("action_mask", source), ("pair_mask", pair_source)):
            if given not in (None, "info", "ignore"):
                raise SettingError(f"{setting}={given}: must be info, ignore or null")
        if pair_source == "info" and actions.num_components == 1:
            raise SettingError(
                "pair_mask=info: the action has one component, so there are no pairs; use null, or "
                "env.action_form=components if its parts are independent"
            )
        self._actions = actions
        space = env.observation_space
        entries = space.spaces if isinstance(space, spaces.Dict) else {}
        num = len(actions.parameter_dims)
        sizes = {keys.ACTION_MASK: num, keys.OPTION_MASK: num_options, keys.PAIR_MASK: num * num}
        has_pairs = actions.num_components > 1
        sources = {keys.ACTION_MASK: source, keys.OPTION_MASK: source, keys.PAIR_MASK: pair_source}
        sizes = {name: size for name, size in sizes.items() if size > 0 and sources[name] != "ignore"}
        self.rows = {
            name: np.ones((num_envs, size), bool)
            for name, size in sizes.items()
            if (sources[name] == "info" or name in entries) and (has_pairs or name != keys.PAIR_MASK)
        }
        self.in_observation = frozenset(name for name in self.rows if sources[name] is None)
        self._unread = {name: size for name, size in sizes.items() if name not in self.rows}
        self._refuse([*_in_space(space), *_in_attributes(env, is_new=True)], ValueError)

    @property
    def needs_info(self) -> list[str]:
        """Names of the masks that come with the info."""
        return [name for name in self.rows if name not in self.in_observation]

    def keep(self, row: int, observation: Any, info: Mapping[str, Any]) -> None:
        """Keep the masks that one copy gives with a reset or a step.

        Args:
            row: the copy's number.
            observation: as the environment gives it.
            info: as the environment gives it.

        Raises:
            ProblemError: a mask is not made of 0 and 1 for each choice, or is in a place that is not read.
        """
        for name, masks in self.rows.items():
            given = (observation if name in self.in_observation else info).get(name)
            if given is None and name == keys.OPTION_MASK:
                self._refuse([*in_mapping("info", info, _meaning)], ProblemError, {name: masks.shape[1]})
                masks[row] = True
                continue
            masks[row] = self._flat(name, given, masks.shape[1])
        if self._unread and not (_is_plain(info) and _is_plain(observation)):
            places = in_mapping("info", info, _meaning), in_mapping("observation", observation, _meaning)
            self._refuse([*chain(*places)], ProblemError)

    def _flat(self, name: str, given: Any, size: int) -> np.ndarray:
        """Return a mask as bool `[size]`."""
        if name == keys.ACTION_MASK:
            try:
                return self._actions.read_mask(given)
            except MisfitError as error:
                raise error.named(name, given) from error
        mask = as_numbers(given)
        num = len(self._actions.parameter_dims)
        shape: tuple[int, ...] = (size,)
        wanted = f"{size} numbers"
        if name == keys.PAIR_MASK:
            shape, wanted = (num, num), f"{num} rows of {num} numbers"
        if mask is None or mask.shape != shape or ((mask != 0) & (mask != 1)).any():
            raise ProblemError(f"gave {shown(given)} as {name}, which must be {wanted}, 0 or 1")
        return (mask != 0).ravel()

    def check_attributes(self, env: gymnasium.Env) -> None:
        """Check the attributes that a copy has set since it was made.

        Raises:
            ProblemError: one of them is a mask.
        """
        if self._unread:
            self._refuse([*_in_attributes(env, is_new=False)], ProblemError)

    def _refuse(
        self, places: list[tuple[str, str, Any]], error: type[ValueError], unread: Mapping[str, int] | None = None
    ) -> None:
        """Raise an error about the first mask that is not read, among candidates of a place, a name and a value."""
        unread = self._unread if unread is None else unread
        for place, entry, value in places:
            name = _meaning(entry)
            if name is None or name not in unread or _cannot_be_mask(value):
                continue
            if _is_vague(entry) and not _is_like_mask(value, unread[name]):
                continue
            setting, article = _SETTINGS[name], "a" if name == keys.PAIR_MASK else "an"
            raise error(
                f"gave {article} {name} as {place}, which is not read; give it as {name} in a Dict of observations, or "
                f"in the info of every reset and step with {setting}=info; {setting}=ignore ignores it"
            )


def as_leaf(name: str, mask: Tensor, num_discrete: int) -> Tensor:
    """Return one of `Masks.rows` in the shape of its leaf: `[N, K, K]` for `pair_mask`, otherwise as it is."""
    return mask.unflatten(-1, (num_discrete, num_discrete)) if name == keys.PAIR_MASK else mask


def _in_space(space: spaces.Space) -> Iterator[tuple[str, str, Any]]:
    """Yield the entries of an observation space that may be masks: place, name and a value."""
    for leaf in leaves(space):
        for entry in leaf.path:
            yield f"{leaf.what} of the observation", str(entry), np.zeros(leaf.space.shape or ())


def in_mapping(
    place: str, values: Any, meaning: Callable[[str], str | None], depth: int = _DEPTH
) -> Iterator[tuple[str, str, Any]]:
    """Yield the entries of nested dictionaries whose names have a meaning: place, name and value.

    Args:
        place: what the place of `values` is called.
        values: a dictionary; anything else has no entries.
        meaning: returns what a name suggests, or None.
        depth: how many dictionaries inside each other are searched.
    """
    if not isinstance(values, Mapping) or depth == 0:
        return
    for entry, value in values.items():
        if isinstance(entry, str) and meaning(entry) is not None:
            yield f"{place}[{entry!r}]", entry, value
        if isinstance(value, Mapping):
            yield from in_mapping(f"{place}[{entry!r}]", value, meaning, depth - 1)


def _is_plain(values: Any) -> bool:
    """Return whether values are no dictionary, or one without nested dictionaries and names of masks."""
    if type(values) in _NO_MAPPINGS or not isinstance(values, Mapping):
        return True
    for entry, value in values.items():
        if type(value) not in _NO_MAPPINGS and isinstance(value, Mapping):
            return False
        if type(entry) is str and _meaning(entry) is not None:
            return False
    return True


def _in_attributes(env: Any, *, is_new: bool) -> Iterator[tuple[str, str, Any]]:
    """Yield the attributes and methods of an environment and its wrappers that may be masks: place, name and value.

    Args:
        env: the outermost wrapper.
        is_new: whether to look at the attributes of classes, too. They never change, so one look is enough.
    """
    layer: Any = env
    while layer is not None:
        for attribute in dir(layer) if is_new else [*getattr(layer, "__dict__", ())]:
            if attribute.startswith("_") or _meaning(attribute) is None:
                continue
            value = inspect.getattr_static(layer, attribute, None)
            if not _cannot_be_mask(value):
                kind = "method" if callable(value) else "attribute"
                yield f"the {kind} {type(layer).__name__}.{attribute}", attribute, value
        layer = getattr(layer, "__dict__", {}).get("env")


@lru_cache(maxsize=4096)  # an environment may name its entries anew in each episode
def _meaning(entry: str) -> str | None:
    """Return the mask that the name of an entry suggests, if any."""
    letters = _letters(entry)
    if letters in _VAGUE:
        return keys.ACTION_MASK
    return next((name for name, pattern in _MEANINGS.items() if re.fullmatch(pattern, letters)), None)


def _is_vague(entry: str) -> bool:
    return _letters(entry) in _VAGUE


def _letters(entry: str) -> str:
    return re.sub(r"[^a-z]", "", entry.lower())


def _is_like_mask(value: Any, size: int) -> bool:
    if callable(value) or isinstance(value, property):
        return True
    numbers = as_numbers(value)
    if numbers is None or not numbers.size == size == max(numbers.shape, default=0):
        return False
    return bool(((numbers == 0) | (numbers == 1)).all())


def _cannot_be_mask(value: Any) -> bool:
    """Return whether a value is no mask, whatever its name: a flag, a number, a text or None."""
    return value is None or isinstance(value, str | bool | int | float | np.generic)
