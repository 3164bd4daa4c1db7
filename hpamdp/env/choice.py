"""The high level alone: the controller-choice MDP, one transition an episode, over a low level that plays it out."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs.utils import ExplorationType, set_exploration_type

from hpamdp import keys
from hpamdp.env.base import PAMDPEnv


class OptionChoiceEnv(PAMDPEnv):
    """Choose an option, see the episode's return: an ordinary environment with one discrete action.

    The action is `option` int64 `[N]`; every step plays the episode to its end with the low-level policy, greedily, and
    is terminal. Reward is the episode's return; what else the environment observes says how it ended.

    Args:
        low_policy: writes the action leaves from `observation` and `option`.
        env: the environment with a choice of options, such as boats with `controller="choose"`.

    Raises:
        ValueError: the environment leaves no choice.
    """

    def __init__(self, low_policy: TensorDictModuleBase, env: PAMDPEnv) -> None:
        if not env.has_choice:
            raise ValueError('ControllerChoiceEnv: the environment leaves no choice; boats need controller="choose"')
        super().__init__(device=env.device, batch_size=env.batch_size)
        # In a tuple: an nn.Module attribute would register the policy's parameters as the environment's own.
        self._low = (low_policy, env)
        self.option_names, self.parameter_dims = env.option_names, env.parameter_dims
        self.max_steps, self.result_keys = 1, env.result_keys
        self.observation_spec = env.observation_spec.clone()
        self.action_spec = Composite(option=env.full_action_spec[keys.OPTION].clone(), shape=env.batch_size)
        self.reward_spec = Unbounded(shape=(*env.batch_size, 1), device=env.device)
        self.done_spec = self.make_done_spec()

    def fixed_episodes(self, seed: int) -> TensorDict | None:
        """Return those of the environment."""
        return self._low[1].fixed_episodes(seed)

    def results(self, last: TensorDictBase) -> dict[str, Tensor]:
        """Return how episodes went."""
        return self._low[1].results(last)

    def env_state(self) -> dict[str, Tensor]:
        """Return the environment's."""
        return self._low[1].env_state()

    def set_env_state(self, columns: Mapping[str, Tensor]) -> None:
        """Set the environment's."""
        self._low[1].set_env_state(columns)

    def _set_seed(self, seed: int | None) -> None:
        self._low[1].set_seed(seed)

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        env = self._low[1]
        return env._reset(tensordict).select(*self.observation_spec.keys(True, True))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        policy, env = self._low
        option = tensordict.get(keys.OPTION)
        # After a partial reset the other episodes are over already: they stay so and earn nothing.
        td = tensordict.select(*self.observation_spec.keys(True, True))
        total = torch.zeros(*env.batch_size, 1, device=env.device)
        with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
            for _ in range(env.max_steps):
                td = env._step(policy(td.set(keys.OPTION, option)))
                total = total + td.get(keys.REWARD)
                if td.get(keys.DONE).all():
                    break
        over = torch.ones_like(td.get(keys.DONE))
        flags = {keys.DONE: over, keys.TERMINATED: over.clone(), keys.TRUNCATED: torch.zeros_like(over)}
        return td.select(*self.observation_spec.keys(True, True)).update({keys.REWARD: total, **flags})
