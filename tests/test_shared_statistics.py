"""Worker processes learn one scale of observations and rewards: that of all steps of all workers."""

from __future__ import annotations

import copy
from contextlib import closing

import pytest
import torch
from conftest import make_config
from torch import Tensor

from hpamdp.run.assemble import assemble, make_env

WORDS = [
    *("num_envs=4", "steps_per_batch=5", "eval.layouts=2", "low=random", "high=none", "collector=multi"),
    # Its observations are float32, as in a batch.
    *("env=gymnasium", "env.id=hpamdp/BoatDock-v0", "env.kwargs={controller:congruent}", "env.max_steps=4"),
]
DIM = 16  # of its observations
RUNNING = ["env.observation_scaling=running", "env.reward_scaling=0.9"]


def begin(*words: str):
    config = make_config([*WORDS, *words])
    parts = assemble(config)
    return config, parts, config.collector.build(config=config, parts=parts, frames=0)


def seen(batches: list, following: Tensor) -> Tensor:
    """Return all observations of resets and steps in the batches, `[M, dim]`.

    Args:
        batches: the batches, `[N, T]` each.
        following: the observation `[N, dim]` with which the next batch begins.
    """
    batch = torch.cat(batches, 1)
    is_first = torch.ones(len(batch), batch.shape[1] + 1, dtype=torch.bool)
    is_first[:, 1:] = batch["next", "done"][..., 0]
    roots = torch.cat([batch["observation"], following.unsqueeze(1)], 1)
    return torch.cat([roots[is_first], batch["next", "observation"].flatten(0, 1)]).double()


def assert_same(one: dict[str, Tensor], other: dict[str, Tensor]) -> None:
    assert one.keys() == other.keys()
    assert all(torch.equal(column, other[name]) for name, column in one.items())


@pytest.mark.slow
def test_the_merged_statistics_are_those_of_all_observations_and_rewards():
    # Raw observations show what the statistics are of.
    config, parts, collection = begin(*RUNNING, f"env.raw_observations={[*range(DIM)]}".replace(" ", ""))
    with closing(collection):
        test_env = make_env(config, 2, torch.device("cpu"), seed=0)
        test_env.set_scaling_from(parts.env.base_env)
        batches = [collection.next() for _ in range(3)]
        merged = parts.env.base_env.statistics()
        own = test_env.scaling.statistics.columns()
        observations = seen(batches, collection.next()["observation"][:, 0])
    assert_same(own, {name: merged[name] for name in own})
    assert merged["observation_count"] == len(observations)
    assert merged["return_count"] == 4 * 15
    torch.testing.assert_close(merged["observation_mean"], observations.mean(0), rtol=1e-9, atol=1e-9)
    variance = observations.var(0, unbiased=False)
    torch.testing.assert_close(merged["observation_variance"], variance, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_a_resumed_run_goes_on_with_the_merged_statistics_and_sends_them_to_its_workers():
    _, parts, one = begin(*RUNNING)
    with closing(one):
        for _ in range(2):
            one.next()
        state = copy.deepcopy(one.state())
    assert_same(state["env"], parts.env.base_env.statistics())
    _, parts, other = begin(*RUNNING)
    with closing(other):
        other.set_state(state)
        assert_same(state["env"], parts.env.base_env.statistics())
        other.next()
        assert parts.env.base_env.statistics()["return_count"] == state["env"]["return_count"] + 20
