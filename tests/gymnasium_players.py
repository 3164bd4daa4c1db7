"""Helpers to make GymnasiumEnv from toy environments and to act in it."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from toy_environments import FORMS

from hpamdp import keys
from hpamdp.env.gymnasium.environment import GymnasiumEnv

TOY = "toy_environments:Toy"


def make(num_envs: int = 1, *, form: str = "nested", max_steps: int | None = 6, **options) -> GymnasiumEnv:
    """Return copies of Toy with an action space of this form; `options` override the arguments of GymnasiumEnv."""
    kwargs = {"form": form, **options.pop("kwargs", {})}
    arguments = {"entry_point": TOY, "parameter_dims": FORMS[form][1], "observation_scaling": "none", **options}
    return GymnasiumEnv(num_envs, kwargs=kwargs, max_steps=max_steps, **arguments)


def action(env: GymnasiumEnv, discrete, parameters) -> TensorDict:
    td = TensorDict(batch_size=env.batch_size)
    td[keys.DISCRETE] = torch.as_tensor(discrete)
    td[keys.PARAMETERS] = torch.as_tensor(parameters, dtype=torch.float32)
    return td


def step(env: GymnasiumEnv, discrete=None, parameters=None) -> TensorDict:
    """Take an action, by default the first discrete one with parameters 0, and return what follows."""
    n = env.num_envs
    discrete = torch.zeros(n, dtype=torch.int64) if discrete is None else discrete
    parameters = torch.zeros(n, sum(env.parameter_dims)) if parameters is None else parameters
    return env.step(action(env, discrete, parameters))["next"]


def reset_rows(env: GymnasiumEnv, after: TensorDict, mask: list[bool]) -> TensorDict:
    return env.reset(after.exclude(keys.REWARD).set("_reset", torch.tensor(mask).unsqueeze(-1)))
