"""Helpers to act in Goal and Hard Goal: actions, states to start from, recorded episodes."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from counter_players import action
from tensordict import TensorDictBase
from torch import Tensor

from hpamdp.env.goal import rules
from hpamdp.env.goal.environment import GoalEnv
from hpamdp.env.goal.rules import GoalState
from hpamdp.specs import PAMDPSpecs

AIMS = {"goal": rules.goal_aim, "hard_goal": rules.hard_goal_aim}
OUTCOME_CODES = {"": rules.PLAYING, "goal": rules.GOAL, "caught": rules.CAUGHT, "out": rules.OUT}
OUTCOME_CODES["limit"] = rules.TIME_LIMIT


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


class RecordedStep(NamedTuple):
    """A step of a trace, with what is set before it and what has to come out."""

    label: str
    before: list[float]
    aim: rules.Aim
    draws: Tensor
    expected: dict[str, Any]


class Trace:
    """The recorded episodes of Goal or Hard Goal.

    Args:
        domain: `goal` or `hard_goal`.
        dtype: of all tensors.
    """

    def __init__(self, domain: str, dtype: torch.dtype) -> None:
        folder = os.environ.get("HPAMDP_TRACES")
        file = Path(folder or ".", "domains", f"{domain}.json")
        if folder is None or not file.exists():
            pytest.skip("HPAMDP_TRACES names no folder with domains/")
        self.recorded = json.loads(file.read_text())
        self.domain = domain
        self.dtype = dtype

    def state(self, values: list[float]) -> GoalState:
        """Return the state of one environment."""
        named = dict(zip(self.recorded["state_names"], values, strict=True))
        columns = [torch.tensor([named[name]], dtype=self.dtype) for name in rules.COLUMNS]
        counters = torch.zeros(1, dtype=torch.int32)
        return GoalState(*columns, counters + int(named["time"]), counters, counters)

    def bodies(self, values: list[float]) -> Tensor:
        """Return the COLUMNS `[14]` of a recorded state."""
        named = dict(zip(self.recorded["state_names"], values, strict=False))
        return torch.tensor([named[name] for name in rules.COLUMNS], dtype=self.dtype)

    def episodes(self) -> Iterator[tuple[dict[str, Any], list[RecordedStep]]]:
        """Yield the starts of the episodes with their steps."""
        for episode in self.recorded["episodes"]:
            before = episode["initial"]["state"]
            steps = []
            for number, step in enumerate(episode["steps"]):
                own = torch.zeros(1, 2, dtype=self.dtype)
                own[0, : len(step["parameters"])] = torch.tensor(step["parameters"], dtype=self.dtype)
                aim = AIMS[self.domain](torch.tensor([step["action"]]), own)
                draws = torch.tensor(step["draws"], dtype=self.dtype).reshape(-1, rules.NUMBERS_PER_TICK)
                label = f"{episode['policy']}, seed {episode['seed']}, step {number}"
                steps.append(RecordedStep(label, before, aim, draws, step))
                before = step["state"]
            yield episode["initial"], steps


def replay(state: GoalState, step: RecordedStep) -> tuple[GoalState, Tensor, Tensor]:
    """Return the state after a recorded action, its reward and its ticks, `[1]` each."""
    drawn = torch.cat([step.draws, torch.zeros(64, rules.NUMBERS_PER_TICK, dtype=step.draws.dtype)])

    def numbers(ticks: Tensor, rows: Tensor) -> Tensor:
        return drawn[ticks.long()].unsqueeze(-1).expand(-1, -1, len(rows))

    after, ticks = rules.act(state, step.aim, torch.tensor([True]), numbers)
    return after, rules.reward(state, after), ticks


