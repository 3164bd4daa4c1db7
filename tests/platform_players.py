"""Helpers to act in Platform: actions, policies, episodes, and states to start from."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from hpamdp import keys
from hpamdp.env.platform.environment import PlatformEnv
from hpamdp.env.platform.rules import HOP, RUN

COURSE = 1035.0
BOUNDS = torch.tensor([30.0, 720.0, 430.0])


def action(discrete, parameter) -> TensorDict:
    """Return actions: `discrete` is a list or `[N]`, `parameter` has a number for each environment or is `[N, 3]`."""
    discrete = torch.as_tensor(discrete)
    parameter = torch.as_tensor(parameter, dtype=torch.float32)
    parameter = parameter if parameter.ndim == 2 else parameter.unsqueeze(-1).expand(-1, 3)
    leaves = TensorDict(discrete=discrete, parameters=parameter, batch_size=[len(discrete)])
    return TensorDict({keys.ACTION: leaves}, batch_size=[len(discrete)])


def act(env: PlatformEnv, discrete, parameter) -> TensorDictBase:
    return env.step(action(discrete, parameter))["next"]


def random_action(env: PlatformEnv, generator: torch.Generator) -> TensorDict:
    discrete = torch.randint(3, (env.num_envs,), generator=generator)
    return action(discrete, BOUNDS * torch.rand(env.num_envs, 3, generator=generator))


def rule(observation: Tensor) -> TensorDict:
    """Hop over each enemy, then run up to each gap and hop across it."""
    x = (observation[:, 0] + 1.0) / 2.0 * (COURSE + 20.0) - 20.0
    speed = (observation[:, 1] + 1.0) / 2.0 * 100.0
    discrete = torch.full_like(x, RUN, dtype=torch.long)
    parameter = torch.full_like(x, 30.0)
    for mask, chosen, value in (
        ((x >= 40.0) & (x < 150.0), HOP, 0.0),
        ((x >= 150.0) & (x <= 250.0), RUN, ((246.0 - x) / 10.0).clamp(min=0.0)),
        ((x >= 150.0) & (x <= 250.0) & (speed > 20.0), HOP, 720.0),
        ((x >= 455.0) & (x < 580.0), HOP, 720.0),
        ((x >= 640.0) & (x < 700.0), RUN, 0.0),
        ((x >= 700.0) & (x <= 750.0), HOP, 720.0),
    ):
        discrete = torch.where(mask, chosen, discrete)
        parameter = torch.where(mask, value, parameter)
    return action(discrete, parameter)


def play(
    env: PlatformEnv, policy: Callable[[Tensor], TensorDict], num_steps: int = 50
) -> tuple[TensorDictBase, Tensor]:
    """Reset and take steps; return what the last one returned and the sums of rewards `[N]`."""
    td = env.reset()
    total = torch.zeros(env.num_envs)
    for _ in range(num_steps):
        td = env.step(policy(td[keys.OBSERVATION]))["next"]
        total = total + td[keys.REWARD].squeeze(-1)
    return td, total


def place(env: PlatformEnv, **columns: Tensor | float) -> None:
    """Change columns of the state, such as where agents and enemies are."""
    state = env.env_state()
    for name, value in columns.items():
        state[name] = torch.as_tensor(value).expand(env.num_envs)
    env.set_env_state(state)


def random_columns(num: int, generator: torch.Generator) -> dict[str, Tensor]:
    """Sample agents on the platforms and up to 4 px beyond, often near the right edge, and enemies, often at theirs."""

    def uniform(low, high) -> Tensor:
        return low + (high - low) * torch.rand(num, generator=generator)

    platform = torch.randint(3, (num,), generator=generator)
    left = torch.tensor([0.0, 455.0, 965.0])[platform]
    right = torch.tensor([254.0, 754.0, 1034.0])[platform]
    x = torch.where(uniform(0.0, 1.0) < 0.3, right - uniform(0.0, 45.0), uniform(left, right))
    enemy_left = torch.where(x > 475.0, 475.0, 0.0)
    enemy_right = torch.where(x > 475.0, 730.0, 230.0)
    enemy_x = uniform(enemy_left - 20.0, enemy_right + 20.0).clamp(enemy_left, enemy_right)
    steps = torch.randint(150, (num,), generator=generator, dtype=torch.int32)
    episode = torch.randint(150, (num,), generator=generator, dtype=torch.int32)
    return {
        "x": x,
        "speed": uniform(0.0, 70.0),
        "enemy_x": enemy_x,
        "enemy_speed": uniform(-30.0, 30.0),
        "steps": steps,
        "episode": episode,
    }
