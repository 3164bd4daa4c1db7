"""Hybrid LunarLander has the dynamics of Gymnasium's continuous LunarLander, with two components."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

pytest.importorskip("Box2D")

from gymnasium.envs.box2d.lunar_lander import heuristic
from torchrl.envs.utils import check_env_specs

from hpamdp import keys
from hpamdp.env.lunar_lander.environment import LunarLanderEnv
from hpamdp.env.lunar_lander.lander import HybridLunarLander, continuous_action, hybrid_action
from hpamdp.env.registration import register
from hpamdp.specs import PAMDPSpecs

register()


def test_it_has_two_components_whose_engines_have_throttles():
    specs = PAMDPSpecs.from_env(LunarLanderEnv(1))
    assert specs.component_sizes == (2, 3) and specs.parameter_dims == (0, 1, 0, 1, 1)
    assert specs.parameter_low == (0.5,) * 3 and specs.parameter_high == (1.0,) * 3


def test_all_tensors_are_as_the_specs_say():
    check_env_specs(LunarLanderEnv(2), return_contiguous=True)


@pytest.mark.parametrize("seed", [0, 1])
def test_an_episode_is_that_of_the_continuous_form_with_the_same_engines(seed):
    hybrid, continuous = gymnasium.make("hpamdp/LunarLander-v0"), gymnasium.make("LunarLanderContinuous-v3")
    seen, same = hybrid.reset(seed=seed)[0], continuous.reset(seed=seed)[0]
    is_over, total = False, 0.0
    while not is_over:
        given = np.asarray(heuristic(continuous, same), np.float32)
        action = hybrid_action(given)
        assert hybrid.action_space.contains(action)
        seen, reward, terminated, truncated, info = hybrid.step(action)
        same, expected, *flags, _ = continuous.step(given)
        np.testing.assert_allclose(seen, same, atol=1e-4)
        assert reward == pytest.approx(expected, abs=1e-3) and flags == [terminated, truncated]
        total += reward
        is_over = terminated or truncated
        assert info["is_success"] == (total >= 200.0)
    assert total >= 200.0


def test_every_chosen_engine_fires_even_at_its_lowest_throttle():
    generator = np.random.default_rng(0)
    env = gymnasium.make("hpamdp/LunarLander-v0")
    assert env.spec.max_episode_steps == LunarLanderEnv.Options().max_steps
    space = env.action_space
    space.seed(0)
    for _ in range(100):
        action = space.sample()
        for of_part in (action["main"][1][1], *action["side"][1][1:]):
            of_part[:] = generator.choice([0.5, 0.75, 1.0])
        lift, push = continuous_action(action)
        main, side = int(action["main"][0]), int(action["side"][0])
        assert (lift > 0.0) == bool(main) and (abs(push) > 0.5) == bool(side)
        assert side == 0 or (np.sign(push) == (-1.0 if side == 1 else 1.0))
        power = 0.5 * (lift + 1.0) if main else None
        assert power is None or power == pytest.approx(action["main"][1][1][0], abs=1e-5)


@pytest.mark.parametrize(
    ("main", "side", "throttle", "line"),
    [
        (0, -1, 0.5, "side: discrete=-1, but allowed are 0 to 2"),
        (1, 0, np.nan, "main: the parameters of action 1 are .nan., but must be finite"),
    ],
)
def test_an_action_that_does_not_exist_is_refused_in_one_line(main, side, throttle, line):
    none, box = np.zeros(0, np.float32), np.array([throttle], np.float32)
    with pytest.raises(ValueError, match=f"^step: {line}$"):
        continuous_action({"main": (main, (none, box)), "side": (side, (none, box, box))})


def test_no_step_is_taken_before_an_episode_begins_or_after_it_ended():
    lander = HybridLunarLander()
    action = hybrid_action(np.array([0.0, 0.0]))
    with pytest.raises(gymnasium.error.ResetNeeded):
        lander.step(action)
    lander.reset(seed=0)
    while not any(lander.step(action)[2:4]):
        pass
    with pytest.raises(gymnasium.error.ResetNeeded):
        lander.step(action)


def test_the_hand_written_player_is_shown_with_the_rules_for_which_it_was_measured_alone():
    assert {*LunarLanderEnv(1).references({})} == {"solved", "heuristic"}
    for settings in ({"gravity": -5.0}, {"enable_wind": True}, {"max_steps": 100}):
        assert {*LunarLanderEnv(1, **settings).references({})} == {"solved"}


def test_copies_have_episodes_of_their_own_and_the_settings_reach_them():
    env = LunarLanderEnv(3, gravity=-5.0, enable_wind=True)
    assert {copy.unwrapped.gravity for copy in env.envs} == {-5.0} and env.envs[0].unwrapped.enable_wind
    assert len(set(env.reset()[keys.OBSERVATION][:, 0].tolist())) == 3


def test_watch_names_the_setting_with_which_it_is_drawn_before_it_plays(command, monkeypatch):
    monkeypatch.setattr(LunarLanderEnv, "step", lambda *_: pytest.fail("it was played"))
    code, _, err = command("watch", "env=lunar_lander", "high=none", "low=random", "--episodes", "2")
    assert code == 2 and err == "env=lunar_lander: has no pictures to film; use env.render=true\n"
