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
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, flatten, flatten_space
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


class Part(NamedTuple):
    """One choice with its numbers.

    Attributes:
        num_choices: how many there are to choose from.
        boxes: of the numbers.
        is_shared: whether all choices share one Box.
    """

    num_choices: int
    boxes: list[Box]
    is_shared: bool

    @classmethod
    def of(cls, space: gymnasium.Space) -> Part:
        """Return the part that a Tuple or a Dict of a choice and of numbers makes."""
        choice, numbers = (space["mode"], space["power"]) if isinstance(space, Dict) else space.spaces
        is_shared = not hasattr(numbers, "spaces")
        return cls(int(choice.n), [numbers] if is_shared else list(numbers.spaces), is_shared)

    @property
    def size(self) -> int:
        """How many numbers an action has."""
        return self.num_choices + sum(box.shape[0] for box in self.boxes)

    def read(self, action: np.ndarray) -> tuple[int, Any]:
        """Return the choice and its numbers."""
        numbers, start = [], self.num_choices
        for box in self.boxes:
            end = start + box.shape[0]
            numbers.append(box.low + 0.5 * (action[start:end] + 1.0) * (box.high - box.low))
            start = end
        return int(np.argmax(action[: self.num_choices])), numbers[0] if self.is_shared else tuple(numbers)


class Flat(gymnasium.Wrapper):
    """Flattens vectors, and takes scores of the choices beside numbers from -1 to 1, as SB3 advises."""

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        space = env.action_space
        self.names = list(space) if isinstance(space, Dict) and "mode" not in space.spaces else None
        self.parts = [Part.of(each) for each in ([space] if self.names is None else space.values())]
        self.action_space = Box(-1.0, 1.0, (sum(part.size for part in self.parts),), np.float32)
        self.is_picture = len(getattr(env.observation_space, "shape", None) or ()) == 3
        self.observation_space = env.observation_space if self.is_picture else flatten_space(env.observation_space)

    def seen(self, observation):
        return observation if self.is_picture else flatten(self.env.observation_space, observation)

    def reset(self, **given):
        observation, info = self.env.reset(**given)
        return self.seen(observation), info

    def step(self, action):
        ends = np.cumsum([part.size for part in self.parts])[:-1]
        chosen = [part.read(numbers) for part, numbers in zip(self.parts, np.split(action, ends), strict=True)]
        native = chosen[0]
        if self.names is not None:
            native = dict(zip(self.names, chosen, strict=True))
        elif isinstance(self.env.action_space, Dict):
            native = {"mode": native[0], "power": native[1]}
        observation, *others = self.env.step(native)
        return self.seen(observation), *others


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
    is_picture = Flat(PROBLEMS[problem]()).is_picture
    if form in ("informed", "same"):
        num_copies = NUM_COPIES if form == "informed" else 16
        copies = DummyVecEnv([lambda: Monitor(EndsAtLimit(Flat(PROBLEMS[problem]())))] * num_copies)
        env = VecNormalize(copies, norm_obs=not is_picture, gamma=GAMMA)
        settings = {"gamma": GAMMA, "gae_lambda": GAE_LAMBDA, "n_steps": STEPS}
        if form == "same":
            settings |= {"n_steps": 64, "batch_size": 128, "n_epochs": 5}
            settings["policy_kwargs"] = {"net_arch": [128, 128], "activation_fn": nn.ReLU}
    else:
        env = DummyVecEnv([lambda: Monitor(Flat(PROBLEMS[problem]()))])
        if form == "normalised":
            env = VecNormalize(env, norm_obs=not is_picture)
    name = {"problem": problem, "library": "sb3", "player": f"ppo {form}", "seed": seed, "limit_s": limit}
    scorer = Scorer(name, file, limit)
    model = PPO("CnnPolicy" if is_picture else "MlpPolicy", env, seed=seed, device="cpu", **settings)
    model.learn(10**9, callback=scorer)
    scorer.end()


if __name__ == "__main__":
    problem, form, seed, file, seconds = sys.argv[1:]
    main(problem, form, int(seed), Path(file), float(seconds))
