"""Train XuanCe's P-DQN or MP-DQN on hpamdp's Platform, with XuanCe's own settings for Platform.

python experiments/peers/xuance_platform.py pdqn|mpdqn SEED FILE [CPU_SECONDS]    writes the curve to a csv file
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

import torch
import xuance
from gymnasium import spaces
from protocol import CPU_LIMIT, Curve
from tensordict import TensorDictBase
from xuance.common import BaseCallback, get_arguments
from xuance.torch.agents import REGISTRY_Agents

import hpamdp
from hpamdp import keys

MOST_STEPS = 10**9  # the time ends the training


class Platform:
    """hpamdp's Platform with the methods and spaces that XuanCe's learners for parameterised actions expect."""

    num_envs = 1
    max_episode_steps = 200

    def __init__(self, seed: int) -> None:
        self._env = hpamdp.make_gymnasium("platform")
        self._seed: int | None = seed
        self.observation_space = spaces.Tuple((self._env.observation_space, spaces.Discrete(201)))
        self.action_space = self._env.action_space

    def reset(self):
        """Begin an episode. Only the first one has a seed."""
        observation, info = self._env.reset(seed=self._seed)
        self._seed = None
        return observation, info

    def step(self, action):
        """Return `(observation, steps), reward, done, info`. XuanCe treats a time limit as a termination."""
        observation, reward, terminated, truncated, info = self._env.step(action)
        return (observation, info["steps"]), reward, terminated or truncated, info

    def close(self) -> None:
        """Close the environment."""
        self._env.close()


class OutOfTimeError(Exception):
    """End the training loop of XuanCe."""


class Clock(BaseCallback):
    """Score XuanCe's agent while it learns."""

    curve: Curve

    def on_train_step_end(self, current_step: int, **kwargs) -> None:
        """Score the agent if it is due.

        Raises:
            OutOfTimeError: the time is over.
        """
        if self.curve.after(current_step):
            raise OutOfTimeError


class Greedy:
    """The discrete action of the highest value, without the random ones, and its parameters."""

    def __init__(self, agent) -> None:
        self.policy = agent.policy
        self.low = torch.tensor([float(low[0]) for low in agent.action_low])
        self.size = torch.tensor([float(size[0]) for size in agent.action_range])

    def __call__(self, td: TensorDictBase) -> TensorDictBase:
        """Write the action. The parameters of XuanCe's actor lie in [-1, 1]."""
        observation = td.get(keys.OBSERVATION)
        parameters = self.policy.con_action(observation)
        td.set(keys.DISCRETE, self.policy.Qeval(observation, parameters).argmax(-1))
        return td.set(keys.PARAMETERS, self.low + self.size * (parameters + 1.0) / 2.0)


def main(learner: str, seed: int, file: Path, limit: float) -> None:
    """Train and score."""
    torch.set_num_threads(1)
    config = get_arguments(learner, "Platform", "Platform-v0")
    config.seed = config.env_seed = seed
    config.device, config.parallels, config.logger = "cpu", 1, "tensorboard"
    agent = REGISTRY_Agents[config.agent](config, Platform(seed))
    # P-DQN's constructor would pass the callback on as the observation space.
    agent.callback = clock = Clock()
    name = {"library": "xuance", "version": xuance.__version__.lstrip("v"), "learner": learner, "seed": seed}
    clock.curve = Curve("platform", {"greedy": Greedy(agent)}, name, file, limit)
    clock.curve.begin()
    try:
        agent.train(MOST_STEPS)
    except OutOfTimeError:
        clock.curve.end(agent.current_step)


if __name__ == "__main__":
    target = Path(sys.argv[3]).absolute()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)  # XuanCe writes its logs into the working directory
        main(sys.argv[1], int(sys.argv[2]), target, float(sys.argv[4]) if len(sys.argv) > 4 else CPU_LIMIT)
