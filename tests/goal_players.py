"""Helpers to act in Goal and Hard Goal: actions, states to start from, recorded episodes."""

from __future__ import annotations

from collections.abc import Callable

import torch
from batched_players import action
from tensordict import TensorDictBase
from torch import Tensor

from hpamdp.env.goal.environment import GoalEnv
from hpamdp.specs import PAMDPSpecs


def act(env: GoalEnv, discrete: list[int], own: list[list[float]]) -> TensorDictBase:
    """Step with the parameters of each chosen action."""
    parameters = torch.zeros(env.num_envs, sum(env.parameter_dims))
    for row, (chosen, values) in enumerate(zip(discrete, own, strict=True)):
        first = sum(env.parameter_dims[:chosen])
        parameters[row, first : first + len(values)] = torch.tensor(values)
    return env.step(action(torch.tensor(discrete), parameters))["next"]


def place(env: GoalEnv, **columns: Tensor | float) -> None:
    """Change columns of the state, such as where the bodies are."""
    state = dict(env.env_state())
    for name, value in columns.items():
        state[name] = torch.as_tensor(value).expand(env.num_envs).to(state[name].dtype)
    env.set_env_state(state)


def trained_player(env: GoalEnv) -> Callable[[TensorDictBase], TensorDictBase]:
    """Return random discrete actions with the published initial parameters."""
    weights, bias = GoalEnv().initial_parameters()
    specs = PAMDPSpecs.from_env(env)
    generator = torch.Generator().manual_seed(0)

    def play(reading: TensorDictBase) -> TensorDictBase:
        unit = reading["observation"] @ weights.T + bias
        discrete = torch.randint(3, (env.num_envs,), generator=generator)
        return action(discrete, specs.from_unit(unit))

    return play
