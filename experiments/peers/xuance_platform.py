"""Train XuanCe's P-DQN or MP-DQN on hpamdp's Platform.

python experiments/peers/xuance_platform.py pdqn|mpdqn SEED STEPS    prints a row of results.csv
"""

from __future__ import annotations

import sys
import time

import torch
import xuance
from gymnasium import spaces
from scoring import score
from xuance.common import get_arguments
from xuance.torch.agents import REGISTRY_Agents

import hpamdp


class Platform:
    """hpamdp's Platform with the methods and spaces that XuanCe's learners for parameterised actions expect."""

    num_envs = 1
    max_episode_steps = 200

    def __init__(self, config) -> None:
        self._env = hpamdp.make_gymnasium("platform")
        self._seed = config.env_seed
        self.observation_space = spaces.Tuple((self._env.observation_space, spaces.Discrete(201)))
        self.action_space = self._env.action_space

    def reset(self):
        observation, info = self._env.reset(seed=self._seed)
        self._seed = None
        return observation, info

    def step(self, action):
        """Return `(observation, steps), reward, done, info`. XuanCe treats a time limit as a termination."""
        observation, reward, terminated, truncated, info = self._env.step(action)
        return (observation, info["steps"]), reward, terminated or truncated, info

    def close(self) -> None:
        self._env.close()


def greedy(agent):
    """Return a function from observations to greedy actions. XuanCe's parameters lie in [-1, 1]."""
    agent.epsilon = 0.0

    def act(observation):
        discrete, parameters, _ = agent.get_actions(observation)
        _, own = agent.pad_action(discrete, parameters)
        own[discrete] = agent.action_range[discrete] * (own[discrete] + 1.0) / 2.0 + agent.action_low[discrete]
        return discrete, tuple(own)

    return act


def main(learner: str, seed: int, steps: int) -> None:
    torch.set_num_threads(1)
    config = get_arguments(learner, "Platform", "Platform-v0")
    config.seed = config.env_seed = seed
    config.device, config.running_steps, config.parallels, config.logger = "cpu", steps, 1, "tensorboard"
    agent = REGISTRY_Agents[config.agent](config, Platform(config))
    began = time.process_time()
    agent.train(steps)
    cpu_s = time.process_time() - began
    scores = score(greedy(agent))
    print("xuance", xuance.__version__.lstrip("v"), learner, steps, seed, *scores.values(), round(cpu_s, 1), sep=",")


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:4]))
