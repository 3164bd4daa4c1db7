"""Gymnasium environments that forbid actions, that have options, or whose actions are a OneOf."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium_players import action
from torchrl.envs.utils import check_env_specs
from toy_masked_gymnasium import Masked

from hpamdp import keys
from hpamdp.env.base import ProblemError
from hpamdp.env.gymnasium.environment import GymnasiumEnv
from hpamdp.specs import PAMDPSpecs


def make(num_envs: int = 1, *, form: str = "plain", source: str = "none", mask: object = None, **options):
    kwargs = {"form": form, "source": source, "mask": mask}
    entry_point = "toy_masked_gymnasium:Masked"
    return GymnasiumEnv(num_envs, entry_point=entry_point, kwargs=kwargs, max_steps=5, **options)


@pytest.mark.parametrize("source", ["info", "observation"])
def test_a_mask_comes_from_the_info_or_from_the_observation(source):
    env = make(2, source=source)
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
            {"action_mask": "info"},
            r"gave no action_mask, which must come with every reset and step; env\.action_mask=ignore ignores it$",
        ),
        (
            {"source": "info", "action_mask": "info", "mask": [1, float("nan")]},
            r"gave \[1, nan\] as action_mask, which ",
        ),
    ],
)
def test_a_mask_that_is_not_what_was_set_is_told_in_one_line(options, complaint):
    with pytest.raises(ProblemError, match=rf"^GymnasiumEnv: toy_masked_gymnasium:Masked: environment 0: {complaint}"):
        make(**options).reset()


def misplaced(where: str, name: str, value: object) -> None:
    """Make an environment that says somewhere what it forbids, and take a step."""
    env = GymnasiumEnv(entry_point=f"{__name__}:Misplaced", kwargs={"where": where, "name": name, "value": value})
    env.reset()
    env.step(action(env, [0], torch.zeros(1, 2)).set(keys.OPTION, torch.tensor([0])))


class Misplaced(Masked):
    """Says what it forbids where it is not read."""

    def __init__(self, where: str, name: str, value: object):
        super().__init__(form="dict", source="none")
        self.spec = gymnasium.envs.registration.EnvSpec("Misplaced-v0", max_episode_steps=5)
        self.where, self.what = where, {name: value}
        if where == "attribute":
            setattr(self, name, value)

    def _info(self):
        said = self.what if self.where in ("info", "late info") else {}
        return {} if self.where == "late info" and self.steps == 0 else said


@pytest.mark.parametrize(
    ("where", "name"), [("info", "option_masks"), ("late info", "action_mask"), ("attribute", "action_masks")]
)
def test_a_mask_that_is_not_read_is_reported_in_one_line(where, name):
    kind = name.removesuffix("s")
    expected = rf"^GymnasiumEnv: .*gave an {kind} as .*{name}.*, which is not read; give it as {kind} in a Dict of obs"
    with pytest.raises(ValueError, match=expected):
        misplaced(where, name, [1, 0])


class Methods(gymnasium.Wrapper):
    """Has the method of sb3-contrib, as its ActionMasker does."""

    def action_masks(self) -> list[bool]:
        return [True, False]


def with_method() -> gymnasium.Env:
    return gymnasium.wrappers.OrderEnforcing(Methods(Masked(source="none")))


def test_a_method_that_gives_a_mask_is_reported_in_one_line_unless_masks_are_ignored():
    gymnasium.register("with-method-v0", entry_point=with_method)
    for options in ({}, {"id": "with-method-v0", "entry_point": None}):
        arguments = {"entry_point": f"{__name__}:with_method", "max_steps": 5, **options}
        with pytest.raises(ValueError, match=r"gave an action_mask as Methods\.action_masks, which is not "):
            GymnasiumEnv(**arguments)
        assert GymnasiumEnv(**arguments, action_mask="ignore").reset()[keys.OBSERVATION].shape == (1, 1)


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


def test_an_option_key_that_names_no_discrete_entry_is_told_in_one_line():
    with pytest.raises(ValueError, match="option_key=action: must name a Discrete beside the action, of at"):
        make(form="dict", option_key="action")


def test_the_actions_of_a_one_of_are_its_spaces():
    env = make(form="one of")
    specs = PAMDPSpecs.from_env(env)
    assert specs.parameter_dims == (1, 2) and specs.parameter_high == (1.0, 2.0, 2.0)
    check_env_specs(env)
    env.reset()
    env.step(action(env, [1], [[0.0, 0.5, 1.5]]))
    discrete, values = env.envs[0].unwrapped.actions[-1]
    assert discrete == 1 and values.tolist() == [0.5, 1.5]
