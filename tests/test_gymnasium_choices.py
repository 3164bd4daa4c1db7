"""Gymnasium environments that forbid actions, that have options, or whose actions are a OneOf."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from gymnasium_players import action
from torchrl.envs.utils import check_env_specs

from hpamdp import keys
from hpamdp.env.base import ProblemError
from hpamdp.env.gymnasium.environment import GymnasiumEnv
from hpamdp.specs import PAMDPSpecs


def make(num_envs: int = 1, *, form: str = "plain", source: str = "none", mask: object = None, **options):
    kwargs = {"form": form, "source": source, "mask": mask}
    entry_point = "toy_masked_gymnasium:Masked"
    return GymnasiumEnv(num_envs, entry_point=entry_point, kwargs=kwargs, max_steps=5, **options)


@pytest.mark.parametrize(("source", "setting"), [("info", "info"), ("observation", None)])
def test_a_mask_comes_from_the_info_or_from_the_observation(source, setting):
    env = make(2, source=source, action_mask=setting)
    specs = PAMDPSpecs.from_env(env)
    assert specs.has_action_mask and specs.observation_dim == 1
    assert env.reset()[keys.ACTION_MASK].tolist() == [[False, True]] * 2
    after = env.step(action(env, [1, 0], torch.zeros(2, 2)))["next"]
    assert after[keys.ACTION_MASK].tolist() == [[True, False], [False, True]]
    check_env_specs(env)


def test_an_entry_that_is_asked_for_is_observed_as_well():
    env = make(source="observation", observation_keys=["action_mask", "place"])
    assert PAMDPSpecs.from_env(env).has_action_mask and env.reset()[keys.OBSERVATION].shape == (1, 3)


def test_a_mask_can_be_ignored():
    for source in ("info", "observation"):
        env = make(source=source, action_mask="ignore")
        env.reset()
        assert not PAMDPSpecs.from_env(env).has_action_mask


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (
            {"source": "info"},
            "gave an action_mask in its info; set env.action_mask=info to honour it, or env.action_mask=i",
        ),
        ({"action_mask": "info"}, "gave None as action_mask, which must be 2 numbers, 0 or 1"),
        (
            {"source": "info", "action_mask": "info", "mask": [0.0, -1e9]},
            r"gave \[0\.0, -1000000000\.0\] as action_mask, ",
        ),
        (
            {"source": "info", "action_mask": "info", "mask": [1, float("nan")]},
            r"gave \[1, nan\] as action_mask, which ",
        ),
        ({"source": "info", "action_mask": "info", "mask": [1]}, r"gave \[1\] as action_mask, which must be 2 numbers"),
    ],
)
def test_a_mask_that_is_not_what_was_set_is_told_in_one_line(options, complaint):
    with pytest.raises(ProblemError, match=rf"^GymnasiumEnv: toy_masked_gymnasium:Masked: environment 0: {complaint}"):
        make(**options).reset()


def test_a_mask_that_allows_nothing_is_told_in_one_line():
    env = make(2, source="info", action_mask="info", mask=np.zeros(2))
    with pytest.raises(ProblemError, match="Masked: environment 0 gave an action_mask that allows nothing"):
        env.reset()


@pytest.mark.parametrize("form", ["dict", "flat dict", "tuple"])
def test_an_option_of_the_action_space_is_chosen_by_the_agent(form):
    env = make(2, form=form, option_key=0 if form == "tuple" else None)
    specs = PAMDPSpecs.from_env(env)
    assert specs.option_names == ("slow", "medium", "fast") and specs.num_discrete == 2
    check_env_specs(env)
    env.reset()
    env.step(action(env, [0, 1], [[0.5, 0.0], [0.0, -0.5]]).set(keys.OPTION, torch.tensor([0, 2])))
    first, second = (copy.unwrapped.actions[-1] for copy in env.envs)
    expected = {
        "dict": lambda option, pair: {"option": option, "action": pair},
        "flat dict": lambda option, pair: {"option": option, "kind": pair[0], "by": pair[1]},
        "tuple": lambda option, pair: (option, pair),
    }[form]
    assert repr(first) == repr(_in_space_order(env, expected(np.int64(1), _pair(0, [0.5, 0.0]))))
    assert repr(second) == repr(_in_space_order(env, expected(np.int64(3), _pair(1, [0.0, -0.5]))))


def _pair(discrete: int, values: list[float]) -> tuple:
    return np.int64(discrete), tuple(np.float32([value]) for value in values)


def _in_space_order(env: GymnasiumEnv, native):
    last = env.envs[0].unwrapped.actions[-1]
    return {name: native[name] for name in last} if isinstance(native, dict) else native


def test_an_entry_named_option_without_an_action_beside_it_is_the_action():
    specs = PAMDPSpecs.from_env(make(form="named option"))
    assert specs.num_discrete == 2 and specs.num_options == 0


@pytest.mark.parametrize("key", ["speed", "action"])
def test_an_option_key_that_names_no_discrete_entry_is_told_in_one_line(key):
    with pytest.raises(
        ValueError, match=f"option_key={key}: must name a Discrete beside the action, in the action space"
    ):
        make(form="dict", option_key=key)


def test_the_actions_of_a_one_of_are_its_spaces():
    env = make(form="one of")
    specs = PAMDPSpecs.from_env(env)
    assert specs.parameter_dims == (1, 2) and specs.parameter_high == (1.0, 2.0, 2.0)
    check_env_specs(env)
    env.reset()
    env.step(action(env, [1], [[0.0, 0.5, 1.5]]))
    discrete, values = env.envs[0].unwrapped.actions[-1]
    assert discrete == 1 and values.tolist() == [0.5, 1.5]
