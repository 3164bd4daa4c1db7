"""A TorchRL environment as a Gymnasium environment, so that it is learned like any other one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from tensordict import NestedKey, TensorDictBase, unravel_key
from torchrl.data import Binary, Bounded, Categorical, MultiCategorical, MultiOneHot, OneHot, TensorSpec, Unbounded
from torchrl.envs import EnvBase, FrameSkipTransform, MultiAction, StepCounter, TransformedEnv
from torchrl.envs.utils import step_mdp

from hpamdp.settings import SettingError


class FromTorchRL(gymnasium.Env):
    """Step a single TorchRL environment, of batch size `()` or `(1,)`, on NumPy values.

    The action is the space of the only leaf of the action spec, or a `Dict` of all leaves: a `Discrete` for
    `Categorical` and `OneHot`, a `MultiDiscrete` for their multiple forms, a `MultiBinary` for `Binary`, a `Box` for
    `Bounded`. The observation is a `Dict` of all observed leaves, `action_mask` included. Leaves in nested tensordicts
    are called `OUTER_INNER`. If a step has several rewards, as with `MultiAction`, their sum counts.

    The environment has a state of torch's random numbers of its own, because many environments draw from the global
    generator, or seed it. So the seed of `reset` decides these numbers, too, and those of the run stay as they are.

    TorchRL's own `register_gym` takes a single action leaf and no seed.

    Attributes:
        own_time_limit: that of its `StepCounter` transforms, the lowest one; None if there is none.

    Raises:
        SettingError: it steps several environments at once, a spec has no such space, or a transform loses what happens
            at the end of an episode.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 (Gymnasium's own declaration)

    def __init__(self, env: EnvBase) -> None:
        num_envs = env.batch_size.numel()
        if num_envs != 1:
            raise SettingError(
                f"steps {num_envs} environments at once; give a single one, of which num_envs makes copies"
            )
        _refuse_lost_ends(env)
        self._env = env
        self._specs = {key: env.full_action_spec[key] for key in env.action_keys}
        parts = {_name(key): _space(key, spec, env.batch_dims) for key, spec in self._specs.items()}
        self.action_space = spaces.Dict(parts) if len(parts) > 1 else next(iter(parts.values()))
        self._observed = list(env.observation_keys)
        observed = {_name(key): _space(key, env.full_observation_spec[key], env.batch_dims) for key in self._observed}
        self.observation_space: spaces.Dict = spaces.Dict(observed)
        counters = [each for each in _transforms(env) if isinstance(each, StepCounter)]
        limits = [each.max_steps for each in counters if each.max_steps is not None]
        self.own_time_limit = min(limits, default=None)
        self._random_state: torch.Tensor | None = None
        self._state: TensorDictBase | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode. The first reset without a seed takes a random one."""
        if seed is not None or self._random_state is None:
            self._seed(int(self.np_random.integers(2**31)) if seed is None else seed)
        with self._own_random_numbers():
            self._state = self._env.reset()
        return self._observation(self._state), {}

    def _seed(self, seed: int) -> None:
        devices = range(torch.cuda.device_count()) if torch.cuda.is_initialized() else ()
        with torch.random.fork_rng(devices):
            torch.default_generator.manual_seed(seed)
            self._env.set_seed(seed)
            self._random_state = torch.get_rng_state()

    @contextmanager
    def _own_random_numbers(self) -> Iterator[None]:
        """Let torch draw the environment's random numbers on the CPU while the block runs."""
        with torch.random.fork_rng(()):
            assert self._random_state is not None
            torch.set_rng_state(self._random_state)
            yield
            self._random_state = torch.get_rng_state()

    @torch.no_grad()
    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take a step.

        Raises:
            ResetNeeded: no episode has begun.
        """
        if self._state is None:
            raise gymnasium.error.ResetNeeded("step: call reset first")
        for key, spec in self._specs.items():
            value = np.asarray(action[_name(key)] if len(self._specs) > 1 else action)
            self._state.set(key, spec.encode(value).reshape(spec.shape))
        with self._own_random_numbers():
            stepped = self._env.step(self._state)["next"]
        self._state = step_mdp(self._state)
        reward = float(sum(stepped[key].sum() for key in self._env.reward_keys))
        terminated = bool(stepped["terminated"].any())
        truncated = bool(stepped["done"].any()) and not terminated
        return self._observation(stepped), reward, terminated, truncated, {}

    def _observation(self, td: TensorDictBase) -> dict[str, np.ndarray]:
        named = {_name(key): td[key] for key in self._observed}
        return {
            name: value.cpu().numpy().reshape(space.shape).astype(space.dtype)
            for (name, value), space in zip(named.items(), self.observation_space.values(), strict=True)
        }

    def close(self) -> None:
        """Close the environment."""
        if not self._env.is_closed:
            self._env.close()


def _name(key: NestedKey) -> str:
    key = unravel_key(key)
    return key if isinstance(key, str) else "_".join(key)


def _space(key: NestedKey, spec: TensorSpec, batch_dims: int) -> spaces.Space:
    """Return the space of a leaf, without the batch dimensions, which are of size 1."""
    if isinstance(spec, MultiCategorical | MultiOneHot):
        return spaces.MultiDiscrete(torch.as_tensor(spec.nvec).flatten().numpy())
    if isinstance(spec, Binary):
        return spaces.MultiBinary(max(1, spec.shape.numel()))
    if isinstance(spec, OneHot | Categorical):
        if isinstance(spec, Categorical) and spec.shape.numel() > 1:
            return spaces.MultiDiscrete(np.full(spec.shape.numel(), spec.space.n))
        return spaces.Discrete(int(spec.space.n))
    shape = tuple(spec.shape[batch_dims:])
    if isinstance(spec, Bounded):
        low, high = (side.cpu().numpy().reshape(shape) for side in (spec.space.low, spec.space.high))
        return spaces.Box(low, high, dtype=low.dtype)
    if not isinstance(spec, Unbounded):
        raise SettingError(f"{_name(key)}: a {type(spec).__name__} spec has no space of Gymnasium")
    is_picture = spec.dtype == torch.uint8
    return spaces.Box(0, 255, shape, np.uint8) if is_picture else spaces.Box(-np.inf, np.inf, shape, np.float32)


def _transforms(env: EnvBase) -> Iterator[torch.nn.Module]:
    """Yield all transforms of an environment, from the outermost on."""
    while isinstance(env, TransformedEnv):
        yield from env.transform.modules()
        env = env.base_env


def _refuse_lost_ends(env: EnvBase) -> None:
    """Refuse transforms that, in TorchRL 0.14.1, lose what happens at the end of an episode."""
    for each in _transforms(env):
        if isinstance(each, FrameSkipTransform) and each.frame_skip > 1:
            raise SettingError(
                "FrameSkipTransform steps through the end of an episode; repeat actions in the environment"
            )
        if isinstance(each, MultiAction) and not each.stack_rewards:
            raise SettingError("MultiAction loses the reward of an episode's last step; set stack_rewards=True")
