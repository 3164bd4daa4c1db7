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

if TYPE_CHECKING:
    from hpamdp.env.base import PAMDPEnv


@dataclass(frozen=True)
class VectorScaling:
    """What a vector of numbers goes through before policies see it. All parts are float64 `[dim]`.

    Attributes:
        low, high: to which it is clipped first.
        centre, width: of the linear map to (x - centre) / width.
        limit: the largest size of what is left.
    """

    low: np.ndarray
    high: np.ndarray
    centre: np.ndarray
    width: np.ndarray
    limit: np.ndarray


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


class VectorForm(GymnasiumForm):
    """The form of a problem that Gymnasium sees as this package does.

    An observation is a vector. An action is `(discrete, (parameters of action 0, ..., of action K - 1))`. If the agent
    chooses an option of the problem, the option comes first.

    Args:
        env: the problem, of any number of environments.
    """

    def __init__(self, env: PAMDPEnv) -> None:
        self._has_option = env.has_choice and env.option_actions is None  # grouped actions need no option to be taken
        self._device = env.device
        self._ends = np.cumsum(env.parameter_dims)[:-1]
        self._mask_sizes = {
            name: env.observation_spec[name].shape[-1]
            for name in (keys.ACTION_MASK, keys.OPTION_MASK)
            if name in env.observation_spec.keys()
        }
        self.num_entries = env.observation_spec_unbatched[keys.OBSERVATION].shape[-1]
        self.observation_space = spaces.Box(-np.inf, np.inf, (self.num_entries,), np.float32)
        bounds = env.full_action_spec_unbatched[keys.PARAMETERS].space
        lows, highs = (np.split(side.cpu().numpy().reshape(-1), self._ends) for side in (bounds.low, bounds.high))
        boxes = [spaces.Box(low, high, dtype=np.float32) for low, high in zip(lows, highs, strict=True)]
        parts: list[spaces.Space] = [spaces.Discrete(len(boxes)), spaces.Tuple(boxes)]
        if self._has_option:
            parts.insert(0, spaces.Discrete(len(env.option_names)))
        self.action_space = spaces.Tuple(parts)

    def read(self, observation: Any, info: Mapping[str, Any] | None = None) -> tuple[TensorDict, bool]:
        """Return the rows of `GymnasiumForm.read`."""
        vectors, is_batch = self._vectors(observation)
        rows = {keys.OBSERVATION: torch.from_numpy(vectors)}
        for name in self._mask_sizes:
            rows[name] = self._mask(name, info, len(vectors))
        return TensorDict(rows, batch_size=[len(vectors)]).to(self._device), is_batch

    def _vectors(self, observation: Any) -> tuple[np.ndarray, bool]:
        try:
            given = np.asarray(observation)
            if given.dtype.kind not in "biuf":
                raise TypeError("not made of real numbers")
            vectors = np.array(given, np.float32)
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"the observation must hold {self.num_entries} numbers, but is {observation!r:.80}"
            ) from error
        if vectors.ndim not in (1, 2) or vectors.shape[-1] != self.num_entries or not vectors.size:
            expected = f"[{self.num_entries}] or [N, {self.num_entries}]"
            raise ValueError(f"the observation has shape {list(vectors.shape)}, but must have {expected}")
        if not np.isfinite(vectors).all():
            raise ValueError(f"entry {int(np.argwhere(~np.isfinite(vectors))[0][-1])} of the observation is not finite")
        return vectors.reshape(-1, self.num_entries), vectors.ndim == 2

    def _mask(self, name: str, info: Mapping[str, Any] | None, num: int) -> Tensor:
        if info is None or name not in info:
            raise ValueError(f"the problem forbids some choices, so give the info of the step with its {name}")
        size = self._mask_sizes[name]
        mask = np.asarray(info[name])
        if mask.shape not in ((num, size), (size,) if num == 1 else (num, size)) or not np.isin(mask, (0, 1)).all():
            raise ValueError(f"{name} must be 0 or 1 in shape [{num}, {size}], but is {info[name]!r:.80}")
        return checked_mask(name, mask.reshape(num, size))

    def write(self, acted: TensorDictBase, *, is_batch: bool) -> Any:
        """Return the action of `GymnasiumForm.write`."""
        discrete, parameters = (acted.get(key).cpu().numpy() for key in (keys.DISCRETE, keys.PARAMETERS))
        own = np.split(parameters, self._ends, axis=-1)
        if not is_batch:
            discrete, own = discrete[0], [each[0] for each in own]
        if not self._has_option:
            return discrete, tuple(own)
        option = acted.get(keys.OPTION).cpu().numpy()
        return (option if is_batch else option[0]), discrete, tuple(own)


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
