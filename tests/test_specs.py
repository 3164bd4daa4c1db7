"""The sizes and bounds of a problem as learners get them, and its initial parameters."""

from dataclasses import replace

import pytest
import torch
from test_hppo import make as make_hppo
from test_hsac import make as make_hsac
from toy_masks import Forbidden
from toy_steps import SPECS

from hpamdp.env.platform.environment import PlatformEnv
from hpamdp.specs import PAMDPSpecs

WEIGHT = ((0.5, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0), (0.0, 0.0, -0.25, 0.0))
INITIAL = replace(SPECS, initial_weight=WEIGHT, initial_bias=(0.1, 0.8, -0.6))


def initial(state: torch.Tensor) -> torch.Tensor:
    return torch.stack([0.1 + 0.5 * state[:, 0], torch.full((len(state),), 0.8), -0.6 - 0.25 * state[:, 2]], -1)


def test_slots_are_each_discrete_actions_own_parameters_first():
    specs = PAMDPSpecs(1, (), (1, 0, 2), (0.0,) * 3, (1.0,) * 3)
    assert specs.parameter_owner.tolist() == [0, 2, 2]
    slots = specs.parameter_slots
    assert slots.shape == (3, 2) and slots[0, 0] == 0 and slots[2].tolist() == [1, 2]
    assert PAMDPSpecs(1, (), (0, 0), (), ()).parameter_slots.shape == (2, 0)


def test_initial_parameters_do_not_depend_on_an_observed_option():
    specs = replace(INITIAL, option_names=("left", "right")).with_option_observed()
    assert specs.observation_dim == 6
    assert torch.equal(torch.tensor(specs.initial_weight), torch.tensor([[*row, 0.0, 0.0] for row in WEIGHT]))


def test_initial_parameters_of_a_wrong_shape_are_refused():
    class Wrong(PlatformEnv):
        def initial_parameters(self):
            return torch.zeros(3, 8), torch.zeros(3)

    with pytest.raises(
        ValueError, match=r"initial_parameters: shapes \[\[3, 8\], \[3\]\], but must be \[\[3, 9\], \[3\]\]"
    ):
        PAMDPSpecs.from_env(Wrong(1))


@pytest.mark.parametrize(
    ("low", "high", "place"),
    [
        ((-1.0, 0.0, 2.0), (1.0, 0.0, 2.0), "parameter 1: bounds 0 and 0"),
        ((-1.0, 0.0, 2.0), (1.0, 1.0, 1.0), "parameter 2: bounds 2 and 1"),
        ((-1.0, 0.0, 2.0), (float("inf"), 1.0, 3.0), "parameter 0: bounds -1 and inf"),
    ],
)
def test_bounds_between_which_nothing_can_be_scaled_are_refused(low, high, place):
    env = Forbidden(1)
    env.action_spec = env.make_action_spec(torch.tensor(low), torch.tensor(high))
    with pytest.raises(ValueError, match=f"{place}, but the lower must be less than the upper, both finite$"):
        PAMDPSpecs.from_env(env)


def test_equal_bounds_of_a_whole_number_are_a_cell():
    env = Forbidden(1)
    env.integer_parameters = (False, True, False)
    env.action_spec = env.make_action_spec(torch.tensor([-1.0, 4.0, -1.0]), torch.tensor([1.0, 4.0, 1.0]))
    specs = PAMDPSpecs.from_env(env)
    assert specs.to_unit(torch.tensor([0.0, 4.0, 1.0])).tolist() == [0.0, 0.0, 1.0]
    assert specs.from_unit(torch.tensor([0.0, 0.7, 1.0])).tolist() == [0.0, 4.0, 1.0]


def test_hppo_and_hsac_can_start_at_the_initial_parameters():
    state = torch.rand(40, 4) * 2 - 1
    distribution = make_hppo(INITIAL, initial_parameters="domain").actor(state)
    torch.testing.assert_close(distribution.mean, initial(state), atol=0.05, rtol=0.0)
    distribution = make_hsac(INITIAL, initial_parameters="domain").actor(state)
    torch.testing.assert_close(distribution.mean.tanh(), initial(state), atol=0.02, rtol=0.0)
