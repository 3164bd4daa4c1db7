"""Helpers to act in Goal and Hard Goal: actions, states to start from, recorded episodes."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from batched_players import action
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


class Trace:
    """The recorded episodes of Goal or Hard Goal, all of them side by side.

    Args:
        domain: `goal` or `hard_goal`.
        dtype: of all tensors.
    """

    def __init__(self, domain: str, dtype: torch.dtype) -> None:
        folder = os.environ.get("HPAMDP_TRACES")
        file = Path(folder or ".", "domains", f"{domain}.json")
        if folder is None or not file.exists():
            pytest.skip("HPAMDP_TRACES names no folder with domains/")
        self._recorded = json.loads(file.read_text())
        self._aim = AIMS[domain]
        self.dtype = dtype
        self.episodes = self._recorded["episodes"]

    def bodies(self, states: Sequence[Sequence[float]]) -> list[Tensor]:
        """Return the COLUMNS of recorded states, `[M]` each."""
        columns = dict(zip(self._recorded["state_names"], zip(*states, strict=False), strict=False))
        return [torch.tensor(columns[name], dtype=self.dtype) for name in rules.COLUMNS]

    def state(self, states: Sequence[Sequence[float]]) -> GoalState:
        """Return recorded states as those of `[M]` environments."""
        steps = torch.tensor([state[-1] for state in states], dtype=torch.int32)
        return GoalState(*self.bodies(states), steps, torch.zeros_like(steps), torch.zeros_like(steps))

    def tensor(self, values: Sequence[Any]) -> Tensor:
        return torch.tensor(values, dtype=self.dtype)

    def aim(self, steps: Sequence[Mapping[str, Any]]) -> rules.Aim:
        """Return what is aimed at in recorded steps, `[M]`."""
        own = self.tensor([(*step["parameters"], 0.0)[:2] for step in steps])
        return self._aim(torch.tensor([step["action"] for step in steps]), own)

    def play(self, state: GoalState, steps: Sequence[Mapping[str, Any]]) -> tuple[GoalState, Tensor, Tensor]:
        """Return the states after recorded actions, the rewards and the ticks, `[M]` each."""
        draws = [self.tensor(step["draws"]).reshape(-1, rules.NUMBERS_PER_TICK) for step in steps]
        drawn = torch.nn.utils.rnn.pad_sequence(draws)
        drawn = torch.cat([drawn, drawn.new_zeros(16, *drawn.shape[1:])]).transpose(1, 2)  # [T, 6, M]
        after, ticks = rules.act(
            state,
            self.aim(steps),
            torch.ones(len(steps), dtype=torch.bool),
            lambda ticks, rows: drawn[ticks.long()][:, :, rows],
        )
        return after, rules.reward(state, after), ticks

    def check(
        self, steps: Sequence[Mapping[str, Any]], played: tuple[GoalState, Tensor, Tensor], tolerance: float
    ) -> None:
        """Assert that the recorded steps ended as these did."""
        after, reward, ticks = played
        bodies = torch.stack(after[: len(rules.COLUMNS)])
        expected = torch.stack(self.bodies([step["state"] for step in steps]))
        for name, got, recorded in (
            ("state", bodies, expected),
            ("observation", rules.observe(after, is_scaled=False), self.tensor([s["observation"] for s in steps])),
            ("reward", reward, self.tensor([step["reward"] for step in steps])),
        ):
            torch.testing.assert_close(got, recorded, rtol=0.0, atol=tolerance, msg=lambda text, n=name: f"{n}: {text}")
        assert ticks.tolist() == [step["ticks"] for step in steps]
        assert after.steps.tolist() == [step["state"][-1] for step in steps]
        assert after.outcome.tolist() == [OUTCOME_CODES[step["outcome"]] for step in steps]
        flags = [(step["terminated"], step["truncated"]) for step in steps]
        is_late = after.outcome == rules.TIME_LIMIT
        is_over = after.outcome != rules.PLAYING
        assert list(zip((is_over & ~is_late).tolist(), is_late.tolist(), strict=True)) == flags
