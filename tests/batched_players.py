"""Helpers to act in any `BatchedEnv`: actions, episodes, restarts, figures."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from hpamdp import keys
from hpamdp.env.batched_env import BatchedEnv
from hpamdp.specs import PAMDPSpecs

Player = Callable[[BatchedEnv], TensorDictBase]


def action(discrete: Tensor, parameters: Tensor) -> TensorDict:
    """Return actions from discrete ones `[N]` and the parameters of all discrete actions `[N, num_parameters]`."""
    leaves = TensorDict(discrete=discrete, parameters=parameters, batch_size=[len(discrete)])
    return TensorDict({keys.ACTION: leaves}, batch_size=[len(discrete)])


def random_player(seed: int = 0) -> Player:
    """Return a player of uniformly random discrete actions with uniformly random parameters."""
    generator = torch.Generator().manual_seed(seed)

    def act(env: BatchedEnv) -> TensorDict:
        specs = PAMDPSpecs.from_env(env)
        discrete = torch.randint(specs.num_discrete, (env.num_envs,), generator=generator)
        unit = 2.0 * torch.rand(env.num_envs, specs.num_parameters, generator=generator) - 1.0
        return action(discrete, specs.from_unit(unit))

    return act


def play(env: BatchedEnv, player: Player, num_steps: int | None = None) -> tuple[TensorDictBase, Tensor]:
    """Reset and take steps; return what the last one returned and the sums of rewards `[N]`."""
    reading = env.reset()
    total = torch.zeros(env.num_envs)
    for _ in range(num_steps or env.max_steps):
        reading = env.step(player(env))["next"]
        total = total + reading[keys.REWARD].squeeze(-1)
        if reading[keys.DONE].all():
            break
    return reading, total


def restart(env: BatchedEnv, reading: TensorDictBase, mask: Tensor) -> TensorDictBase:
    """Start new episodes in the rows of `mask` `[N]`."""
    return env.reset(reading.clone().set("_reset", mask.unsqueeze(-1)))


def snapshot(env: BatchedEnv) -> dict[str, Tensor]:
    """Return copies of the columns of the state."""
    return {name: column.clone() for name, column in env.env_state().items()}


def is_unchanged(env: BatchedEnv, before: dict[str, Tensor], rows: Tensor | slice = slice(None)) -> bool:
    """Return whether the state is as `snapshot` found it, in these rows."""
    return all(torch.equal(now[rows], before[name][rows]) for name, now in env.env_state().items())


def agrees(values: Tensor, known: float, error: float) -> bool:
    """Return whether a mean is within two standard errors, the known figure's and ours, of the known one."""
    return abs(values.mean().item() - known) <= 2.0 * (error + values.std().item() / math.sqrt(len(values)))
