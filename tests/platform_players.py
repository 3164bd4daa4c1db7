"""How tests act in Platform: actions, policies, episodes, and agents put elsewhere."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from hpamdp import keys
from hpamdp.env.platform.environment import HOP, RUN, PlatformEnv

COURSE = 1035.0
BOUNDS = torch.tensor([30.0, 720.0, 430.0])


def action(key, parameter) -> TensorDict:
    """Build an action of every environment: `key` a list or `[N]`, `parameter` one number each or `[N, 3]`."""
    key, parameter = torch.as_tensor(key), torch.as_tensor(parameter, dtype=torch.float32)
    parameter = parameter if parameter.ndim == 2 else parameter.unsqueeze(-1).expand(-1, 3)
    press = TensorDict(discrete=key, parameters=parameter, batch_size=[len(key)])
    return TensorDict({keys.ACTION: press}, batch_size=[len(key)])


def act(env: PlatformEnv, key, parameter) -> TensorDictBase:
    return env.step(action(key, parameter))["next"]


def random_action(env: PlatformEnv, generator: torch.Generator) -> TensorDict:
    key = torch.randint(3, (env.num_envs,), generator=generator)
    return action(key, BOUNDS * torch.rand(env.num_envs, 3, generator=generator))


def rule(observation: Tensor) -> TensorDict:
    """Hop over each enemy, then run up to each gap and hop across it."""
    x, speed = (observation[:, 0] + 1.0) / 2.0 * (COURSE + 20.0) - 20.0, (observation[:, 1] + 1.0) / 2.0 * 100.0
    key, parameter = torch.full_like(x, RUN, dtype=torch.long), torch.full_like(x, 30.0)
    for case, pressed, value in (
        ((x >= 40.0) & (x < 150.0), HOP, 0.0),
        ((x >= 150.0) & (x <= 250.0), RUN, ((246.0 - x) / 10.0).clamp(min=0.0)),
        ((x >= 150.0) & (x <= 250.0) & (speed > 20.0), HOP, 720.0),
        ((x >= 455.0) & (x < 580.0), HOP, 720.0),
        ((x >= 640.0) & (x < 700.0), RUN, 0.0),
        ((x >= 700.0) & (x <= 750.0), HOP, 720.0),
    ):
        key, parameter = torch.where(case, pressed, key), torch.where(case, value, parameter)
    return action(key, parameter)


def play(env: PlatformEnv, policy: Callable[[Tensor], TensorDict], most: int = 50) -> tuple[TensorDictBase, Tensor]:
    """Play every environment's episode from a reset; return the last reading and the returns `[N]`."""
    td, total = env.reset(), torch.zeros(env.num_envs)
    for _ in range(most):
        td = env.step(policy(td[keys.OBSERVATION]))["next"]
        total = total + td[keys.REWARD].squeeze(-1)
    return td, total


def place(env: PlatformEnv, **columns: Tensor | float) -> None:
    """Put the agents and enemies elsewhere."""
    state = env.env_state()
    given = {name: torch.as_tensor(value).expand(env.num_envs) for name, value in columns.items()}
    env.set_env_state({**state, **given})


def random_columns(num: int, generator: torch.Generator) -> dict[str, Tensor]:
    """Draw agents on the platforms and up to 4 px beyond, often near the right edge, and enemies, often at theirs."""

    def uniform(low, high) -> Tensor:
        return low + (high - low) * torch.rand(num, generator=generator)

    platform = torch.randint(3, (num,), generator=generator)
    left, right = torch.tensor([0.0, 455.0, 965.0])[platform], torch.tensor([254.0, 754.0, 1034.0])[platform]
    x = torch.where(uniform(0.0, 1.0) < 0.3, right - uniform(0.0, 45.0), uniform(left, right))
    enemy_left = torch.where(x > 475.0, 475.0, 0.0)
    enemy_right = torch.where(x > 475.0, 730.0, 230.0)
    enemy_x = uniform(enemy_left - 20.0, enemy_right + 20.0).clamp(enemy_left, enemy_right)
    steps, episode = (torch.randint(150, (num,), generator=generator, dtype=torch.int32) for _ in range(2))
    columns = {"x": x, "speed": uniform(0.0, 70.0), "enemy_x": enemy_x, "enemy_speed": uniform(-30.0, 30.0)}
    return {**columns, "steps": steps, "episode": episode}
