"""Helpers to act in Goal and Hard Goal: actions, states to start from, recorded episodes."""

from __future__ import annotations

import itertools
import json
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from batched_players import Player, action
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.nn import functional as F

from hpamdp import keys
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


# What a look-ahead tries: points to kick to, whose y is read where that slip is repaired alone, and places on the goal
# line to shoot at.
KICKS = F.pad(torch.linspace(0.0, 40.0, 21)[:, None], (0, 3))
REPAIRED_KICKS = F.pad(torch.cartesian_prod(torch.linspace(2.0, 20.0, 10), torch.linspace(-9.0, 9.0, 7)), (0, 2))
SHOTS = F.pad(torch.linspace(-7.0, 7.0, 29)[:, None], (2, 1))
SECOND = action(torch.ones(len(SHOTS), dtype=torch.long), SHOTS)


def first_actions(env: GoalEnv) -> TensorDict:
    """Return the kicks and the shots."""
    kicks = REPAIRED_KICKS if "kick_to" in env.options.repaired else KICKS
    return torch.cat([action(torch.zeros(len(kicks), dtype=torch.long), kicks), SECOND])


def of_rows(env: GoalEnv, rows: Tensor, seed: int = 0) -> GoalEnv:
    """Return copies of some of the pitches, with noise of their own."""
    copies = GoalEnv(len(rows), repaired=env.options.repaired, seed=seed)
    copies.reset()
    copies.set_env_state({name: column[rows] for name, column in env.env_state().items()})
    return copies


def tried(env: GoalEnv, actions: TensorDict, seed: int) -> tuple[Tensor, GoalEnv]:
    """Take each of these actions `[A]` from each state `[N]` with other noise; return outcomes `[N, A]` and pitches."""
    model = of_rows(env, torch.arange(env.num_envs).repeat_interleave(len(actions)), seed)
    outcome = model.step(actions.repeat(env.num_envs))["next", keys.OUTCOME]
    return outcome.reshape(env.num_envs, len(actions)), model


def look_ahead_player(num_samples: int = 6) -> Player:
    """Return a player of the first of the two actions that score most often by the true rules.

    Where no two actions score, it takes the ball forward.
    """
    seeds = itertools.count(1000)

    def values(env: GoalEnv) -> Tensor:
        """Return the fraction of goals after each first action and the best shot that follows it, `[N, A]`."""
        outcome, model = tried(env, first_actions(env), next(seeds))
        value = (outcome == rules.GOAL).float().flatten()
        playing = (outcome.flatten() == rules.PLAYING).nonzero().squeeze(-1)
        if len(playing):
            after = of_rows(model, playing)
            goals = torch.stack([tried(after, SECOND, next(seeds))[0] == rules.GOAL for _ in range(num_samples)])
            value[playing] = goals.float().mean(0).amax(-1) + 1e-3 * after.env_state()["ball_x"]
        return value.reshape(outcome.shape)

    def act(env: GoalEnv) -> TensorDict:
        playing = (env.env_state()["outcome"] == rules.PLAYING).nonzero().squeeze(-1)
        now = of_rows(env, playing)
        best = torch.stack([values(now) for _ in range(num_samples)]).mean(0).argmax(-1)
        chosen = torch.zeros(env.num_envs, dtype=torch.long)
        chosen[playing] = best
        return first_actions(env)[chosen]

    return act


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
