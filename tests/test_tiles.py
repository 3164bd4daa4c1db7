"""A place as tiles: what they say, and that Office and Pinball observe them beside the plain coordinates."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torchrl.envs import EnvBase

import hpamdp
from hpamdp import keys
from hpamdp.env.tiles import tiles_of


def test_tiles_say_where_a_place_is():
    x, y = torch.tensor([[0.5, 0.98], [0.075, 0.31]], dtype=torch.float64)
    of_x, of_y = tiles_of(x, y, 20).split(20, -1)
    torch.testing.assert_close(of_x[0, 9:11], torch.full((2,), 0.5, dtype=torch.float64))
    assert of_y[0, 1].item() == pytest.approx(1.0)
    middles = (torch.arange(20, dtype=torch.float64) + 0.5) / 20
    assert (of_y @ middles).tolist() == pytest.approx([0.075, 0.31])


def after_random_steps(env: EnvBase) -> Tensor:
    torch.manual_seed(0)
    return env.rollout(30)["next", keys.OBSERVATION][:, -1]


@pytest.mark.parametrize("problem", ["office", "pinball"])
def test_tiles_stand_behind_what_is_observed_anyway(problem):
    env, plain = hpamdp.make(problem, num_envs=2, tiles=20), hpamdp.make(problem, num_envs=2)
    seen, expected = (after_random_steps(each) for each in (env, plain))
    assert (env.position[:, 0] - env.position[:, 1]).abs().min() > 0.01
    assert torch.equal(seen[:, :4], expected)
    torch.testing.assert_close(seen[:, 4:], tiles_of(*env.position.unbind(-1), 20))
    assert env.observation_names[3:6] == (plain.observation_names[3], "x_0", "x_1")
    assert env.observation_names[-1] == "y_19" and env.observation_spec[keys.OBSERVATION].is_in(seen)
