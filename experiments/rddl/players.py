"""Train hpamdp's H-PPO, or PPO of Stable-Baselines3, on a domain of RDDL with their defaults, or play at random.

python experiments/rddl/players.py DOMAIN hppo|ppo|random SEED FILE CPU_SECONDS
    writes the curve to a csv file.

PPO has VecNormalize and a flat Box: a score for each value of each choice beside all numbers. The largest one chooses.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

import hpamdp
from experiments.own_problems.protocol import Clock
from hpamdp.env.gymnasium.action_spaces import ActionSpace
from hpamdp.env.rddl.problem import RDDLProblem

EPISODE_SEEDS = list(range(7_000_000, 7_000_020))
# Bounds of the fluents that a domain leaves unbounded.
SETTINGS: dict[str, dict[str, Any]] = {
    "SupplyChain_or": {"bounds": {"ship": [0, 100]}},
    "Zombies_arcade": {"bounds": {"x_move": [-1, 1], "y_move": [-1, 1]}},
}


class Flat(gymnasium.ActionWrapper):
    """Takes scores of the values of all choices, and numbers from -1 to 1, as one Box."""

    def __init__(self, domain: str) -> None:
        super().__init__(RDDLProblem(domain=domain, **SETTINGS.get(domain, {})))
        self.space = ActionSpace(self.env.action_space)
        self.sizes = self.space.component_sizes or (len(self.space.parameter_dims),)
        num = sum(self.sizes) + len(self.space.low)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (num,), np.float32)

    def action(self, action: np.ndarray) -> Any:
        """Return the action of the problem."""
        *scores, numbers = np.split(action, np.cumsum(self.sizes))
        chosen = np.array([[score.argmax() for score in scores]])
        values = self.space.low + 0.5 * (numbers + 1.0) * (self.space.high - self.space.low)
        return self.space.to_native(chosen[:, 0] if len(self.sizes) == 1 else chosen, values[None])[0]


def mean_return(envs: Sequence[gymnasium.Env], act: Callable[[list[np.ndarray]], Sequence[Any]]) -> float:
    """Return the mean return of the fixed episodes, in which `act` maps observations to actions."""
    seen = [env.reset(seed=seed)[0] for env, seed in zip(envs, EPISODE_SEEDS, strict=True)]
    total, is_running = np.zeros(len(envs)), np.ones(len(envs), bool)
    while is_running.any():
        actions = act(seen)
        for row in np.flatnonzero(is_running):
            seen[row], reward, terminated, truncated, _ = envs[row].step(actions[row])
            total[row] += reward
            is_running[row] = not (terminated or truncated)
    return float(total.mean())


def train_hppo(domain: str, name: dict, seed: int, file: Path, limit: float) -> None:
    """Train H-PPO with its defaults."""
    from experiments.own_problems.hpamdp_learner import Scorer  # with torch, which PPO's time does not pay for

    problem = {"name": "rddl", "domain": domain, **SETTINGS.get(domain, {})}
    scorer = Scorer(EPISODE_SEEDS, name, file, limit)
    hpamdp.train(problem, low="hppo", seed=seed, progress=False, callbacks=[scorer])


def train_ppo(domain: str, name: dict, seed: int, file: Path, limit: float) -> None:
    """Train PPO of Stable-Baselines3 with its defaults."""
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    env = VecNormalize(DummyVecEnv([lambda: Monitor(Flat(domain))]))
    model = PPO("MlpPolicy", env, seed=seed, device="cpu")
    envs = [Flat(domain) for _ in EPISODE_SEEDS]

    def act(seen: list[np.ndarray]) -> np.ndarray:
        return model.predict(env.normalize_obs(np.stack(seen)), deterministic=True)[0]

    clock = Clock(lambda: mean_return(envs, act), name, file, limit)

    class Scorer(BaseCallback):
        def _on_step(self) -> bool:
            is_between = self.num_timesteps % model.n_steps == 1 and self.num_timesteps > 1
            return not (is_between and clock.after(self.num_timesteps))

    model.learn(10**9, callback=Scorer())
    clock.after(model.num_timesteps, is_over=True)
    clock.write()


def play(domain: str, name: dict, seed: int, file: Path) -> None:
    """Score random play."""
    envs = [RDDLProblem(domain=domain, **SETTINGS.get(domain, {})) for _ in EPISODE_SEEDS]
    for number, env in enumerate(envs):
        env.action_space.seed(seed + number)
    clock = Clock(lambda: mean_return(envs, lambda _: [env.action_space.sample() for env in envs]), name, file, 0.0)
    clock.after(0, is_over=True)
    clock.write()


def main(domain: str, player: str, seed: int, file: Path, limit: float) -> None:
    """Train or play, and score."""
    library = {"hppo": "hpamdp", "ppo": "sb3"}.get(player, "")
    name = {"problem": domain, "library": library, "player": player, "seed": seed, "limit_s": limit}
    if player == "random":
        play(domain, name, seed, file)
        return
    {"hppo": train_hppo, "ppo": train_ppo}[player](domain, name, seed, file, limit)


if __name__ == "__main__":
    given_domain, given_player, given_seed, given_file, seconds = sys.argv[1:]
    main(given_domain, given_player, int(given_seed), Path(given_file), float(seconds))
