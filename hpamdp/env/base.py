"""What an environment tells the framework beyond TorchRL's own contract."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite
from torchrl.envs import EnvBase

from hpamdp import keys


class PAMDPEnv(EnvBase):
    """`num_envs` copies of a problem with parameterised actions, in one batch dimension.

    A subclass has the specs: `observation` float32 `[N, observation_dim]`; the action leaves `("action", "discrete")` int64
    `[N]` and `("action", "parameters")` float32 `[N, num_parameters]`, the bounded parameters of all keys side by side,
    of which only the pressed key's count; where the agent chooses options, the leaf `option` int64 `[N]`; `reward`,
    `done`, `terminated`, `truncated` `[N, 1]`, where a time limit is `truncated` only. A step leaves an episode that is
    over as it is and earns 0.
    """

    option_names: tuple[str, ...] = ()  # of the options, where there are some
    can_change_option: ClassVar[bool] = True  # whether an option may end before its episode
    parameter_dims: tuple[int, ...]  # how many parameters each key takes
    max_steps: int  # presses in the longest episode
    result_keys: ClassVar[tuple[str, ...]] = ()  # leaves of an episode's last step that `results` reads

    @property
    def has_choice(self) -> bool:
        """Whether the agent chooses an option."""
        return keys.OPTION in self.full_action_spec.keys()

    @property
    def is_shardable(self) -> bool:
        """Whether several processes can each step a share of the environments: these learn nothing from one another."""
        return True

    @property
    def position(self) -> Tensor | None:
        """Where the agents are, for drawing, `[N, 2]`; None where that means nothing."""
        return None

    def fixed_episodes(self, seed: int) -> TensorDict | None:
        """Return what to `reset` with for the evaluation episodes of a seed, one for each environment.

        None: `set_seed(seed)` and a reset without arguments are all that it takes.
        """
        return None

    def describe(self) -> dict[str, Tensor]:
        """Return what is known of the episodes that were just reset, first dimension `N`; computed once a run."""
        return {}

    def results(self, last: TensorDictBase) -> dict[str, Tensor]:
        """Return how episodes `[M]` went by their last steps' leaves `result_keys`, each `[M]`.

        A `score` takes the place of the return wherever agents are compared; `success` is bool.
        """
        return {}

    def measure(self, played: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Return means of an evaluation, whose arrays are those of `Evaluation.run`, beside score and success.

        `ceiling` is the best possible mean score on the same episodes, where that is known.
        """
        return {}

    def env_state(self) -> dict[str, Tensor]:
        """Return what episodes' future depends on, each `[N, ...]`, for a checkpoint; empty where it cannot be had."""
        return {}

    def set_env_state(self, columns: Mapping[str, Tensor]) -> None:
        """Go on where `state_columns` were taken; with none, episodes start anew.

        Raises:
            ValueError: they are of another number of environments.
        """

    def set_statistics(self, columns: Mapping[str, Tensor]) -> None:
        """Take from saved state columns what was learned of the observations' scale alone, as to score an agent."""

    def set_scaling_from(self, other: PAMDPEnv) -> None:
        """Scale observations as the other environment does, now and later, where their scale is learned."""

    def make_action_spec(self, low: Tensor, high: Tensor, *, has_option: bool = False) -> Composite:
        """Return the spec of the action leaves by the bounds `[num_parameters]` of all keys' parameters."""
        n, device = self.batch_size, self.device
        low, high = (side.to(device, torch.float32).expand(*n, -1) for side in (low, high))
        action = Composite(
            discrete=Categorical(len(self.parameter_dims), shape=n, device=device),
            parameters=Bounded(low, high, shape=low.shape, dtype=torch.float32, device=device),
            shape=n,
        )
        option = {keys.OPTION: Categorical(len(self.option_names), shape=n, device=device)} if has_option else {}
        return Composite(**option, action=action, shape=n)

    def check_action(self, tensordict: TensorDictBase) -> None:
        """Check the action leaves' shapes and types; their values are the subclass's to check.

        Raises:
            ValueError: a leaf is missing, or has another shape or type.
        """
        n = self.batch_size
        shapes = {keys.DISCRETE: n, keys.PARAMETERS: (*n, sum(self.parameter_dims))}
        for name, shape in ({**shapes, keys.OPTION: n} if self.has_choice else shapes).items():
            value = tensordict.get(name)
            if value is None or value.shape != shape:
                given = None if value is None else list(value.shape)
                raise ValueError(f"step: {name} has shape {given}, but must be {list(shape)}")
            if name != keys.PARAMETERS and (value.is_floating_point() or value.dtype == torch.bool):
                given = str(value.dtype).removeprefix("torch.")
                raise ValueError(f"step: {name} has type {given}, but must be integer")

    def make_done_spec(self) -> Composite:
        """Return the spec of `done`, `terminated` and `truncated`, bool `[N, 1]`."""
        flag = Binary(n=1, shape=(*self.batch_size, 1), dtype=torch.bool, device=self.device)
        flags = {name: flag.clone() for name in (keys.DONE, keys.TERMINATED, keys.TRUNCATED)}
        return Composite(flags, shape=self.batch_size, device=self.device)
