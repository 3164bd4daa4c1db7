"""The high level alone: the controller-choice MDP, one transition an episode, over a low level that plays it out."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase

from hpamdp import keys
from hpamdp.env.boatdock import BoatDockEnv
from hpamdp.env.episode import MAX_PRESSES


class ControllerChoiceEnv(EnvBase):
    """Choose a controller, see the episode's return: an ordinary environment with one discrete action.

    The action is `option` int64 `[N]`; every step plays the episode to its end with the low-level policy and is
    terminal. Reward is the episode's return (`outcome` and `fuel` say how it ended).

    Args:
        low_policy: writes the action leaves from `observation` and `option`; it is called under the exploration type
            and gradient mode of the caller.
        env: the boats, with `controller="choose"`.

    Raises:
        ValueError: the environment leaves no choice.
    """

    def __init__(self, low_policy: TensorDictModuleBase, env: BoatDockEnv) -> None:
        if not env.has_choice:
            raise ValueError(f'ControllerChoiceEnv: env.controller={env.rules.controller!r}, but must be "choose"')
        super().__init__(device=env.device, batch_size=env.batch_size)
        # In a tuple: an nn.Module attribute would register the policy's parameters as the environment's own.
        self._low = (low_policy, env)
        n, device = env.num_envs, env.device
        self.observation_spec = Composite(
            {name: env.observation_spec[name].clone() for name in (keys.OBSERVATION, keys.OUTCOME, keys.FUEL)},
            shape=(n,),
        )
        self.action_spec = Composite(option=env.full_action_spec[keys.OPTION].clone(), shape=(n,))
        self.reward_spec = Unbounded(shape=(n, 1), device=device)
        flag = Binary(n=1, shape=(n, 1), dtype=torch.bool, device=device)
        self.done_spec = Composite(done=flag.clone(), terminated=flag.clone(), shape=(n,))

    def _set_seed(self, seed: int | None) -> None:
        self._low[1].set_seed(seed)

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        _, env = self._low
        request = None
        if tensordict is not None:
            request = tensordict.select("_reset", "start", "goal", "keymap", strict=False)
        td = env._reset(request)
        return td.select(keys.OBSERVATION, keys.OUTCOME, keys.FUEL, keys.DONE, keys.TERMINATED)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        policy, env = self._low
        option = tensordict.get(keys.OPTION)
        # After a partial reset the other boats are over already: they stay so and earn nothing.
        td = TensorDict({keys.OBSERVATION: tensordict.get(keys.OBSERVATION)}, env.batch_size, device=env.device)
        total = torch.zeros(*env.batch_size, 1, device=env.device)
        for _ in range(MAX_PRESSES):
            td = policy(td.set(keys.OPTION, option))
            td = env._step(td)
            total = total + td.get(keys.REWARD)
            if td.get(keys.DONE).all():
                break
        seen = td.select(keys.OBSERVATION, keys.OUTCOME, keys.FUEL)
        over = torch.ones_like(td.get(keys.DONE))
        return seen.update({keys.REWARD: total, keys.DONE: over, keys.TERMINATED: over.clone()})
