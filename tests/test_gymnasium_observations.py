"""Observations of Gymnasium environments are flattened, checked and, if asked, scaled by running statistics."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium_players import make, step
from torchrl.envs.utils import check_env_specs

from hpamdp.env.base import ProblemError
from hpamdp.env.gymnasium.environment import GymnasiumEnv
from hpamdp.env.gymnasium.observation_spaces import ObservationSpace
from hpamdp.env.gymnasium.scaling import ObservationScaling


def test_observations_of_nested_spaces_are_one_vector():
    env = GymnasiumEnv(2, entry_point="toy_environments:Mixed", max_steps=2)
    assert env.reset()["observation"].shape == (2, 7)
    check_env_specs(env)


def running(num_envs: int = 3, **options) -> GymnasiumEnv:
    return make(num_envs, observation_scaling="running", **options)


def test_running_statistics_are_those_of_all_observations_so_far():
    env = running(kwargs={"length": 3})
    plain = make(3, kwargs={"length": 3})
    so_far = [plain.reset()["observation"]]
    assert torch.allclose(env.reset()["observation"].mean(0), torch.zeros(2), atol=1e-6)
    for number in range(5):
        so_far.append(step(plain)["observation"][: 3 if number < 3 else 0])
        after = step(env)["observation"]
    everything = torch.cat(so_far).double()
    mean, deviation = everything.mean(0), everything.std(0, correction=0)
    assert np.allclose(env.scaling.statistics.mean, mean)
    assert np.allclose(np.sqrt(env.scaling.statistics.var), deviation)
    assert torch.allclose(after.double(), (so_far[3].double() - mean) / deviation, atol=1e-5)
    check_env_specs(env)


def test_running_statistics_are_saved_and_restored():
    one, other = running(seed=1), running(seed=2)
    one.reset()
    step(one)
    columns = one.env_state()
    kept = {name: column.clone() for name, column in columns.items()}
    step(one)
    assert all(torch.equal(columns[name], kept[name]) for name in kept)
    other.set_env_state(columns)
    assert all(torch.equal(other.env_state()[name], kept[name]) for name in kept)
    other.reset()
    assert all(torch.equal(columns[name], kept[name]) for name in kept)
    with pytest.raises(ValueError, match="must have shape"):
        other.set_env_state({name: column[..., None] for name, column in columns.items()})
    assert make().env_state() == {}
    make().set_env_state({})


def test_an_environment_for_evaluation_follows_the_statistics_without_updating_them():
    training, evaluation = running(), running(kwargs={"form": "split"}, parameter_dims=[2, 0, 1])
    evaluation.set_scaling_from(training)
    plain = make(3).reset()["observation"]
    assert torch.equal(evaluation.reset()["observation"], plain.clamp(-10.0, 10.0))
    training.reset()
    before = training.env_state()
    step(evaluation)
    evaluation.set_seed(0)
    seen = evaluation.reset()["observation"].double()
    assert all(torch.equal(column, before[name]) for name, column in training.env_state().items())
    statistics = training.scaling.statistics
    deviation = np.where(statistics.var > 0, np.sqrt(statistics.var), 1.0)
    assert np.allclose(seen.numpy(), (plain.numpy() - statistics.mean) / deviation, atol=1e-5)
    training.set_env_state({name: column + 1.0 for name, column in before.items()})
    evaluation.set_seed(0)
    assert not torch.equal(evaluation.reset()["observation"].double(), seen)
    make().set_scaling_from(make())
    with pytest.raises(ValueError, match="scaling can be shared only"):
        make().set_scaling_from(training)


def test_an_entry_outside_its_space_is_named_with_the_setting_that_leaves_it_out():
    env = GymnasiumEnv(2, entry_point="toy_environments:TickingGoal", kwargs={"tick": 198}, max_steps=9)
    assert env.reset()["observation"].shape == (2, 217)
    with pytest.raises(ProblemError) as raised:
        env.rollout(5)
    line = "TickingGoal: environment 0: gave an observation whose entry 1 is 200, outside Discrete(200); "
    assert str(raised.value).endswith(f"{line}env.observation_keys=[0] leaves the entry out")


def test_entries_are_chosen_in_their_order():
    parts = spaces.Dict(a=spaces.Box(0, 1, (2,)), b=spaces.Discrete(2), c=spaces.Tuple([spaces.MultiBinary(2)]))
    space = ObservationSpace(parts, ["c", "a"])
    assert space.dim == 4
    vector, _ = space.read({"a": np.float32([0.25, 0.5]), "b": 7, "c": (np.array([0, 1], np.int8),)})
    assert vector.tolist() == [0.0, 1.0, 0.25, 0.5]
    with pytest.raises(ValueError, match=r"without its entry c\.0"):
        space.read({"a": np.zeros(2)})


@pytest.mark.parametrize("entries", [[], ["a"], [0, 0]])
def test_entries_that_are_not_there_are_refused(entries):
    with pytest.raises(ValueError, match=r"observation_keys=.*: must name different entries of \[0, 1\]"):
        GymnasiumEnv(entry_point="toy_environments:TickingGoal", max_steps=9, observation_keys=entries)
    with pytest.raises(ValueError, match="has no entries; use null"):
        make(observation_keys=entries)


@pytest.mark.parametrize("scaling", ["bounds", "running"])
def test_raw_entries_are_not_scaled(scaling):
    parts = spaces.Dict(a=spaces.Box(0, 8, (2,)), b=spaces.Box(0, 8, (1,)))
    vectors = np.array([[2.0, 4.0, 6.0], [0.0, 8.0, 6.0]])
    by_name = ObservationScaling(ObservationSpace(parts), scaling, ["a"]).scaled(vectors)
    assert by_name[:, :2].tolist() == vectors[:, :2].tolist() and abs(by_name[0, 2]) <= 1.0
    plain = ObservationSpace(spaces.Box(0, 8, (3,)))
    by_number = ObservationScaling(plain, scaling, [2]).scaled(vectors)
    assert by_number[:, 2].tolist() == [6.0, 6.0] and abs(by_number[:, :2]).max() <= 1.0


def test_raw_entries_that_are_not_observed_are_refused_in_one_line():
    with pytest.raises(ValueError, match=r"raw_observations=.*: must name observed entries, which are 0 to 1$"):
        make(raw_observations=["a"])
