"""Batched environments keep the framework's contract, and so do their Gymnasium adapters."""

from __future__ import annotations

import itertools
import math
import random
import warnings
from functools import partial

import gymnasium
import numpy as np
import pytest
import torch
from batched_players import action, is_unchanged, play, random_player, restart, snapshot
from conftest import global_generators_unmoved
from gymnasium.utils.env_checker import check_env
from tensor_rules import boat_rules
from tensordict import TensorDictBase
from torchrl.envs.utils import check_env_specs

import hpamdp
from hpamdp import keys
from hpamdp.env import counter_rng
from hpamdp.env.batched_adapter import BatchedEnvAdapter
from hpamdp.env.batched_env import GOING_ON
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.boatdock_released.environment import ReleasedBoatDockEnv
from hpamdp.env.boatdock_unseen.environment import UnseenBoatsEnv
from hpamdp.env.catch_point.environment import CatchPointEnv
from hpamdp.env.circuit.environment import CircuitEnv
from hpamdp.env.goal.environment import GoalEnv, HardGoalEnv
from hpamdp.env.gym_hybrid.environment import MovingEnv, SlidingEnv
from hpamdp.env.gymnasium.environment import GymnasiumEnv
from hpamdp.env.hard_move.environment import HardMoveEnv
from hpamdp.env.office.environment import OfficeEnv
from hpamdp.env.pinball.environment import PinballEnv
from hpamdp.env.platform.environment import PlatformEnv
from hpamdp.settings import SettingError
from hpamdp.specs import PAMDPSpecs

POINTS = [CatchPointEnv, HardMoveEnv, MovingEnv, SlidingEnv]
# One of each set of rules; Hard Move has those of Catch Point, Moving those of Sliding, Hard Goal those of Goal.
LIMITED = {
    "platform": PlatformEnv,
    "office": OfficeEnv,
    "pinball": PinballEnv,
    "circuit": partial(CircuitEnv, task="random_state"),
    "catch_point": CatchPointEnv,
    "sliding": SlidingEnv,
    "goal": GoalEnv,
}
NOISE = {"motor_noise": 0.2, "sensor_noise": 3.0, "slip": 0.3}
PROBLEMS = LIMITED | {
    "boats": partial(BoatDockEnv, controller="random", keymap="random", **NOISE),
    "released boats": partial(ReleasedBoatDockEnv, controller="incongruent", frozen_layouts=False),
    "unseen boats": partial(UnseenBoatsEnv, motor_noise=0.1),
}
IDS = {
    "hpamdp/Platform-v0": PlatformEnv,
    "hpamdp/Office-v0": OfficeEnv,
    "hpamdp/CatchPoint-v0": CatchPointEnv,
    **{f"hpamdp/HardMove{n}-v0": HardMoveEnv for n in (4, 6, 8)},
    "hpamdp/Moving-v0": MovingEnv,
    "hpamdp/Sliding-v0": SlidingEnv,
    "hpamdp/PinballSimple-v0": PinballEnv,
    "hpamdp/PinballHard-v0": PinballEnv,
    **{env_id: CircuitEnv for env_id in gymnasium.registry if "Circuit" in env_id},
    "hpamdp/Goal-v0": GoalEnv,
    "hpamdp/HardGoal-v0": HardGoalEnv,
}
# Gymnasium recommends actions scaled to [-1, 1]; the field's own bounds are others. Goal's orientations have none.
EXPECTED = ("we recommend using a symmetric and normalized space", "value is -infinity", "value is infinity")

each_problem = pytest.mark.parametrize("problem", PROBLEMS.values(), ids=PROBLEMS)
each_with_a_limit = pytest.mark.parametrize("problem", LIMITED.values(), ids=LIMITED)


@each_problem
def test_all_tensors_are_as_the_specs_say(problem):
    check_env_specs(problem(3), return_contiguous=True)


@pytest.mark.parametrize(
    ("problem", "dims", "low", "high"),
    [
        (CatchPointEnv, (1, 0), (-1.0,), (1.0,)),
        (HardMoveEnv, (1,) * 16, (-1.0,) * 16, (1.0,) * 16),
        (MovingEnv, (1, 1, 0), (0.0, -1.0), (1.0, 1.0)),
        (SlidingEnv, (1, 1, 0), (0.0, -1.0), (1.0, 1.0)),
    ],
)
def test_learners_see_the_domains_own_actions_and_bounds(problem, dims, low, high):
    env = problem(2)
    dim = len(env.observation_names)
    assert PAMDPSpecs.from_env(env) == PAMDPSpecs(dim, (), dims, low, high)
    assert dim == (10 if problem in (MovingEnv, SlidingEnv) else 4)
    assert len(env.discrete_names) == len(dims)


@each_problem
def test_the_episodes_of_an_environment_do_not_depend_on_the_others(problem):
    few, many = problem(3, seed=11), problem(8, seed=11)
    player = random_player()
    readings = few.reset(), many.reset()
    assert (readings[0] == readings[1][:3]).all()
    for _ in range(8):
        actions = player(many)
        readings = few.step(actions[:3].clone())["next"], many.step(actions)["next"]
        assert (readings[0] == readings[1][:3]).all()
        # Start new episodes in some of the others alone.
        restart(many, readings[1], torch.arange(8) > 4)


@each_problem
def test_environments_of_several_processes_continue_the_numbering(problem):
    whole, part = problem(5, seed=3), problem(2, seed=3, first_env=3)
    actions = random_player()(whole)
    assert (whole.reset()[3:] == part.reset()).all()
    assert (whole.step(actions.clone())["next"][3:] == part.step(actions[3:].clone())["next"]).all()


@each_problem
def test_a_masked_step_changes_the_other_environments_alone(problem):
    masked, free = problem(6), problem(6)
    actions = random_player()(free)
    masked.reset()
    free.reset()
    before = snapshot(masked)
    mask = torch.tensor([True, False] * 3)
    reading = masked._step(actions.clone().set("_step", mask))
    expected = free._step(actions)
    assert is_unchanged(masked, before, ~mask)
    assert (reading[mask] == expected[mask]).all()
    assert (reading[keys.REWARD][~mask] == 0.0).all()


@each_problem
def test_a_partial_reset_leaves_the_other_environments_alone(problem):
    env = problem(4)
    env.reset()
    reading = env.step(random_player()(env))["next"]
    before = snapshot(env)
    mask = torch.tensor([False, True, False, True])
    fresh = restart(env, reading, mask)
    assert is_unchanged(env, before, ~mask)
    assert (fresh[keys.OBSERVATION][~mask] == reading[keys.OBSERVATION][~mask]).all()
    assert env.env_state()["episode"].tolist() == [0, 1, 0, 1]
    assert env.state.steps[mask].tolist() == [0, 0]
    assert not fresh[keys.DONE][mask].any()


@each_problem
def test_a_finished_episode_stays_finished_and_earns_nothing(problem):
    env = problem(64, max_steps=2) if problem in LIMITED.values() else problem(64)
    player = random_player()
    play(env, player, 2)
    if isinstance(env, UnseenBoatsEnv):  # a trip that fails is followed by the next one
        play(env, player, 100)
    before = snapshot(env)
    is_over = before["outcome"] != GOING_ON
    assert is_over.any()
    after = env.step(player(env))["next"]
    assert is_unchanged(env, before, is_over)
    assert after[keys.DONE][is_over].all()
    assert (after[keys.REWARD][is_over] == 0.0).all()


@pytest.mark.parametrize("problem", [MovingEnv, SlidingEnv, GoalEnv, HardGoalEnv])
def test_a_limit_that_costs_may_terminate_instead(problem):
    env = problem(64, max_steps=1, limit="terminated")
    last, _ = play(env, random_player(), 1)
    assert (last[keys.OUTCOME] == len(env.outcomes) - 1).any()
    assert last[keys.TERMINATED].all() and last[keys.DONE].all() and not last[keys.TRUNCATED].any()


@each_with_a_limit
def test_the_time_limit_truncates(problem):
    env = problem(64, max_steps=2)
    last, _ = play(env, random_player(), 2)
    truncated = last[keys.TRUNCATED].squeeze(-1)
    assert truncated.any() or isinstance(env, CircuitEnv | GoalEnv)  # at its limit a circuit is finished
    assert (last[keys.TERMINATED].squeeze(-1) == ~truncated).all()
    assert (last[keys.OUTCOME][truncated] == len(env.outcomes) - 1).all()
    assert not env.results(last)["success"][truncated].any()


@each_problem
def test_a_restored_state_continues_as_the_original(problem):
    env, copy = problem(8, seed=2), problem(8, seed=2)
    player = random_player()
    play(env, player, 2)
    copy.set_env_state(snapshot(env))
    for _ in range(3):
        actions = player(env)
        assert (env.step(actions.clone())["next"] == copy.step(actions.clone())["next"]).all()


@each_problem
def test_a_state_of_other_environments_is_refused_and_an_empty_one_starts_new_episodes(problem):
    env = problem(3)
    env.reset()
    before = snapshot(env)
    with pytest.raises(ValueError, match=rf"{type(env).__name__}: the state's \w+ is \[2\], but must be \[3\]"):
        env.set_env_state(problem(2).env_state())
    assert is_unchanged(env, before)
    env.set_env_state({})
    assert env.env_state()["episode"].tolist() == [1, 1, 1]


@each_problem
def test_an_environment_goes_on_past_the_largest_number_of_an_episode(problem):
    env = problem(2)
    env.reset()
    env.state = env.state._replace(episode=torch.full((2,), 2**31 - 1, dtype=torch.int32))
    reading = env.reset()
    assert env.state.episode.tolist() == [-(2**31)] * 2
    env.check_env_state(env.env_state())
    resumed = problem(2)
    resumed.set_env_state(snapshot(env))
    assert torch.equal(resumed.read()[keys.OBSERVATION], reading[keys.OBSERVATION])


@each_problem
def test_an_invalid_action_is_refused_and_changes_nothing(problem):
    env = problem(2)
    env.reset()
    before = snapshot(env)
    parameters = torch.zeros(2, sum(env.parameter_dims))
    parameters[1, 0] = math.nan
    for discrete, line in (
        ([0, 0], r"step: environment 1 got \w+=0 .*those of the chosen action must be finite"),
        ([-1, 1], r"environment 0 got \w+=-1 \(allowed 0 to"),
        ([10**6, 1], r"environment 0 got \w+=1000000 \(allowed 0 to"),
    ):
        with pytest.raises(ValueError, match=line):
            env.step(action(torch.tensor(discrete), parameters))
        assert is_unchanged(env, before)
    env.step(action(torch.tensor([0, 1]), parameters))  # another action's parameter is never read
    assert all(column.isfinite().all() for column in env.env_state().values() if column.is_floating_point())


def test_an_action_of_another_form_is_refused_and_changes_nothing():
    env = PlatformEnv(2)
    env.reset()
    before = snapshot(env)
    for bad, line in (
        (action(torch.zeros(2, dtype=torch.long), torch.full((2, 3), math.inf)), "must be finite"),
        (action(torch.tensor([[0], [1]]), torch.zeros(2, 3)), "has shape"),
        (action(torch.tensor([0, 1]), torch.zeros(2, 1)), "has shape"),
        (action(torch.tensor([0.5, 1.0]), torch.zeros(2, 3)), "must be integer"),
        (action(torch.tensor([0, 1]), torch.zeros(2, 3)).exclude(keys.DISCRETE), "step: "),
    ):
        with pytest.raises(ValueError, match=line):
            env.step(bad)
        assert is_unchanged(env, before)


@pytest.mark.parametrize("problem", [PlatformEnv, PROBLEMS["boats"]], ids=["platform", "boats"])
def test_what_was_returned_never_changes_later_and_is_float32_whatever_the_parameters(problem):
    env, player = problem(16), random_player()
    returned = [env.reset()]
    columns, copies, kept = env.env_state(), [returned[0].clone()], snapshot(env)
    for number in range(3):
        taken = player(env)
        taken[keys.PARAMETERS] = taken[keys.PARAMETERS].double()
        stepped = env.step(taken)["next"]
        for reading in (stepped, restart(env, stepped, torch.arange(16) % 3 == number)):
            returned.append(reading)
            copies.append(reading.clone())
    assert all((now == then).all() for now, then in zip(returned, copies, strict=True))
    assert all(torch.equal(columns[name], kept[name]) for name in columns)
    assert {reading[keys.OBSERVATION].dtype for reading in returned} == {stepped[keys.REWARD].dtype} == {torch.float32}


@each_problem
def test_parameters_outside_their_bounds_are_clipped(problem):
    outside, inside = problem(4), problem(4)
    low, high = (
        getattr(outside.full_action_spec_unbatched[keys.PARAMETERS].space, side).expand(4, -1)
        for side in ("low", "high")
    )
    discrete = torch.zeros(4, dtype=torch.long)
    for beyond, bound in ((low - 3.0, low), (high + 3.0, high)):
        outside.reset()
        inside.reset()
        readings = outside.step(action(discrete, beyond))["next"], inside.step(action(discrete, bound))["next"]
        assert (readings[0] == readings[1]).all()


@each_problem
def test_global_generators_are_neither_moved_nor_read(problem):
    env = problem(8)
    actions = random_player()(env)

    def run() -> TensorDictBase:
        env.set_seed(5)
        env.reset()
        return env.step(actions.clone())["next"]

    with global_generators_unmoved():
        once = run()
    torch.rand(3)
    np.random.rand()
    random.random()
    assert (run() == once).all()


@each_problem
def test_a_seed_fixes_the_episodes(problem):
    env, others = problem(20, seed=1), problem(20, seed=2)
    actions = random_player()(env)

    def seen(of):
        of.reset()
        return of.step(actions.clone())["next"][keys.OBSERVATION]

    first, second, other = seen(env), seen(env), seen(others)
    others.set_seed(1)
    assert torch.equal(seen(others), first)
    for different in (second, other):
        assert (different != first).any() or isinstance(env, PinballEnv)  # which draws nothing


def test_evaluation_draws_starts_and_noise_from_streams_of_its_own_until_the_next_seed():
    # What the kernel draws is compared with the tensor functions in test_boat_kernel.
    env = boat_rules.TensorBoats(4, controller="random", keymap="random", **NOISE)
    streams = []

    drawn = counter_rng.rng_key

    def rng_key(seed, stream, environment, episode):
        streams.append(stream)
        return drawn(seed, stream, environment, episode)

    actions = random_player()(env)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(counter_rng, "rng_key", rng_key)
        for seed_it, expected in (
            (env.set_seed, {counter_rng.TRAINING, counter_rng.NOISE}),
            (env.seed_evaluation, {counter_rng.EVALUATION, counter_rng.EVALUATION_NOISE}),
            (env.set_seed, {counter_rng.TRAINING, counter_rng.NOISE}),
        ):
            seed_it(3)
            streams.clear()
            env.reset()
            env.step(actions.clone())
            assert set(streams) == expected


@pytest.mark.parametrize("problem", [*POINTS, PinballEnv])
def test_the_oracle_writes_the_scripted_players_action(problem):
    env = problem(5, oracle=True)
    reading = env.reset()
    discrete, parameter = env.scripted_action(env.state)
    assert torch.equal(reading[keys.ORACLE_DISCRETE].squeeze(-1), discrete)
    assert torch.equal(reading[keys.ORACLE_PARAMETERS].squeeze(-1), parameter)


@pytest.mark.parametrize("env_id", IDS)
def test_gymnasiums_checker_finds_nothing(env_id):
    env = gymnasium.make(env_id, render_mode="rgb_array")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(env.unwrapped)
    assert not [str(w.message) for w in caught if not any(words in str(w.message) for words in EXPECTED)]


@pytest.mark.parametrize(
    "env_id",
    ["hpamdp/CatchPoint-v0", "hpamdp/Moving-v0", "hpamdp/Office-v0", "hpamdp/Platform-v0", "hpamdp/PinballSimple-v0"],
)
def test_a_adapter_plays_as_the_environment_does(env_id):
    adapter, env = gymnasium.make(env_id), IDS[env_id](1)
    env.set_seed(4, static_seed=True)
    observation, info = adapter.reset(seed=4)
    reading = env.reset()
    player = random_player(1)
    for _ in range(10):
        np.testing.assert_array_equal(observation, reading[keys.OBSERVATION][0].numpy())
        actions = player(env)
        parts = actions[keys.PARAMETERS][0].split(list(env.parameter_dims))
        taken = int(actions[keys.DISCRETE][0]), tuple(part.numpy() for part in parts)
        observation, reward, terminated, truncated, info = adapter.step(taken)
        reading = env.step(actions)["next"]
        assert (reward, terminated, truncated) == tuple(
            reading[name].item() for name in (keys.REWARD, keys.TERMINATED, keys.TRUNCATED)
        )
        assert info["outcome"] == env.outcomes[int(reading[keys.OUTCOME])]
        assert info.get("is_success") is (info["outcome"] == env.outcomes[1] if terminated or truncated else None)
        if terminated or truncated:
            break


def test_a_vector_starts_its_finished_episodes_again():
    adapter = gymnasium.make_vec(
        "hpamdp/CatchPoint-v0", num_envs=16, vectorization_mode="vector_entry_point", max_steps=3
    )
    adapter.reset(seed=0)
    moves = (np.zeros(16, np.int64), (np.zeros((16, 1)), np.zeros((16, 0))))
    for _ in range(3):
        observations, _, terminations, truncations, infos = adapter.step(moves)
    assert truncations.all() and not terminations.any()
    assert infos["_is_success"].all() and not infos["is_success"].any()
    fresh, rewards, terminations, truncations, infos = adapter.step(moves)
    assert (fresh[:, :2] == 0.0).all() and not (terminations | truncations).any()
    assert (rewards == 0.0).all() and (infos["steps"] == 0).all() and "is_success" not in infos
    assert observations in adapter.observation_space and fresh in adapter.observation_space


@each_problem
def test_observations_stay_in_their_bounds(problem):
    env = problem(200)
    low, high = (torch.tensor(side) for side in env.observation_bounds)
    player = random_player()
    reading = env.reset()
    for step in range(50):
        observation = reading[keys.OBSERVATION]
        assert ((observation >= low) & (observation <= high)).all(), step
        reading = env.step(player(env))["next"]


def test_bad_actions_and_options_of_a_adapter_are_refused_in_one_line():
    adapter = gymnasium.make("hpamdp/CatchPoint-v0").unwrapped
    with pytest.raises(gymnasium.error.ResetNeeded):
        adapter.step((0, (np.zeros(1), np.zeros(0))))
    with pytest.raises(ValueError, match=r"unknown options .'start'.; there are none"):
        adapter.reset(options={"start": 1})
    adapter.reset(seed=0)
    with pytest.raises(ValueError, match=r"the action must be a tuple \(discrete, parameters\), but is a int"):
        adapter.step(0)
    with pytest.raises(ValueError, match="render_mode='human', but must be None or rgb_array"):
        BatchedEnvAdapter("hpamdp.env.catch_point.environment:CatchPointEnv", render_mode="human")


MAKERS = {
    "PlatformEnv": PlatformEnv,
    "BoatDockEnv": BoatDockEnv,
    "GymnasiumEnv": partial(GymnasiumEnv, id="CartPole-v1"),
}


@pytest.mark.parametrize("make", MAKERS)
@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ({"seed": 1.5}, "seed=1.5: must be a whole number of at least 0"),
        ({"num_envs": 0}, "num_envs=0: must be a whole number of at least 1"),
        ({"first_env": -1}, "first_env=-1: must be a whole number of at least 0"),
    ],
)
def test_a_wrong_number_given_to_a_constructor_is_refused_in_one_line(make, arguments, line):
    with pytest.raises(SettingError) as raised:
        MAKERS[make](**arguments)
    assert str(raised.value) == f"{make}: {line}"


@pytest.mark.parametrize("way", ["constructor", "set_seed", "seed_evaluation", "reset", "reset of a vector", "copies"])
def test_a_seed_beyond_32_bits_has_episodes_of_its_own_however_it_is_given(way):
    def begun(number):
        if way == "constructor":
            return SlidingEnv(4, seed=number).reset()[keys.OBSERVATION]
        if way in ("set_seed", "seed_evaluation"):
            env = SlidingEnv(4)
            getattr(env, way)(number)
            return env.reset()[keys.OBSERVATION]
        if way == "copies":
            return GymnasiumEnv(4, id="CartPole-v1", seed=number).reset()[keys.OBSERVATION]
        env = hpamdp.make_gymnasium("sliding", None if way == "reset" else 4)
        return torch.from_numpy(env.reset(seed=number)[0])

    seeds = [3, 3 + 2**31, 2**32 - 1, 3 + 2**32, 2**33 - 1, 3 + 2**33, 3 + 2**64]
    drawn = [begun(number) for number in seeds]
    assert all((one != other).any() for one, other in itertools.combinations(drawn, 2))
    torch.testing.assert_close(drawn[3], begun(3 + 2**32), rtol=0.0, atol=0.0)


@pytest.mark.parametrize(
    "name",
    ["BoatDock", "Platform", "Office", "CatchPoint", "HardMove4", "Sliding", "PinballHard", "Goal", "CircuitToffoli"],
)
def test_a_picture_shows_the_progress_of_the_episode(name):
    adapter = gymnasium.make(f"hpamdp/{name}-v0", render_mode="rgb_array", disable_env_checker=True)
    adapter.action_space.seed(3)
    adapter.reset(seed=0)
    before = adapter.render()
    adapter.step(adapter.action_space.sample())
    after = adapter.render()
    assert before.shape == after.shape == ((240, 1440, 3) if name == "Platform" else (480, 480, 3))
    assert before.dtype == np.uint8
    assert (before != after).any()


@pytest.mark.parametrize("make", [PlatformEnv, partial(GymnasiumEnv, id="toy_environments:Toy-v0")])
def test_a_seed_that_is_no_whole_number_of_at_least_0_is_refused(make):
    env = make(2, seed=3)
    env.set_seed(3)
    first = env.reset()[keys.OBSERVATION]
    for method, seed in itertools.product((env.set_seed, env.seed_evaluation), (1.5, "a", True, -1)):
        with pytest.raises(ValueError, match=f"seed={seed!r}: must be a whole number of at least 0"):
            method(seed)
    env.set_seed(np.int64(3))
    assert torch.equal(env.reset()[keys.OBSERVATION], first)
