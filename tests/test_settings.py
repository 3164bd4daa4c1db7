"""Learners and their settings: built from the sizes of a problem alone, from a model, or from single settings."""

import pytest
from toy_steps import SPECS

from hpamdp.policies.low_level.bc import BC
from hpamdp.policies.low_level.hppo import HPPO
from hpamdp.policies.low_level.hsac import HSAC
from hpamdp.policies.low_level.iql import IQL
from hpamdp.policies.low_level.paddpg import PADDPG
from hpamdp.policies.low_level.qpamdp import QPAMDP
from hpamdp.policies.low_level.td3_bc import TD3BC

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


def test_a_number_in_the_place_of_the_device_is_refused_by_python():
    with pytest.raises(TypeError, match="takes 2 positional arguments"):
        HPPO(SPECS, 1e-3)
