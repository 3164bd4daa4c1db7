"""Read the masks of allowed discrete actions and options, and refuse masks where they are not read."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from torch import Tensor

from hpamdp import keys
from hpamdp.env.errors import ProblemError
from hpamdp.env.gymnasium.action_spaces import ActionSpace
from hpamdp.env.gymnasium.options import MaskSource
from hpamdp.env.gymnasium.values import MisfitError, as_numbers, shown
from hpamdp.settings import SettingError

# The setting that says where a mask is.
_SETTINGS = {
    keys.ACTION_MASK: "env.action_mask",
    keys.OPTION_MASK: "env.action_mask",
    keys.PAIR_MASK: "env.pair_mask",
}


class Masks:
    """The masks of the copies of an environment, with a check for masks that are not read.

    Args:
        env: one of the copies.
        num_envs: number of copies.
        actions: their action space, without the option.
        num_options: number of options; 0 without options.
        first_info: of a reset.
        source: where `action_mask` and `option_mask` are. `info`: they come with the info of every reset and step;
            `ignore`: they are ignored. If None, they are entries of the observation, a `Dict`, or of the first info.
        pair_source: the same for `pair_mask`.

    Attributes:
        rows: the masks that are read, by name, bool `[N, K]` each; `pair_mask` is flattened, `[N, K * K]`. `as_leaf`
            gives it its own shape.
        in_observation: names of the masks that come with the observation.

    Raises:
        ValueError: a source is none of these, or the environment has a mask that is not read.
    """

    def __init__(
        self,
        env: gymnasium.Env,
        num_envs: int,
        actions: ActionSpace,
        num_options: int,
        first_info: Mapping[str, Any],
        source: MaskSource | None = None,
        pair_source: MaskSource | None = None,
    ) -> None:
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
        for name, given in sources.items():
            if given is None and name not in entries and first_info.get(name) is not None:
                sources[name] = "info"
        sizes = {name: size for name, size in sizes.items() if size > 0 and sources[name] != "ignore"}
        self.rows = {
            name: np.ones((num_envs, size), bool)
            for name, size in sizes.items()
            if (sources[name] == "info" or name in entries) and (has_pairs or name != keys.PAIR_MASK)
        }
        self.in_observation = frozenset(name for name in self.rows if sources[name] is None)
        # Also in the plural, as sb3-contrib calls its method.
        self._unread = {entry: name for name in sizes if name not in self.rows for entry in (name, f"{name}s")}
        self._refuse("the entry {} of the observation", entries, SettingError)
        layer: Any = env
        while layer is not None:
            found = {entry: inspect.getattr_static(layer, entry, None) for entry in self._unread}
            self._refuse(f"{type(layer).__name__}.{{}}", found, SettingError)
            layer = getattr(layer, "__dict__", {}).get("env")

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
            ProblemError: a mask is not made of 0 and 1 for each choice, or is not read.
        """
        for name, masks in self.rows.items():
            given = (observation if name in self.in_observation else info).get(name)
            if given is None and name == keys.OPTION_MASK:
                masks[row] = True
                continue
            if given is None:
                ignored = f"{_SETTINGS[name]}=ignore ignores it"
                raise ProblemError(f"gave no {name}, which must come with every reset and step; {ignored}")
            masks[row] = self._flat(name, given, masks.shape[1])
        if not self._unread.keys().isdisjoint(info):
            self._refuse("info[{!r}]", info, ProblemError)

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

    def _refuse(self, place: str, values: Mapping[str, Any], error: type[ValueError]) -> None:
        """Raise an error about the first mask among values that is not read."""
        for entry, name in self._unread.items():
            if values.get(entry) is None:
                continue
            setting, article = _SETTINGS[name], "a" if name == keys.PAIR_MASK else "an"
            raise error(
                f"gave {article} {name} as {place.format(entry)}, which is not read; give it as {name} in a Dict of "
                f"observations, or in the info of every reset and step with {setting}=info; {setting}=ignore ignores it"
            )


def as_leaf(name: str, mask: Tensor, num_discrete: int) -> Tensor:
    """Return one of `Masks.rows` in the shape of its leaf: `[N, K, K]` for `pair_mask`, otherwise as it is."""
    return mask.unflatten(-1, (num_discrete, num_discrete)) if name == keys.PAIR_MASK else mask
