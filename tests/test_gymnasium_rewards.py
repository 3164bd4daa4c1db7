"""Rewards of training are scaled if asked; those of evaluations never are."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch
from gymnasium_players import make, step
from toy_environments import Toy

import hpamdp
from hpamdp.env.errors import ProblemError
from hpamdp.env.gymnasium.environment import GymnasiumEnv
from hpamdp.env.gymnasium.scaling import RewardScaling


def steps(env: GymnasiumEnv, num: int) -> np.ndarray:
    """Return the rewards of steps with resets in between, `[num, N]`."""
    rewards = []
    env.reset()
    for _ in range(num):
        after = step(env)
        rewards.append(after["reward"].squeeze(-1).double().numpy())
        env.maybe_reset(after)
    return np.stack(rewards)


def test_rewards_are_divided_by_the_deviation_of_the_discounted_returns_so_far():
    plain, scaled = (steps(make(2, max_steps=3, reward_scaling=gamma), 7) for gamma in (None, 0.5))
    returns, so_far = np.zeros(2), []
    for number, rewards in enumerate(plain):
        returns = rewards + (0.0 if number % 3 == 0 else 0.5) * returns
        so_far.extend(returns)
        deviation = np.std(so_far)
        expected = rewards / (deviation if deviation > 1e-6 else 1.0)
        assert np.allclose(scaled[number], expected.clip(-10.0, 10.0), atol=1e-5)


def test_returns_in_training_have_the_unit_of_those_in_evaluations():
    sizes = {"total_frames": 64, "num_envs": 2, "steps_per_batch": 8, "eval.layouts": 2}
    sizes |= {"max_steps": 3, "staggered": False, "low.minibatch_size": 16}

    class Shown(hpamdp.Callback):
        def on_end(self, trainer):
            assert trainer.recorder.training_return == 2.0 * 3  # which the bar shows

    for more in ({}, {"observation_scaling": "running"}):
        given = {**sizes, **more, "callbacks": [Shown()]}
        history = hpamdp.train(
            lambda: Toy(), low="hppo", high="none", reward_scaling=0.9, progress=False, **given
        ).history
        assert history[-1]["train/return"] == history[-1]["train/score"] == history[-1]["eval/return"] == 2.0 * 3


def test_a_line_says_that_the_greedy_agent_takes_one_discrete_action_only(capfd):
    class Idle(hpamdp.Callback):
        def on_batch(self, trainer):
            trainer.parts.agent.learners[0].actor.discrete_head.bias.data[1] = 100.0

    sizes = {"total_frames": 64, "num_envs": 2, "steps_per_batch": 8, "eval.layouts": 2, "low.minibatch_size": 16}
    hpamdp.train(lambda: Toy(), low="hppo", high="none", progress=True, max_steps=3, callbacks=[Idle()], **sizes)
    assert "the agent took discrete action 1 at every step of the evaluation" in "".join(capfd.readouterr())


def test_an_evaluation_reports_rewards_as_they_are():
    env = make(2, max_steps=3, reward_scaling=0.9)
    env.seed_evaluation(0)
    assert np.array_equal(steps(env, 3), steps(make(2, max_steps=3), 3))


def test_the_statistics_of_rewards_are_saved_and_restored():
    one, other = (make(2, max_steps=3, reward_scaling=0.9, observation_scaling="running") for _ in range(2))
    steps(one, 5)
    other.set_env_state(one.env_state())
    assert len(one.env_state()) == 6
    assert all(torch.equal(column, one.env_state()[name]) for name, column in other.env_state().items())


def test_a_reward_that_comes_once_in_a_long_episode_is_clipped_only_by_the_limit_that_is_given():
    for clip, least in ((10.0, 10.0), (100.0, 15.0)):
        scaling = RewardScaling(1, 0.9, clip)
        for reward in [0.0] * 399 + [1.0]:
            seen = scaling.scaled(np.array([reward]), np.ones(1, bool))
        assert least <= seen[0] <= clip


@pytest.mark.parametrize("reward", [float("inf"), float("nan"), 1e300])
def test_a_reward_that_cannot_be_scaled_is_refused(reward):
    scaling = RewardScaling(2, 0.9)
    with pytest.raises(ProblemError, match=r"step returned the reward .*, which reward_scaling cannot scale"):
        scaling.scaled(np.array([1.0, reward]), np.ones(2, bool))
    assert np.isfinite(scaling.statistics.var).all()


@pytest.mark.parametrize("reward", [1e300, -1e39])
def test_a_reward_beyond_float32_is_refused_in_one_line_without_a_warning_of_numpy(reward, recwarn, monkeypatch):
    env = make(2, max_steps=3, reward_scaling=None)
    env.reset()
    monkeypatch.setattr(Toy, "step", lambda self, action: (self._observation(), np.float64(reward), False, False, {}))
    with pytest.raises(
        ProblemError, match=rf"Toy: environment 0: step returned the reward {re.escape(f'{reward:g}')}, .* float32"
    ):
        step(env)
    assert not [warning for warning in recwarn if issubclass(warning.category, RuntimeWarning)]
