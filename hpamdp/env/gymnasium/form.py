"""How an agent reads and writes the spaces of the Gymnasium environment that it was trained in."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array, iterate
from tensordict import TensorDict, TensorDictBase

from hpamdp import keys
from hpamdp.env.gymnasium.action_spaces import written
from hpamdp.env.gymnasium.copies import Copies
from hpamdp.env.gymnasium.masks import Masks, MaskSource
from hpamdp.env.gymnasium.processes import ProcessCopies
from hpamdp.env.gymnasium.scaling import ObservationScaling
from hpamdp.env.gymnasium_form import GymnasiumForm, VectorScaling, checked_mask


class OwnForm(GymnasiumForm):
    """The form of any Gymnasium environment.

    Args:
        copies: the copies of the environment.
        scaling: how their observations are scaled.
        mask_source: where the environment gives its masks.
    """

    def __init__(
        self, copies: Copies | ProcessCopies, scaling: ObservationScaling, mask_source: MaskSource | None
    ) -> None:
        self._env = copies.example
        self.observation_space, self.action_space = self._env.observation_space, self._env.action_space
        self._observations, self._actions, self._options = copies.observations, copies.actions, copies.options
        self._scaling, self._mask_source = scaling, mask_source
        self._mask_sizes = {
            keys.ACTION_MASK: len(copies.actions.parameter_dims),
            keys.OPTION_MASK: copies.options.num_options,
        }

    def read(self, observation: Any, info: Mapping[str, Any] | None = None) -> tuple[TensorDict, bool]:
        """Return the rows of `GymnasiumForm.read`."""
        num = num_in_batch(self.observation_space, observation)
        space: Any = self.observation_space
        singles = [observation] if num is None else list(iterate(batch_space(space, num), observation))
        vectors = self._observations.rounded(np.stack([self._observations.flat(single) for single in singles]))
        rows = {keys.OBSERVATION: torch.from_numpy(self._scaling.rescaled(vectors))}
        masks = Masks(self._env, len(singles), self._mask_sizes, self._mask_source)
        if masks.rows and not masks.in_observation and info is None:
            raise ValueError(f"give the info of the step, which holds {' and '.join(masks.rows)}")
        for row, single in enumerate(singles if masks.rows else ()):
            in_row = {name: value[row] for name, value in (info or {}).items() if name in masks.rows and num}
            masks.keep(row, single, in_row if num else info or {})
        rows |= {name: checked_mask(name, mask) for name, mask in masks.rows.items()}
        return TensorDict(rows, batch_size=[len(singles)]), num is not None

    def scaling(self) -> VectorScaling:
        """Return how flattened observations are scaled."""
        return VectorScaling(*self._observations.clip_bounds(), *self._scaling.linear_map())

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


def num_in_batch(space: spaces.Space, observation: Any) -> int | None:
    """Return the number of observations in a batch; None for one observation.

    Raises:
        ValueError: the observation has neither form.
    """
    while isinstance(space, spaces.Dict | spaces.Tuple):
        name: Any = next(iter(space.spaces)) if isinstance(space, spaces.Dict) else 0
        space = space[name]
        try:
            observation = observation[name]
        except (KeyError, IndexError, TypeError) as error:
            raise ValueError(f"the observation lacks the entry {name!r}") from error
    more = np.ndim(observation) - len(space.shape or ())
    if more not in (0, 1):
        raise ValueError(f"the observation has shape {list(np.shape(observation))}, but the space is {written(space)}")
    return len(observation) if more else None
