"""Train Stable-Baselines3's PPO on the flattened Box.

python experiments/own_problems/sb3_ppo.py PROBLEM raw|normalised|informed|same SEED FILE CPU_SECONDS
    writes the curve to a csv file.

The action is one Box: a score for each choice beside all numbers; the largest score chooses. `raw` has the defaults.
`normalised` wraps the environment in VecNormalize, which scales observations and rewards. `informed` also has what
hpamdp's defaults know of such problems: the time limit ends the episode, a discount of 0.997, a lambda of 0.98, and
several copies. `same` also has the copies, batches, epochs and networks of hpamdp's defaults.
"""

from __future__ import annotations

import sys
from pathlib import Path

import gymnasium
import numpy as np
from gymnasium.spaces import Box, flatten, flatten_space
from problems import EPISODE_SEEDS, PROBLEMS
from protocol import Clock
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from torch import nn

GAMMA = 0.997
GAE_LAMBDA = 0.98
NUM_COPIES, STEPS = 8, 256  # as many steps in a batch as the defaults had


class EndsAtLimit(gymnasium.Wrapper):
    """Ends episodes at the time limit, so that nothing is expected after it."""

    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated or truncated, False, info


class Flat(gymnasium.Wrapper):
    """Flattens observations, and takes scores of the choices beside numbers from -1 to 1, as SB3 advises."""

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        space = env.action_space
        choice, numbers = (space["mode"], space["power"]) if "mode" in getattr(space, "spaces", ()) else space.spaces
        self.num_choices = int(choice.n)
        self.boxes = numbers.spaces if hasattr(numbers, "spaces") else [numbers]
        self.is_shared = numbers is self.boxes[0]
        num_numbers = sum(box.shape[0] for box in self.boxes)
        self.action_space = Box(-1.0, 1.0, (self.num_choices + num_numbers,), np.float32)
        self.observation_space = flatten_space(env.observation_space)

    def reset(self, **given):
        observation, info = self.env.reset(**given)
        return flatten(self.env.observation_space, observation), info

    def step(self, action):
        choice = int(np.argmax(action[: self.num_choices]))
        numbers, start = [], self.num_choices
        for box in self.boxes:
            end = start + box.shape[0]
            numbers.append(box.low + 0.5 * (action[start:end] + 1.0) * (box.high - box.low))
            start = end
        amount = numbers[0] if self.is_shared else tuple(numbers)
        is_dict = isinstance(self.env.action_space, gymnasium.spaces.Dict)
        observation, *others = self.env.step({"mode": choice, "power": amount} if is_dict else (choice, amount))
        return flatten(self.env.observation_space, observation), *others


class Scorer(BaseCallback):
    """Score the agent while it learns, and end training when its time is over."""

    def __init__(self, name: dict, file: Path, limit: float) -> None:
        super().__init__()
        self.envs = [Flat(PROBLEMS[name["problem"]]()) for _ in EPISODE_SEEDS]
        self.clock = Clock(self.score, name, file, limit)

    def score(self) -> float:
        """Return the mean return of the greedy agent in the fixed episodes."""
        seen = np.stack([env.reset(seed=seed)[0] for env, seed in zip(self.envs, EPISODE_SEEDS, strict=True)])
        total, is_running = np.zeros(len(seen)), np.ones(len(seen), bool)
        while is_running.any():
            scaled = self.training_env.normalize_obs(seen) if isinstance(self.training_env, VecNormalize) else seen
            actions, _ = self.model.predict(scaled, deterministic=True)
            for row in np.flatnonzero(is_running):
                seen[row], reward, terminated, truncated, _ = self.envs[row].step(actions[row])
                total[row] += reward
                is_running[row] = not (terminated or truncated)
        return float(total.mean())

    def _on_step(self) -> bool:
        # Between two updates, as the learners of hpamdp are scored.
        num_copies = self.training_env.num_envs
        is_first = self.num_timesteps % (num_copies * self.model.n_steps) == num_copies
        is_between = is_first and self.num_timesteps > num_copies
        return not (is_between and self.clock.after(self.num_timesteps))

    def end(self) -> None:
        """Score the last agent, and write the file."""
        self.clock.after(self.num_timesteps, is_over=True)
        self.clock.write()


def main(problem: str, form: str, seed: int, file: Path, limit: float) -> None:
    """Train and score."""
    settings = {}
    if form in ("informed", "same"):
        num_copies = NUM_COPIES if form == "informed" else 16
        copies = DummyVecEnv([lambda: Monitor(EndsAtLimit(Flat(PROBLEMS[problem]())))] * num_copies)
        env, settings = VecNormalize(copies, gamma=GAMMA), {"gamma": GAMMA, "gae_lambda": GAE_LAMBDA, "n_steps": STEPS}
        if form == "same":
            settings |= {"n_steps": 64, "batch_size": 128, "n_epochs": 5}
            settings["policy_kwargs"] = {"net_arch": [128, 128], "activation_fn": nn.ReLU}
    else:
        env = DummyVecEnv([lambda: Monitor(Flat(PROBLEMS[problem]()))])
        env = VecNormalize(env) if form == "normalised" else env
    name = {"problem": problem, "library": "sb3", "player": f"ppo {form}", "seed": seed, "limit_s": limit}
    scorer = Scorer(name, file, limit)
    PPO("MlpPolicy", env, seed=seed, device="cpu", **settings).learn(10**9, callback=scorer)
    scorer.end()


if __name__ == "__main__":
    problem, form, seed, file, seconds = sys.argv[1:]
    main(problem, form, int(seed), Path(file), float(seconds))
