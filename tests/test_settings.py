"""Learners and their settings: built from the sizes of a problem alone, from a model, or from single settings."""

from functools import partial

import numpy as np
import pytest
import torch
from toy_steps import SPECS

import hpamdp
from hpamdp.data.demonstrations import Demonstrations
from hpamdp.env.gymnasium.environment import GymnasiumEnv
from hpamdp.env.platform.environment import PlatformEnv
from hpamdp.policies.low_level.bc import BC
from hpamdp.policies.low_level.hppo import HPPO
from hpamdp.policies.low_level.hsac import HSAC
from hpamdp.policies.low_level.iql import IQL
from hpamdp.policies.low_level.paddpg import PADDPG
from hpamdp.policies.low_level.qpamdp import QPAMDP
from hpamdp.policies.low_level.td3_bc import TD3BC
from hpamdp.settings import SettingError

LEARNERS = [BC, HPPO, HSAC, IQL, PADDPG, QPAMDP, TD3BC]


@pytest.mark.parametrize("cls", LEARNERS)
def test_a_learner_is_built_from_the_sizes_of_a_problem_alone(cls):
    assert cls(SPECS).policy.out_keys == cls(SPECS, options=cls.Options()).policy.out_keys


def test_a_model_and_a_single_setting_give_the_same_learner():
    one, other = HSAC(SPECS, options=HSAC.Options(tau=0.5)), HSAC(SPECS, tau=0.5)
    assert one.options == other.options != HSAC(SPECS).options


@pytest.mark.parametrize("cls", [BC, HSAC, IQL])
def test_a_range_of_deviations_must_not_be_empty(cls):
    with pytest.raises(ValueError, match=r"min_scale=2.0: must be less than max_scale=1.0"):
        cls(SPECS, min_scale=2.0)


def test_widths_are_a_list_or_a_tuple_and_never_a_set():
    assert HPPO.Options(hidden_dims=[8, 4]).hidden_dims == (8, 4)
    with pytest.raises(ValueError, match="hidden_dims"):
        HPPO.Options(hidden_dims={8, 4})


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({"hiden_dims": (8,)}, "hiden_dims: no such setting of HPPOOptions; did you mean hidden_dims? It has "),
        ({"learning_rate": 1e-3}, "learning_rate: no such setting of HPPOOptions; did you mean lr or critic_lr? It "),
        ({"lr": -1.0, "epochs": 0.5}, "epochs=0.5: must be a valid integer; lr=-1.0: must be greater than 0"),
        ({"lr": np.ones((9, 9))}, "lr=array([[1., 1., 1., 1., 1., 1., 1., 1., 1.], [1., "),
    ],
)
def test_python_code_gets_one_line_that_guesses_the_setting_that_was_meant(settings, complaint):
    with pytest.raises(SettingError) as raised:
        HPPO(SPECS, **settings)
    assert str(raised.value).startswith(complaint) and len(str(raised.value).splitlines()) == 1


@pytest.mark.parametrize(
    "take",
    [
        partial(hpamdp.PDQN, SPECS),
        partial(PlatformEnv, 2),
        partial(GymnasiumEnv, id="CartPole-v1"),
        partial(Demonstrations, None),
        partial(hpamdp.make_gymnasium, "platform", 2),
        partial(hpamdp.load, "hppo_platform"),
        partial(hpamdp.train, "platform"),
    ],
)
def test_a_wrong_device_is_refused_in_one_line_wherever_it_is_given(take):
    with pytest.raises(ValueError, match=r"device=\W?gpu\W?: .*cpu") as raised:
        take(device="gpu")
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("device", ["CPU", "cuda:x", "cuda:99", torch.device("cuda:99"), 1.5, True, ["cpu"]])
def test_what_is_no_device_is_refused_in_one_line(device):
    with pytest.raises(ValueError, match=r"device=.*cpu") as raised:
        HPPO(SPECS, device=device)
    assert "\n" not in str(raised.value)


def test_a_device_may_be_given_as_an_object():
    assert HPPO(SPECS, device=torch.device("cpu")).frames.device.type == "cpu"
    hpamdp.load("hppo_platform", device=torch.device("cpu"))
