"""The high level alone, as an environment: one step is one whole episode, played by a fixed low-level policy."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.data import Composite, Unbounded
from torchrl.envs.utils import ExplorationType

from hpamdp import keys
from hpamdp.acting import acting
from hpamdp.env.base import PAMDPEnv

# Methods of the wrapped environment, which has the episodes.
_OF_THE_EPISODES = (
    *("fixed_episodes", "seed_evaluation", "warn_if_seed_is_ignored", "results", "file_checksums"),
    *("env_state", "check_env_state", "set_env_state"),
    *("statistics", "set_statistics", "take_new_statistics", "add_statistics"),
)


class OptionChoiceEnv(PAMDPEnv):
    """Choose an option and receive the episode's return: an ordinary environment with one discrete action.

    The action is `option` int64 `[N]`. A step plays the episode to its end with the greedy low-level policy, and
    terminates. Its reward is the episode's discounted return, and its observation is that of the episode's last step.

    Args:
        low_policy: policy that writes the action leaves, given `observation` and `option`.
        env: an environment in which the agent chooses options.
        gamma: discount of a step of `env`.

    Raises:
        ValueError: the environment has no option to choose.
    """

    def __init__(self, low_policy: TensorDictModuleBase, env: PAMDPEnv, gamma: float = 1.0) -> None:
        if not env.has_choice:
            raise ValueError("OptionChoiceEnv: the environment has no option to choose")
        super().__init__(device=env.device, batch_size=env.batch_size)
        # In a tuple: as attributes, the modules' parameters would be registered as the environment's own.
        self._wrapped = (low_policy, env)
        for name in _OF_THE_EPISODES:
            setattr(self, name, getattr(env, name))
        self.gamma = gamma
        self.option_names = env.option_names
        self.parameter_dims = env.parameter_dims
        self.max_steps = 1
        self.result_keys = env.result_keys
        self.observation_spec = env.observation_spec.clone()
        self.action_spec = Composite(option=env.full_action_spec[keys.OPTION].clone(), shape=env.batch_size)
        self.reward_spec = Unbounded(shape=(*env.batch_size, 1), device=env.device, dtype=torch.float32)
        self.done_spec = self.make_done_spec()

    @property
    def _low_policy(self) -> TensorDictModuleBase:
        return self._wrapped[0]

    @property
    def inner_env(self) -> PAMDPEnv:
        """The wrapped environment."""
        return self._wrapped[1]

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Close the wrapped environment, too."""
        if not self.inner_env.is_closed:
            self.inner_env.close()
        super().close(raise_if_closed=raise_if_closed)

    @property
    def keeps_episodes(self) -> bool:
        """Whether the environment's `env_state` holds its episodes."""
        return self.inner_env.keeps_episodes

    def _set_seed(self, seed: int | None) -> None:
        self.inner_env.set_seed(seed)

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        return self._observed(self.inner_env._reset(tensordict))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        option = tensordict.get(keys.OPTION)
        td = self._observed(tensordict)
        total = torch.zeros(*self.batch_size, 1, device=self.device, dtype=torch.float32)
        # The policy's memory. A step of the environment alone would drop it.
        state_keys = getattr(self._low_policy, "state_keys", [])
        # Episodes that a partial reset did not start again are over: they stay unchanged, with reward 0.
        with acting(ExplorationType.DETERMINISTIC), torch.no_grad():
            for step in range(self.inner_env.max_steps):
                acted = self._low_policy(td.set(keys.OPTION, option))
                td = self.inner_env._step(acted)
                td.update(acted.select(*state_keys))
                total = total + self.gamma**step * td.get(keys.REWARD)
                if td.get(keys.DONE).all():
                    break
        done = torch.ones_like(td.get(keys.DONE))
        return self._observed(td).update(
            {
                keys.REWARD: total,
                keys.DONE: done,
                keys.TERMINATED: done.clone(),
                keys.TRUNCATED: torch.zeros_like(done),
            }
        )

    def _observed(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return only the entries of the observation spec."""
        return tensordict.select(*self.observation_spec.keys(True, True))
