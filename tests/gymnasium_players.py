"""How tests make GymnasiumEnv of toy environments and act in it."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from toy_environments import FORMS

from hpamdp import keys
from hpamdp.env.gymnasium.environment import GymnasiumEnv

TOY = "toy_environments:Toy"


def make(num_envs: int = 1, *, form: str = "nested", max_steps: int | None = 6, **options) -> GymnasiumEnv:
    kwargs = {"form": form, **options.pop("kwargs", {})}
    options = {"entry_point": TOY, "parameter_dims": FORMS[form][1], "observation_scaling": "none", **options}
    return GymnasiumEnv(num_envs, kwargs=kwargs, max_steps=max_steps, **options)


def action(env: GymnasiumEnv, pressed, parameters) -> TensorDict:
    press = {"discrete": torch.as_tensor(pressed), "parameters": torch.as_tensor(parameters, dtype=torch.float32)}
    return TensorDict({"action": TensorDict(press, env.batch_size)}, env.batch_size)


def step(env: GymnasiumEnv, pressed=None, parameters=None) -> TensorDict:
    """Press the first key, or those given, and return what comes of it."""
    n = env.num_envs
    pressed = torch.zeros(n, dtype=torch.int64) if pressed is None else pressed
    parameters = torch.zeros(n, sum(env.parameter_dims)) if parameters is None else parameters
    return env.step(action(env, pressed, parameters))["next"]


def reset_rows(env: GymnasiumEnv, after: TensorDict, mask: list[bool]) -> TensorDict:
    return env.reset(after.exclude(keys.REWARD).set("_reset", torch.tensor(mask).unsqueeze(-1)))
