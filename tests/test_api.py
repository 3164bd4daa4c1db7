"""The public names of the package: make, train, load, Agent, learners in plain TorchRL loops."""

from __future__ import annotations

import re
import subprocess
import sys
import threading
from pathlib import Path
from typing import ClassVar
from unittest import mock

import gymnasium
import numpy as np
import pytest
import torch
from conftest import global_generators_unmoved
from gymnasium import spaces
from hydra.core.config_store import ConfigStore
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from toy_environments import Toy

import hpamdp
from hpamdp.env.errors import ProblemError
from hpamdp.env.platform.environment import PlatformEnv
from hpamdp.run.evaluate import Evaluation
from hpamdp.run_files import CHECKPOINT_NAME, METRICS_NAME

TINY = {"total_frames": 512, "num_envs": 32, "steps_per_batch": 8, "eval.layouts": 4, "film": False, "progress": False}
OWN = {**TINY, "env.max_steps": 5, "low": "hppo"}


class Reach(gymnasium.Env):
    """One step pays for a parameter that is near the first entry of the observation."""

    observation_space = spaces.Box(-1.0, 1.0, (3,), np.float32)
    action_space = spaces.Tuple(
        (spaces.Discrete(2), spaces.Tuple((spaces.Box(-1.0, 1.0, (1,)), spaces.Box(0.0, 2.0, (2,)))))
    )

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.target = self.np_random.uniform(-1.0, 1.0, 3).astype(np.float32)
        return self.target, {}

    def step(self, action):
        discrete, parameters = action
        reward = -abs(float(parameters[0][0] - self.target[0])) if discrete == 0 else -1.0
        return self.target, reward, False, False, {}


@pytest.fixture(scope="module")
def platform_agent() -> hpamdp.Agent:
    return hpamdp.train("platform", low="hppo", **TINY)


@pytest.fixture(scope="module")
def boat_agent() -> hpamdp.Agent:
    return hpamdp.load("linucb_hppo")


# The six uses of a newcomer, each at most eight lines.


def test_a_loaded_agent_plays_ten_episodes_in_gymnasium_as_its_evaluation_scores_it(platform_agent):
    agent, env = hpamdp.load("hppo_platform"), hpamdp.make_gymnasium("platform")
    returns = []
    for episode in range(10):
        observation, _ = env.reset(seed=episode)
        done, total = False, 0.0
        while not done:
            observation, reward, terminated, truncated, _ = env.step(agent.act(observation))
            done, total = terminated or truncated, total + reward
        returns.append(total)
    assert np.mean(returns) > 0.95
    assert agent.evaluate(episodes=10)["score"] > 0.95


def test_a_two_level_agent_holds_its_option_for_an_episode_in_gymnasium(boat_agent):
    env, scores = hpamdp.make_gymnasium("boatdock"), []
    for episode in range(5):
        observation, info = env.reset(seed=episode)
        boat_agent.reset()
        options, done = set(), False
        while not done:
            action = boat_agent.act(observation)
            options.add(int(action["option"]))
            observation, _, terminated, truncated, info = env.step(action)
            done = terminated or truncated
        assert len(options) == 1
        scores.append(info["score"])
    assert np.mean(scores) > 3.0


class Ledges(PlatformEnv):
    """A batched problem of a user."""


@pytest.mark.parametrize(
    ("settings", "low"),
    [
        ({}, "hppo"),
        ({"low": {"lr": 1e-3}, "mode": "train", "checkpoint": None}, "hppo"),
        ({"low": "random"}, "random"),
        ({"resume": "auto", "folder": "run"}, "hppo"),
    ],
)
def test_hppo_learns_problems_that_nobody_knows_unless_a_learner_is_chosen(settings, low, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    agent = hpamdp.train(Reach, **{**TINY, "env.max_steps": 5, **settings})
    assert f"low={low}," in repr(agent)
    named = hpamdp.train("gymnasium", **{**TINY, "env.id": "hpamdp/Goal-v0", **settings, "folder": "named"})
    assert f"low={low}," in repr(named)
    of_class = hpamdp.train(Ledges, **{**TINY, **settings, "folder": "class"})
    assert f"low={low}," in repr(of_class)


def test_an_own_environment_object_is_trained_in_a_cell_and_stays_as_it_is():
    env = Reach()
    agent = hpamdp.train(env, **OWN)
    discrete, parameters = agent.act(np.zeros(3, np.float32))
    assert (discrete, parameters) in env.action_space
    assert not hasattr(env, "target")


def test_a_learner_trains_in_a_plain_torchrl_loop_with_defaults():
    env = hpamdp.make("platform", num_envs=8)
    learner = hpamdp.HPPO(hpamdp.PAMDPSpecs.from_env(env), lr=3e-4)
    before = [each.clone() for each in learner.parameters()]
    for batch in Collector(env, learner.policy, frames_per_batch=256, total_frames=512):
        learner.learn(batch, mask=torch.ones(batch.shape, dtype=torch.bool))
    assert any(not torch.equal(*pair) for pair in zip(before, learner.parameters(), strict=True))


def test_an_agent_acts_in_a_vector_of_environments_as_in_single_ones(boat_agent):
    vector = hpamdp.make_gymnasium("boatdock", num_envs=3)
    observations, _ = vector.reset(seed=0)
    boat_agent.reset()
    actions = boat_agent.act(observations)
    assert actions in vector.action_space
    for row, observation in enumerate(observations):
        boat_agent.reset()
        single = boat_agent.act(observation)
        assert int(single["key"]) == actions["key"][row]
        np.testing.assert_allclose(single["duration"], actions["duration"][row], atol=1e-5)


# Import and names.


def test_importing_the_package_loads_no_torch_and_gives_exactly_the_public_names_and_frees_the_collector_of_imports():
    code = (
        "import gc, sys, hpamdp; assert 'torch' not in sys.modules; print(*hpamdp.__all__); "
        "hpamdp.load; assert gc.isenabled(); assert gc.get_freeze_count() == 0; "
        "print(gc.get_stats()[2]['collections'], len(gc.get_objects(generation=0)))"
    )
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    *names, searches, young = printed.split()
    assert int(searches) <= 2  # before torch is imported
    assert int(young) < 10_000
    assert {"Agent", "ConfigError", "HPPO", "UCB", "load", "make", "train"} <= {*names}
    assert all(getattr(hpamdp, name).__doc__ for name in names)


# Training.


def test_training_without_a_folder_writes_nothing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    agent = hpamdp.train("platform", low="hppo", **TINY)
    assert not [*tmp_path.iterdir()]
    assert agent.history[-1]["frames"] == 512
    assert isinstance(agent.policy, TensorDictModuleBase)


def test_training_with_a_folder_equals_the_command_lines_run(tmp_path, command):
    folder = tmp_path / "python"
    agent = hpamdp.train("platform", low="hppo", folder=folder, **TINY)
    words = [f"{name}={value}" for name, value in TINY.items() if name != "progress"]
    command("env=platform", "low=hppo", *words, f"hydra.run.dir={tmp_path / 'shell'}")
    texts = [(tmp_path / name / "config.yaml").read_text() for name in ("python", "shell")]
    assert texts[0] == texts[1]
    rows = hpamdp.load(tmp_path / "shell").history
    times = {"wall_s": 0, "cpu_s": 0}
    assert [row | times for row in agent.history] == [row | times for row in rows]


def test_an_interrupted_training_in_a_folder_goes_on_with_resume_auto(tmp_path):
    class Stop(hpamdp.Callback):
        def on_batch(self, trainer):
            raise KeyboardInterrupt

    arguments = {**TINY, "low": "hppo", "folder": tmp_path / "run"}
    agent = hpamdp.train("platform", callbacks=[Stop()], **arguments)
    assert agent.history[-1]["frames"] < 512
    assert hpamdp.train("platform", resume="auto", **arguments).history[-1]["frames"] == 512
    again = hpamdp.train("platform", resume="auto", **arguments)  # nothing is left to do
    assert again.history[-1]["frames"] == 512


def test_training_that_is_interrupted_in_its_first_evaluation_returns_an_agent_without_history(monkeypatch):
    monkeypatch.setattr(Evaluation, "run_agent", mock.Mock(side_effect=[KeyboardInterrupt]))
    agent = hpamdp.train("platform", low="hppo", **TINY)
    assert agent.history == [] and "untrained" in repr(agent)


def test_a_resumed_run_in_a_new_folder_keeps_its_rows_even_if_it_ends_before_its_first_own_one(tmp_path):
    class Fails(hpamdp.Callback):
        def on_batch(self, trainer):
            raise RuntimeError("once")

    arguments = {**TINY, "low": "hppo"}
    first = hpamdp.train("platform", folder=tmp_path / "a", **arguments)
    longer = {name: value for name, value in arguments.items() if name not in ("low", "env")} | {"total_frames": 1024}
    with pytest.raises(RuntimeError, match="once"):
        hpamdp.train(resume=tmp_path / "a", folder=tmp_path / "b", callbacks=Fails(), **longer)
    last = hpamdp.train(resume=tmp_path / "b", folder=tmp_path / "c", **longer)
    frames = [row["frames"] for row in last.history]
    assert frames[: len(first.history)] == [row["frames"] for row in first.history] and frames[-1] == 1024


def test_a_resumed_run_tells_that_schedules_have_ended(tmp_path, capsys):
    hpamdp.train("platform", low="hppo", folder=tmp_path / "run", **{**TINY, "low.anneal_steps": 512})
    hpamdp.train(resume=tmp_path / "run", folder=tmp_path / "more", **{**TINY, "total_frames": 1024})
    assert "but low.anneal_steps stay at 512" in capsys.readouterr().err


def test_the_environment_of_a_run_that_was_an_object_is_not_taken_for_the_same_in_silence(tmp_path, capsys):
    arguments = {**OWN, "folder": tmp_path / "run"}
    hpamdp.train(lambda: Reach(), **arguments)
    hpamdp.train(lambda: Reach(), resume="auto", **arguments)
    assert "whether it was the same one is not known" in capsys.readouterr().err


@pytest.mark.parametrize("env", ["hpamdp/Platform-v0", {"name": "platform", "max_steps": 20}])
def test_a_problem_may_be_an_id_or_a_dict(env):
    assert hpamdp.train(env, low="hppo", high=None, **TINY).history[-1]["frames"] == 512


def test_a_torchrl_problem_and_a_learners_class_are_trained(monkeypatch):
    class OwnLearner(hpamdp.HPPO):
        pass

    choices = ConfigStore.instance().repo  # later tests in this process list them
    monkeypatch.setitem(choices, "low", {**choices.get("low", {})})
    agent = hpamdp.train(hpamdp.make("goal", num_envs=4), low=OwnLearner, **{**TINY, "num_envs": 4})
    assert "OwnLearner" in repr(agent)
    assert agent.observation_space.shape == (17,)


def test_training_gives_torch_its_threads_back():
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        hpamdp.train("platform", low="hppo", **TINY)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


# Saving and loading.


def test_a_saved_agent_acts_as_before(platform_agent, tmp_path):
    platform_agent.save(tmp_path / "a.safetensors")
    observation = np.linspace(-0.5, 0.5, 9, dtype=np.float32)
    before = platform_agent.act(observation)
    for loaded in (hpamdp.load(tmp_path / "a.safetensors"), hpamdp.load(tmp_path / "a.safetensors", "platform")):
        after = loaded.act(observation)
        assert before[0] == after[0]
        for mine, theirs in zip(before[1], after[1], strict=True):
            np.testing.assert_array_equal(mine, theirs)


def test_a_saved_agent_keeps_the_learned_scale_of_its_observations(tmp_path):
    agent = hpamdp.train(Reach, **{**OWN, "env.observation_scaling": "running"})
    agent.save(tmp_path / "a.safetensors")
    loaded = hpamdp.load(tmp_path / "a.safetensors", env=Reach, **{"env.max_steps": 5})
    observation = np.array([0.9, -0.9, 0.3], np.float32)
    np.testing.assert_array_equal(agent.act(observation)[1][0], loaded.act(observation)[1][0])


def test_an_agent_that_was_trained_on_an_object_needs_it_again(tmp_path):
    hpamdp.train(lambda: Reach(), folder=tmp_path / "run", **OWN)
    with pytest.raises(hpamdp.ConfigError, match="trained on an object from Python; pass it again as env"):
        hpamdp.load(tmp_path / "run")
    agent = hpamdp.load(tmp_path / "run", env=Reach)
    assert agent.evaluate(episodes=3)["steps"] == 5.0
    assert {row["frames"] for row in agent.history} == {256.0, 512.0}
    assert (tmp_path / "run" / METRICS_NAME).is_file() and (tmp_path / "run" / CHECKPOINT_NAME).is_file()


def test_an_evaluation_returns_means_or_one_entry_for_each_episode(platform_agent):
    scores = platform_agent.evaluate(episodes=6, per_episode=True)["score"]
    assert scores.shape == (6,)
    assert platform_agent.evaluate(episodes=6)["score"] == pytest.approx(scores.mean())
    assert platform_agent.evaluate(episodes=6, seed=5)["score"] != pytest.approx(scores.mean())


# Bad input: one clear exception, and nothing is written.


@pytest.mark.parametrize(
    ("observation", "more", "message"),
    [
        (np.zeros(8), {}, r"shape \[8\], but must have \[9\] or \[N, 9\]"),
        (np.full(9, np.nan), {}, "entry 0 of the observation is not finite"),
        ("left", {}, "must hold 9 numbers, but is 'left'"),
        (TensorDict({"observation": torch.zeros(2, 9)}, [2]), {}, "must hold 9 numbers, but is TensorDict"),
        (np.zeros(9), {"greedy": "no"}, "must be True or False"),
        (np.zeros(9), {"info": 3}, "must be a dict"),
    ],
)
def test_wrong_arguments_of_act_are_refused(platform_agent, observation, more, message):
    with pytest.raises(ValueError, match=message):
        platform_agent.act(observation, **more)


def test_an_agent_scores_alike_in_vectors_that_restart_in_the_same_and_in_the_next_step(boat_agent):
    def first_scores(**mode):
        vector = hpamdp.make_gymnasium("boatdock", num_envs=8, **mode)
        scores: list[list[float]] = [[] for _ in range(8)]
        observations, _ = vector.reset(seed=0)
        boat_agent.reset()
        while min(map(len, scores)) < 4:
            observations, _, terminated, truncated, infos = vector.step(boat_agent.act(observations))
            done = terminated | truncated
            of_done = infos if mode else infos.get("final_info")
            for row in np.flatnonzero(done):
                scores[row].append(of_done["score"][row])
            boat_agent.reset(done, next_step=bool(mode))
        return np.array([of_row[:4] for of_row in scores])

    np.testing.assert_allclose(first_scores(autoreset_mode="NextStep"), first_scores(), atol=1e-4)


@pytest.mark.parametrize("name", ["UCB", "OptionCritic", "DLPA", "PETS"])
def test_a_step_without_a_batch_dimension_is_refused_in_one_line(name, boat_agent):
    level = getattr(hpamdp, name)(boat_agent.specs)
    policy = level if isinstance(level, hpamdp.Selector) else level.policy
    step = {"observation": torch.zeros(boat_agent.specs.observation_dim), "is_decision": torch.ones(1, dtype=bool)}
    line = r"the step has batch size \[\], but must have \[N\]; for one environment[^\n]*$"
    with pytest.raises(ValueError, match=line):
        policy(TensorDict(step))
    policy(TensorDict(step).unsqueeze(0))


def test_a_missing_reset_is_refused_once_an_episode_is_longer_than_the_problem_allows(boat_agent):
    boat_agent.reset()
    observation, _ = hpamdp.make_gymnasium("boatdock").reset(seed=0)
    with pytest.raises(ValueError, match=r"call reset\(\) when an episode begins"):
        for _ in range(1000):
            boat_agent.act(observation)
    boat_agent.reset()
    boat_agent.act(observation)


def test_another_batch_size_without_a_reset_is_refused(boat_agent):
    observations, _ = hpamdp.make_gymnasium("boatdock", num_envs=2).reset(seed=0)
    boat_agent.reset()
    boat_agent.act(observations)
    with pytest.raises(ValueError, match="got 1 observations, but 2 episodes are running"):
        boat_agent.act(observations[0])
    with pytest.raises(ValueError, match=r"starts must be bool \[2\]"):
        boat_agent.reset([True])


WITHOUT_FOLDER = {"folder": None}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"low": "hpp"}, "low=hpp: no such choice"),
        ({"total_frame": 3}, "did you mean total_frames"),
        ({"low": 3}, "must be a name, a class, None, or a dict"),
        ({"low.hidden_dims": np.zeros((2, 2))}, "must be a number, a text, or a list or mapping of these"),
        ({"mode": "eval"}, r"use hpamdp.load\(...\).evaluate"),
        ({"env": lambda: 3}, "is no environment"),
        ({"env": lambda: gymnasium.vector.SyncVectorEnv([Reach])}, "give a single one, of which num_envs makes copies"),
        ({"low": {"cls": hpamdp.HPPO}}, "HPPO.* is given as 'cls'; write {'name': ..., ...}"),
        ({"env": lambda: Reach}, "returned the class Reach, not an environment; call it"),
        ({"env": Reach}, "no time limit of its own; set env.max_steps"),
        ({"hydra.run.dir": "other"}, "Hydra runs no job here"),
        ({"folder": "file"}, "folder="),
        ({"resume": "auto", **WITHOUT_FOLDER}, "so give folder"),
        ({"logger": "wandb", **WITHOUT_FOLDER}, "writes files, so give the run a folder"),
        ({"checkpoint_every": 100, **WITHOUT_FOLDER}, "checkpoint_every=100: writes files, so give the run a folder"),
        ({"low": {"name": "hppo", "gamma": 0.9}, "low.gamma": 0.9}, "low.gamma: given twice, as 0.9 and as 0.9"),
    ],
)
def test_a_wrong_argument_of_train_is_one_line_and_nothing_is_written(tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    given = {"env": "platform", "low": "hppo", **TINY, "folder": "p/q/r", **arguments}
    with pytest.raises(hpamdp.ConfigError, match=message) as raised:
        hpamdp.train(given.pop("env"), **given)
    assert "\n" not in str(raised.value)
    assert [*tmp_path.iterdir()] == [tmp_path / "file"]


def test_an_agent_whose_selector_alone_was_trained_comes_back_whole(tmp_path):
    agent = hpamdp.train("boatdock", low="random", high="ucb", **TINY, **{"low.freeze": True})
    observation = agent.observation_space.sample()
    assert agent.action_space.contains(agent.act(observation))
    scores = agent.evaluate(episodes=3, seed=1, per_episode=True)["score"]
    agent.save(tmp_path / "policy.safetensors")
    assert np.array_equal(hpamdp.load(tmp_path).evaluate(episodes=3, seed=1, per_episode=True)["score"], scores)


def test_a_folder_with_another_run_is_refused_and_stays(tmp_path):
    hpamdp.train("platform", low="hppo", folder=tmp_path / "run", **TINY)
    before = {path.name: path.read_bytes() for path in Path(tmp_path, "run").iterdir()}
    with pytest.raises(hpamdp.ConfigError, match="holds the results of a run"):
        hpamdp.train("platform", low="hppo", folder=tmp_path / "run", **TINY)
    assert before == {path.name: path.read_bytes() for path in Path(tmp_path, "run").iterdir()}


@pytest.mark.parametrize("space", ["action_space", "observation_space"])
def test_bounds_of_an_environment_that_were_edited_are_told_of_wherever_an_agent_comes_back(
    space, tmp_path, monkeypatch, capsys
):
    by_bounds = {**OWN, "env.observation_scaling": "bounds"}
    trained = hpamdp.train(lambda: Reach(), folder=tmp_path / "run", **by_bounds)
    assert "has learned with" not in capsys.readouterr().err
    other = {
        "observation_space": spaces.Box(-3.0, 3.0, (3,), np.float32),
        "action_space": spaces.Tuple(
            (spaces.Discrete(2), spaces.Tuple((spaces.Box(-3, 3, (1,)), spaces.Box(0, 2, (2,)))))
        ),
    }
    monkeypatch.setattr(Reach, space, other[space])
    more = {**TINY, "total_frames": 1024}
    uses = [
        lambda: hpamdp.load(tmp_path / "run", lambda: Reach()),
        lambda: hpamdp.train(lambda: Reach(), resume=tmp_path / "run", folder=tmp_path / "more", **more),
    ]
    if space == "observation_space":  # bounds of parameters are refused there
        uses.append(lambda: trained.evaluate(lambda: Reach(), episodes=2))
    for use in uses:
        use()
        err = capsys.readouterr().err
        assert err.count("has learned with") == 1 and re.search(r"(_low\[0\]=-1|_width\[0\]=1), but GymnasiumEnv", err)


def test_another_order_of_the_observations_entries_is_told_of(tmp_path, capsys):
    class Ordered(Reach):
        observation_space = spaces.Dict([("far", spaces.Box(-1.0, 1.0)), ("near", spaces.Box(-1.0, 1.0))])

        def reset(self, **arguments):
            return self.observation_space.sample(), super().reset(**arguments)[1]

        def step(self, action):
            return self.observation_space.sample(), *super().step(action)[1:]

    class Turned(Ordered):
        observation_space = spaces.Dict([("near", spaces.Box(-1.0, 1.0)), ("far", spaces.Box(-1.0, 1.0))])

    trained = hpamdp.train(lambda: Ordered(), folder=tmp_path / "run", **OWN)
    hpamdp.load(tmp_path / "run", lambda: Ordered())
    assert "has learned with" not in capsys.readouterr().err
    for use in (lambda: hpamdp.load(tmp_path / "run", lambda: Turned()), lambda: trained.evaluate(lambda: Turned())):
        use()
        assert "entries of the observation whose order or names differ" in capsys.readouterr().err


def test_an_agent_is_refused_at_a_problem_of_other_sizes(platform_agent):
    with pytest.raises(hpamdp.ConfigError, match="env=goal has observation_dim=17, but the agent's problem 9"):
        platform_agent.evaluate("goal", episodes=2)


@pytest.mark.parametrize(("agent", "env_id"), [("pdqn_goal", "Goal"), ("hppo_moving", "Moving")])
def test_an_agent_plays_its_problem_in_gymnasiums_form_also_in_a_wrapper(agent, env_id):
    # Goal's form has no published initial parameters. Moving's has bounds, by which observations would be scaled.
    loaded, env = hpamdp.load(agent), gymnasium.make(f"hpamdp/{env_id}-v0")
    played = loaded.evaluate(env, episodes=10, per_episode=True)
    doubled = gymnasium.wrappers.TransformReward(env, lambda reward: 2.0 * reward)
    assert loaded.evaluate(doubled, episodes=10)["return"] == pytest.approx(2.0 * float(played["return"].mean()))
    own = loaded.evaluate(episodes=100, per_episode=True)["return"]
    assert float(played["return"].mean()) == pytest.approx(float(own.mean()), abs=float(own.std()))


def test_an_agent_that_reads_scaled_observations_is_refused_at_the_problem_itself():
    env = gymnasium.make("hpamdp/Moving-v0")
    agent = hpamdp.train(env, **TINY, low="random")
    with pytest.raises(ProblemError, match="learned with scaled observations, which this problem does not have"):
        agent.evaluate("moving", episodes=2)


@pytest.mark.parametrize(("name", "problem"), [("meta_critic_hppo_rooms", "rooms"), ("linucb_hppo", "boatdock")])
def test_acting_step_by_step_equals_the_evaluation_also_if_options_end_inside_episodes(name, problem):
    agent = hpamdp.load(name)
    expected = agent.evaluate(episodes=6, seed=3, per_episode=True)
    env = hpamdp.make(problem, num_envs=6)
    env.seed_evaluation(3)
    td, total = env.reset(env.fixed_episodes(3)), torch.zeros(6)
    done = torch.zeros(6, dtype=torch.bool)
    while not done.all():
        acted = agent.act(td["observation"].numpy())
        if isinstance(acted, dict):
            option, discrete, parameters = acted["option"], acted["key"], acted["duration"]
        else:
            option, discrete, parameters = *acted[:2], np.concatenate(acted[2], -1)
        leaves = {"option": option, ("action", "discrete"): discrete, ("action", "parameters"): parameters}
        for key, leaf in leaves.items():
            td[key] = torch.from_numpy(leaf)
        td = env.step(td)["next"]
        total += td["reward"].squeeze(-1)
        done |= td["done"].squeeze(-1)
    np.testing.assert_allclose(total, expected["return"], atol=1e-4)


def test_fewer_episodes_of_a_seed_are_the_first_of_more(platform_agent):
    few, more = (platform_agent.evaluate(episodes=num, per_episode=True)["return"] for num in (3, 6))
    np.testing.assert_array_equal(few, more[:3])


class Spoken(Toy):
    """Observe a dict of a box and a number."""

    def __init__(self):
        super().__init__()
        box, number = spaces.Box(-1.0, 1.0, (2,), np.float32), spaces.Box(0.0, 9.0, (), np.float32)
        self.observation_space = spaces.Dict(pos=box, time=number)

    def _observation(self):
        return {"pos": np.zeros(2, np.float32), "time": np.float32(self.steps)}


@pytest.fixture(scope="module")
def dict_agent() -> hpamdp.Agent:
    return hpamdp.train(Spoken, **OWN)


@pytest.mark.parametrize(
    ("observation", "line"),
    [
        (
            {"pos": np.zeros((2, 2)), "time": 0.0},
            "act: the entry time has the shape [], but the entry pos holds 2 observations, so it must have [2]",
        ),
        (
            {"pos": np.zeros(2), "time": np.zeros(3)},
            "act: the entry time has the shape [3], but the entry pos holds one observation, so it must have []",
        ),
        ({"pos": np.zeros((2, 2))}, "act: the observation lacks the entry time"),
    ],
)
def test_entries_that_are_missing_or_hold_other_numbers_of_observations_are_refused(dict_agent, observation, line):
    with pytest.raises(ValueError) as raised:
        dict_agent.act(observation)
    assert str(raised.value) == line


def test_a_batch_of_entries_of_a_dict_acts_as_its_rows_do(dict_agent):
    one = dict_agent.act({"pos": np.full(2, 0.5), "time": 1.0})
    both = dict_agent.act({"pos": np.full((2, 2), 0.5), "time": np.ones(2)})
    np.testing.assert_array_equal(both[0], [one[0], one[0]])


# Mistakes that a hostile user found: each is one line, or has the effect that one would expect.


def test_a_factory_that_returns_the_same_environment_twice_is_refused():
    same = Reach()
    with pytest.raises(hpamdp.ConfigError, match="made the same environment twice"):
        hpamdp.train(lambda: same, **OWN)


class Counted(Reach):
    """Knows which of its objects are open."""

    open_envs: ClassVar[list[Counted]] = []

    def __init__(self):
        self.open_envs.append(self)

    def close(self):
        self.open_envs.remove(self)


@pytest.fixture
def open_envs():
    Counted.open_envs.clear()
    yield Counted.open_envs
    Counted.open_envs.clear()


def test_environments_of_a_refused_run_are_closed(open_envs):
    with pytest.raises(hpamdp.ConfigError, match="compile_updates=true: low=random"):
        hpamdp.train(Counted, **{**OWN, "low": "random", "compile_updates": True})
    agent = hpamdp.train(Counted, **OWN)
    agent.evaluate(episodes=3)
    assert not open_envs


WRONG_OPTION = {"max_steps": 5, "grouping": {"all": [7]}}


@pytest.mark.parametrize(
    "call",
    [
        lambda agent: hpamdp.make(Counted, 3, **WRONG_OPTION),
        lambda agent: hpamdp.train({"name": Counted, **WRONG_OPTION}, low="hppo", **TINY),
        lambda agent: hpamdp.train(Counted, low={"name": "hppo", "value_symmetry": True}, **TINY, max_steps=5),
        lambda agent: hpamdp.load(agent, env=Counted),  # another problem than that of the agent
        lambda agent: hpamdp.load(agent).evaluate({"name": Counted, "max_steps": 5}, 3),
    ],
)
def test_environments_are_closed_after_an_error_which_is_the_one_that_is_told(call, open_envs):
    with pytest.raises(ValueError):
        call("hppo_platform")
    assert not open_envs


def test_random_numbers_stay_the_callers(tmp_path):
    hpamdp.train("platform", low="hppo", folder=tmp_path / "run", **TINY)
    with global_generators_unmoved(), torch.no_grad():
        hpamdp.load("hppo_platform")
        hpamdp.train(resume=tmp_path / "run", folder=tmp_path / "more", **{**TINY, "total_frames": 1024})


@pytest.mark.parametrize(
    ("source", "settings", "message"),
    [
        ("hppo_platform", {"mode": "train"}, "has no effect on a trained agent"),
        ("hppo_platform", {"eval": {"seed": 1, "layouts": 3}}, "has no effect on a trained agent"),
        ("hppo_platform", {"trust": "false"}, "must be True or False"),
        ("hppo_platform", {"max_stps": 5}, r"did you mean env\.max_steps"),
        ("no_such_agent", {}, "linucb_hppo"),
    ],
)
def test_wrong_arguments_of_load_are_refused(source, settings, message):
    with pytest.raises(hpamdp.ConfigError, match=message):
        hpamdp.load(source, **settings)


def test_home_directories_are_written_and_read_by_the_same_rule(tmp_path, monkeypatch, platform_agent):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    for folder in ("home", "./~"):
        Path(folder).mkdir()
    platform_agent.save("~/a.safetensors")
    hpamdp.train("platform", low="hppo", folder="~/run", **TINY)
    assert {"a.safetensors", "run"} == {path.name for path in (tmp_path / "home").iterdir()}
    assert hpamdp.load("~/a.safetensors").specs == hpamdp.load("~/run").specs
    platform_agent.save("./~/b.safetensors")  # no home directory
    assert hpamdp.load(tmp_path / "~/b.safetensors").specs == platform_agent.specs


def test_an_object_takes_the_place_of_the_environment_of_a_saved_run(tmp_path):
    settings = {**TINY, "max_steps": 5, "low": "hppo"}
    hpamdp.train("toy_environments:Toy", folder=tmp_path / "run", **settings)
    made = []

    def make():
        made.append(Toy())
        return made[-1]

    agent = hpamdp.load(tmp_path / "run", env=make)
    assert made and agent._env.envs[0].unwrapped in made
    with pytest.raises(hpamdp.ConfigError, match=r"env\.entry_point=toy_environments:Toy: give only one of them"):
        hpamdp.load(tmp_path / "run", env=make, entry_point="toy_environments:Toy")


class Masked(Reach):
    """Reach with one of the actions forbidden, in the info."""

    def reset(self, *, seed=None, options=None):
        observation, _ = super().reset(seed=seed)
        return observation, {"action_mask": np.array([1, 0])}

    def step(self, action):
        observation, reward, *flags, _ = super().step(action)
        return observation, reward, *flags, {"action_mask": np.array([1, 0])}


def test_masks_in_the_info_are_honoured_and_checked():
    agent = hpamdp.train(Masked, **OWN, **{"env.action_mask": "info"})
    observation = np.zeros(3, np.float32)
    assert agent.act(observation, {"action_mask": [True, False]})[0] == 0
    assert agent.act(observation, {"action_mask": [False, True]})[0] == 1
    batch = agent.act(np.zeros((2, 3), np.float32), {"action_mask": np.array([[1, 0], [0, 1]])})
    assert batch[0].tolist() == [0, 1]
    for mask, message in (([False, False], "allows nothing"), ([True], "action_mask"), ([2, 0], "action_mask")):
        with pytest.raises(ValueError, match=message):
            agent.act(observation, {"action_mask": mask})
    with pytest.raises(ValueError, match="give the info of the step"):
        agent.act(observation)


def test_an_evaluation_elsewhere_keeps_the_agents_settings_of_the_problem():
    agent = hpamdp.train({"name": Reach, "max_steps": 5}, **TINY, low="hppo")
    assert agent.evaluate(Reach, episodes=2)["steps"] == 5.0
    assert agent.evaluate({"name": Reach, "max_steps": 7}, episodes=2)["steps"] == 7.0


def test_numbers_of_an_evaluation_are_checked_by_their_names(platform_agent):
    assert platform_agent.evaluate(episodes=np.int64(2), seed=np.int64(3))["steps"] > 0
    for arguments in ({"episodes": 0}, {"episodes": 1.5}, {"episodes": "x"}, {"episodes": 10**15}, {"seed": -1}):
        with pytest.raises(hpamdp.ConfigError, match=next(iter(arguments))):
            platform_agent.evaluate(**arguments)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: hpamdp.make("platform", 1.5), "num_envs"),
        (lambda: hpamdp.make("platform", oracle=True), "oracle=True: env=platform has no planner to ask"),
        (lambda: hpamdp.make("hpamdp/Platform-v1"), r"no such problem .*; did you mean hpamdp/Platform-v0"),
        (lambda: hpamdp.make("platform", grouping={"up": ["hop", "hop"]}), "option up has an action twice: hop, hop"),
        (lambda: hpamdp.make_gymnasium("platform", seed=3), "seed=3: no setting of the environment; give it to reset"),
        (lambda: hpamdp.make_gymnasium("platform", render_mode="ansi"), "must be None or rgb_array"),
        (lambda: hpamdp.make_gymnasium("BoatDockUnseen", render_mode="rgb_array"), "has no pictures"),
        (lambda: hpamdp.make_gymnasium("lunar_lander", gravty=-3.0), r"no such setting .*; did you mean gravity\? It"),
        (lambda: hpamdp.train("platform", low="hppo", lr=1e-3), r"did you mean low\.lr\?"),
        (lambda: hpamdp.train("platfrom"), r"did you mean platform\? conf/env has "),
        (lambda: hpamdp.report(__file__), r"test_api\.py: a file; give the folder of a run, or one that contains runs"),
        (lambda: hpamdp.HPPO("platform"), r"specs='platform': must be PAMDPSpecs.from_env\(env\)"),
        (lambda: hpamdp.UCB(policy="MlpPolicy", env=3), r"specs='MlpPolicy': .* hpamdp.train\(env, low=...\) trains"),
        (lambda: hpamdp.load("hppo_platform").evaluate(n_eval_episodes=3), "no such argument; use episodes"),
        (lambda: hpamdp.load("hppo_platform").act(None, deterministic=True), r"did you mean agent.act\(.*greedy"),
        (lambda: hpamdp.train("platform", policy_kwargs={}), r"policy_kwargs: .* did you mean low\.hidden_dims\?"),
        (lambda: hpamdp.BestAgent("x.pt"), "'x.pt': no such argument; its file is always best.safetensors"),
        (lambda: hpamdp.PAMDPSpecs.from_env("platform"), "'platform' is no PAMDPEnv; hpamdp.make makes one"),
    ],
)
def test_wrong_arguments_are_one_line(make, message):
    with pytest.raises(ValueError, match=message) as raised:
        make()
    assert "\n" not in str(raised.value)


def test_a_class_of_another_library_names_ours():
    with pytest.raises(AttributeError, match=r'^.hpamdp. .* use hpamdp.train\(env, low="hppo"\) or hpamdp.HPPO '):
        hpamdp.PPO  # noqa: B018


@pytest.mark.parametrize("name", ["platform", "lunar_lander"])
def test_the_vector_of_every_problem_restarts_as_autoreset_mode_says(name):
    for mode in ("NextStep", "SameStep", gymnasium.vector.AutoresetMode.DISABLED, None):
        env = hpamdp.make_gymnasium(name, 2, autoreset_mode=mode)
        assert env.metadata["autoreset_mode"] == gymnasium.vector.AutoresetMode(mode or "SameStep")
        env.close()


def test_an_id_with_its_module_is_made_as_a_vector_and_its_arguments_are_named(tmp_path, monkeypatch):
    own = "import gymnasium\ngymnasium.register('OwnPole-v0', 'gymnasium.envs.classic_control:CartPoleEnv')\n"
    (tmp_path / "own_pole.py").write_text(own)
    monkeypatch.syspath_prepend(tmp_path)
    hpamdp.make_gymnasium("own_pole:OwnPole-v0", 2, max_episode_steps=5).close()
    with pytest.raises(hpamdp.ConfigError, match=r"got an unexpected keyword argument 'render_mod'"):
        hpamdp.make_gymnasium("own_pole:OwnPole-v0", 2, render_mod="rgb_array")


FIVE_STEPS = {"name": "platform", "max_steps": 5}


@pytest.mark.parametrize(
    "call",
    [
        lambda: hpamdp.make(FIVE_STEPS, **{"env.max_steps": 7}),
        lambda: hpamdp.make({"name": FIVE_STEPS, "max_steps": 7}),
        lambda: hpamdp.train(FIVE_STEPS, max_steps=7),
        lambda: hpamdp.load("hppo_platform").evaluate("platform", 2, max_steps=5, **{"env.max_steps": 7}),
    ],
)
def test_a_setting_of_the_problem_that_is_given_twice_is_refused(call):
    with pytest.raises(hpamdp.ConfigError, match=r"^(env\.)?max_steps: given twice, as [57] and as [57]; leave"):
        call()


def test_settings_change_those_that_a_built_problem_brings_along():
    built = hpamdp.make("platform", max_steps=5)
    assert hpamdp.make(built, max_steps=7).max_steps == 7
    assert hpamdp.make({"name": built, "max_steps": 7}).max_steps == 7


def test_a_built_problem_brings_its_options_and_its_number_of_environments_along():
    built = hpamdp.make("platform", num_envs=8, grouping="default", max_steps=7)
    again = hpamdp.make(built)
    assert (again.num_envs, again.max_steps) == (8, 7)
    assert again.option_names == built.option_names == ("run", "jump") and again.option_actions == built.option_actions
    assert hpamdp.make(built, num_envs=2).num_envs == 2
    assert hpamdp.make(built, grouping={"all": [0, 1, 2]}).option_names == ("all",)
    assert hpamdp.make(hpamdp.make("platform", num_envs=2)).option_names == ()
    short = {"low": "random", "total_frames": 32, "eval.layouts": 2, "progress": False}
    agent = hpamdp.train(built, **short)
    assert agent._env.option_names == built.option_names
    assert agent.evaluate(built, episodes=2)["steps"] > 0.0
    for other in (built, {"name": "platform", "grouping": "default"}):
        with pytest.raises(hpamdp.ConfigError, match=r"^env\.grouping=.*: a trained agent keeps the options"):
            hpamdp.load("hppo_platform").evaluate(other, episodes=2)


def test_training_has_as_many_environments_as_a_built_problem_unless_told_otherwise():
    built = hpamdp.make("platform", num_envs=3)
    short = {"low": "random", "steps_per_batch": 2, "total_frames": 12, "progress": False, "eval.layouts": 4}
    assert hpamdp.train(built, **short)._config.run.num_envs == 3
    assert hpamdp.train(built, **short, num_envs=2)._config.run.num_envs == 2


def test_different_entries_of_a_mapping_may_come_in_two_ways_and_an_empty_one_gives_nothing():
    agent = hpamdp.train("platform", low={"name": "hppo", "gamma": 0.9}, eval={"seed": 3}, **{**TINY, "low.lr": 1e-4})
    low = agent._config.low.settings
    assert (low["gamma"], low["lr"]) == (0.9, 1e-4)
    assert (agent._config.run.eval.seed, agent._config.run.eval.layouts) == (3, TINY["eval.layouts"])
    agent = hpamdp.train("platform", **{**TINY, "low": "random", "eval": {}})
    assert agent._config.run.eval.layouts == TINY["eval.layouts"]


@pytest.mark.parametrize("name", ["max_steps", "env.max_steps"])
def test_a_setting_of_the_problem_has_the_same_names_for_all_functions(name, platform_agent):
    settings = {name: 2}
    short = {"num_envs": 4, "steps_per_batch": 8, "total_frames": 32, "progress": False, "eval.layouts": 4}
    assert hpamdp.make("platform", **settings).max_steps == 2
    env = hpamdp.make_gymnasium("platform", **settings)
    env.reset(seed=0)
    steps = [env.step(env.action_space.sample()) for _ in range(2)]
    assert any(steps[-1][2:4])
    trained = hpamdp.train("platform", low={"name": "hppo", "minibatch_size": 16}, **short, **settings)
    for agent in (trained, hpamdp.load("hppo_platform", **settings)):
        assert agent.evaluate(episodes=3)["steps"] <= 2.0
    assert platform_agent.evaluate(episodes=3, **settings)["steps"] <= 2.0


def test_make_warns_of_settings_that_count_only_with_another_one(capsys):
    hpamdp.make("lunar_lander", wind_power=3.0)
    warning = "env.wind_power=3.0: has no effect; wind_power counts only if enable_wind is set\n"
    assert capsys.readouterr().err == warning
    hpamdp.make("lunar_lander", wind_power=3.0, enable_wind=True)
    assert capsys.readouterr().err == ""


def test_an_experiment_that_is_a_sweep_is_refused_until_each_swept_setting_has_a_value():
    tiny = {"high": None, **TINY, "low": "random"}
    complaint = (
        "experiment=few_steps: a sweep over seed, env.controller, for the command line; to train one agent, give"
    )
    with pytest.raises(hpamdp.ConfigError, match=complaint):
        hpamdp.train(experiment="few_steps", **tiny)
    with pytest.raises(hpamdp.ConfigError, match=r"a sweep over env\.controller, .* give it a value"):
        hpamdp.train(experiment="few_steps", seed=3, **tiny)
    hpamdp.train(experiment="few_steps", seed=3, controller="congruent", **tiny)


def test_threads_get_their_own_agents_and_a_line_says_that_no_seed_repeats_them(capsys):
    agents: dict[str, hpamdp.Agent] = {}

    def run(name: str) -> None:
        agents[name] = hpamdp.train(name, low="hppo", **TINY)

    class Nested(hpamdp.Callback):
        def on_end(self, trainer):
            thread = threading.Thread(target=run, args=("moving",))
            thread.start()
            thread.join()

    outer = hpamdp.train("platform", low="hppo", callbacks=[Nested()], **TINY)
    assert (outer.specs.observation_dim, agents["moving"].specs.observation_dim) == (9, 10)
    assert "no seed repeats them" in capsys.readouterr().err
