"""A place as tiles: what they say, and that Office and Pinball observe them beside the plain coordinates."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torchrl.envs import EnvBase

import hpamdp
from hpamdp import keys


def tiles_of(place: Tensor, num: int) -> Tensor:
    """Return the tiles of x, then those of y, of places `[N, 2]`: 1 in the middle of a tile, 0 in that of the next."""
    middle = (torch.arange(num) + 0.5) / num
    return (1.0 - num * (place.unsqueeze(-1) - middle).abs()).clamp(min=0.0).flatten(1)


def after_random_steps(env: EnvBase) -> Tensor:
    torch.manual_seed(0)
    return env.rollout(30)["next", keys.OBSERVATION][:, -1]


@pytest.mark.parametrize("problem", ["office", "pinball"])
def test_tiles_stand_behind_what_is_observed_anyway(problem):
    env, plain = hpamdp.make(problem, num_envs=2, tiles=20), hpamdp.make(problem, num_envs=2)
    seen, expected = (after_random_steps(each) for each in (env, plain))
    assert (env.position[:, 0] - env.position[:, 1]).abs().min() > 0.01
    assert torch.equal(seen[:, :4], expected)
    torch.testing.assert_close(seen[:, 4:], tiles_of(env.position, 20))
    assert env.observation_names[3:6] == (plain.observation_names[3], "x_0", "x_1")
    assert env.observation_names[-1] == "y_19" and env.observation_spec[keys.OBSERVATION].is_in(seen)
