"""Train DI-engine's H-PPO on hpamdp's Moving, with DI-engine's own settings for gym-hybrid's Moving.

python experiments/peers/di_engine_moving.py SEED FILE [CPU_SECONDS]    writes the curve to a csv file
"""

from __future__ import annotations

import os
import sys
import tempfile
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import Any

import ding
import gym
import numpy as np
import torch
from ding.config import compile_config
from ding.envs import BaseEnv, BaseEnvTimestep, create_env_manager
from ding.envs.common import affine_transform
from ding.policy import create_policy
from ding.utils import set_pkg_seed
from ding.worker import BaseLearner, create_serial_collector
from dizoo.gym_hybrid.config.gym_hybrid_hppo_config import create_config, main_config
from easydict import EasyDict
from protocol import CPU_LIMIT, Curve
from tensorboardX import SummaryWriter
from tensordict import TensorDictBase
from torch import Tensor

import hpamdp
from hpamdp import keys


def settings() -> tuple[EasyDict, EasyDict]:
    """Return DI-engine's own settings, without CUDA.

    The environments run in the learner's process (`base`) instead of in one process each (`subprocess`). So all CPU
    time is that of one process.
    """
    main, create = deepcopy(main_config), deepcopy(create_config)
    main.policy.cuda = False
    create.env.import_names = []  # it would import gym_hybrid
    create.env_manager.type = "base"
    create.policy.type = "ppo_command"  # as `ding.entry.serial_pipeline_onpolicy` calls it
    return main, create


class Moving(BaseEnv):
    """hpamdp's Moving in DI-engine's form: what `dizoo.gym_hybrid.envs.GymHybridEnv` does for gym-hybrid's Moving."""

    config = EasyDict(env_id="Moving-v0", act_scale=True)

    def __init__(self, cfg: Any) -> None:
        self._env = hpamdp.make_gymnasium("moving")
        self._seed = 0
        self._has_dynamic_seed = True
        self._return = 0.0
        bounds = (-np.inf, np.inf)
        self._observation_space = gym.spaces.Box(*bounds, shape=(10,), dtype=np.float32)
        self._action_space = gym.spaces.Tuple((gym.spaces.Discrete(3), gym.spaces.Box(-1.0, 1.0, shape=(2,))))
        self._reward_space = gym.spaces.Box(*bounds, shape=(1,), dtype=np.float32)

    def seed(self, seed: int, dynamic_seed: bool = True) -> None:
        """Set the seed. A dynamic seed gives each episode another one, as in DI-engine's own environment."""
        self._seed, self._has_dynamic_seed = seed, dynamic_seed
        np.random.seed(seed)

    def reset(self) -> np.ndarray:
        """Begin an episode and return the observation float32 `[10]`."""
        seed = self._seed + (100 * np.random.randint(1, 1000) if self._has_dynamic_seed else 0)
        self._return = 0.0
        return self._env.reset(seed=int(seed))[0]

    def step(self, action: dict[str, Any]) -> BaseEnvTimestep:
        """Act. The parameters are clipped to [-1, 1], then scaled to their bounds."""
        push = affine_transform(action["action_args"][0], min_val=0, max_val=1)
        turn = affine_transform(action["action_args"][1], min_val=-1, max_val=1)
        parameters = tuple(np.array(each, np.float32) for each in ([push], [turn], []))
        observation, reward, terminated, truncated, info = self._env.step((int(action["action_type"]), parameters))
        self._return += reward
        if terminated or truncated:
            info["eval_episode_return"] = self._return
        info["action_args_mask"] = np.array([[1, 0], [0, 1], [0, 0]])
        return BaseEnvTimestep(observation, np.array([reward], np.float32), terminated or truncated, info)

    def close(self) -> None:
        """Close the environment."""
        self._env.close()

    @property
    def observation_space(self) -> gym.spaces.Space:
        """The space of the observations."""
        return self._observation_space

    @property
    def action_space(self) -> gym.spaces.Space:
        """The space of the actions, with parameters in [-1, 1]."""
        return self._action_space

    @property
    def reward_space(self) -> gym.spaces.Space:
        """The space of the rewards."""
        return self._reward_space

    def __repr__(self) -> str:
        return "hpamdp's Moving"


class Greedy:
    """A policy without the learner's exploration.

    Args:
        model: the network of DI-engine's policy.
        draws_discrete: whether to draw the discrete action, or to take the most probable one.
        draws_parameters: whether to draw the parameters, or to take their means.
    """

    def __init__(self, model: torch.nn.Module, *, draws_discrete: bool, draws_parameters: bool) -> None:
        self.model = model
        self.draws_discrete = draws_discrete
        self.draws_parameters = draws_parameters

    def __call__(self, td: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        self.model.eval()
        logit = self.model(td.get(keys.OBSERVATION), mode="compute_actor")["logit"]
        td.set(keys.DISCRETE, self._discrete(logit["action_type"]))
        mean, deviation = logit["action_args"]["mu"], logit["action_args"]["sigma"]
        sampled = torch.normal(mean, deviation) if self.draws_parameters else mean
        push, turn = sampled.clamp(-1.0, 1.0).unbind(-1)
        return td.set(keys.PARAMETERS, torch.stack([(push + 1.0) / 2.0, turn], -1))

    def _discrete(self, logits: Tensor) -> Tensor:
        if self.draws_discrete:
            return torch.distributions.Categorical(logits=logits).sample()
        return logits.argmax(-1)


def main(seed: int, file: Path, limit: float) -> None:
    """Train as `ding.entry.serial_pipeline_onpolicy` does, but for its own evaluations."""
    torch.set_num_threads(1)
    main_cfg, create_cfg = settings()
    cfg = compile_config(main_cfg, seed=seed, env=Moving, auto=True, create_cfg=create_cfg, save_cfg=True)
    env = create_env_manager(cfg.env.manager, [partial(Moving, cfg=cfg.env)] * cfg.env.collector_env_num)
    env.seed(cfg.seed)
    set_pkg_seed(cfg.seed, use_cuda=False)
    policy = create_policy(cfg.policy, enable_field=["learn", "collect", "eval", "command"])
    logger = SummaryWriter(os.path.join(cfg.exp_name, "log", "serial"))
    learner = BaseLearner(cfg.policy.learn.learner, policy.learn_mode, logger, exp_name=cfg.exp_name)
    collector = create_serial_collector(
        cfg.policy.collect.collector, env=env, policy=policy.collect_mode, tb_logger=logger, exp_name=cfg.exp_name
    )
    form = partial(Greedy, policy._model)
    policies = {
        "most probable": form(draws_discrete=False, draws_parameters=False),
        "sampled": form(draws_discrete=True, draws_parameters=False),
        "all sampled": form(draws_discrete=True, draws_parameters=True),
    }
    name = {"library": "di-engine", "version": ding.__version__.lstrip("v"), "learner": "hppo", "seed": seed}
    curve = Curve("moving", policies, name, file, limit)
    learner.call_hook("before_run")
    curve.begin()
    while not curve.after(collector.envstep):
        learner.train(collector.collect(train_iter=learner.train_iter), collector.envstep)
    curve.end(collector.envstep)


if __name__ == "__main__":
    target = Path(sys.argv[2]).absolute()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)  # DI-engine writes its logs into the working directory
        main(int(sys.argv[1]), target, float(sys.argv[3]) if len(sys.argv) > 3 else CPU_LIMIT)
