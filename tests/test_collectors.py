"""Collection beyond one process: the same batches, the learner's weights, and nothing left running."""

import copy
import importlib
import importlib.util
import itertools
import multiprocessing
import os
import pickle
import re
import signal
import subprocess
import sys
import threading
import time
from contextlib import closing, suppress
from dataclasses import replace

import pytest
import torch
from conftest import CONF, OF_EACH_KIND, TRAINED, compose_config, forked_workers, make_config
from test_grid import SHORT

from hpamdp import keys
from hpamdp.config.errors import ConfigError
from hpamdp.env.base import ProblemError
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.gymnasium.values import MisfitError
from hpamdp.limits import limit_of
from hpamdp.run import checkpoint
from hpamdp.run.assemble import assemble
from hpamdp.run.collection.base import CollectionError, WorkerDiedError
from hpamdp.run.collection.multi import MultiCollection
from hpamdp.run.collection.options import WorkerOptions
from hpamdp.run.collection.worker import (
    EnvShard,
    PolicyCopy,
    RemoteError,
    ShardCollector,
    WorkingDir,
    pack_state,
)
from hpamdp.run.collection.workers import WorkerCollection, call_worker
from hpamdp.run.train import run

# By default the updates of long runs are compiled, which takes much longer than these tests.
SMALL = ["num_envs=8", "steps_per_batch=4", "eval.layouts=4", "low=hppo", "low.minibatch_size=16"]
SMALL += ["compile_updates=false"]
GYMNASIUM = ["env.id=hpamdp/BoatDock-v0", "env.kwargs={controller:congruent}", "env.max_steps=9"]
UNSCALED = ["env.observation_scaling=bounds", "env.reward_scaling=null"]  # since shares have statistics of their own
NEEDS_RAY = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs Ray")
WORKERS = ["multi", pytest.param("ray", marks=[pytest.mark.slow, NEEDS_RAY])]


def make(folder, *overrides):
    config = make_config([*SMALL, *overrides])
    parts = assemble(config)
    return parts, config.collector.build(config=config, parts=parts, frames=0)


def share(folder, *overrides, first_env=0, num_envs=8, low=None):
    config = make_config([*SMALL, *overrides])
    specs = assemble(config).agent.specs
    return EnvShard(config, specs, first_env, num_envs, env_seed=0, exploration_seed=0, low=low)


def leaves(batch):
    return {name: (leaf.shape, leaf.dtype) for name, leaf in batch.items(True, True)}


def policies_of_workers(collection):
    return [call_worker(worker, "policy.policy.state_dict") for worker in collection.workers]


def assert_same_state(one, other):
    assert list(one) == list(other)
    for name, value in one.items():
        if torch.is_tensor(value):
            torch.testing.assert_close(value, other[name], rtol=0.0, atol=0.0)


@pytest.fixture(scope="module", params=WORKERS)
def workers(request, tmp_path_factory):
    # `test_batches_ahead_are_made_by_the_policy_from_before_the_last_update` starts its worker as runs do.
    with forked_workers():
        parts, collection = make(tmp_path_factory.mktemp(request.param), f"collector={request.param}")
    yield parts, collection
    collection.close()
    wait_until(lambda: not multiprocessing.active_children(), seconds=30)


def test_workers_give_the_batches_of_a_single_process(workers, tmp_path):
    collection = workers[1]
    _, single = make(tmp_path, "collector=single")
    batch, expected = collection.next(), single.next()
    assert batch.shape == expected.shape == (8, 4)
    assert leaves(batch) == leaves(expected)
    # The same boats in the same order, no two of them alike.
    start = batch["observation"][:, 0]
    torch.testing.assert_close(start, expected["observation"][:, 0])
    assert len(start.unique(dim=0)) == 8


def test_the_next_batch_goes_on_where_the_last_one_ended(workers):
    collection = workers[1]
    last, following = collection.next(), collection.next()
    is_on = ~last["next", "done"][:, -1, 0]
    assert is_on.any()
    assert torch.equal(last["next", "observation"][:, -1][is_on], following["observation"][:, 0][is_on])
    columns = collection.state()["env"]
    assert all(len(column) == 8 for column in columns.values())
    # Scaled observations end in goal - boat, px over the harbour's radius.
    offset = following["next", "observation"][:, -1, -2:]
    scale = (columns["goal_x"] - columns["x"]) / offset[:, 0]
    is_on = ~following["next", "done"][:, -1, 0]
    torch.testing.assert_close(scale[is_on], scale[is_on][:1].expand(int(is_on.sum())), rtol=1e-3, atol=0.0)


def test_what_was_learned_reaches_the_workers_before_their_next_batch(workers):
    parts, collection = workers
    before = {name: value.clone() for name, value in parts.policy.state_dict().items() if torch.is_tensor(value)}
    for _ in range(3):
        parts.agent.learn(collection.next())
    now = parts.policy.state_dict()
    assert any(not torch.equal(value, now[name]) for name, value in before.items())
    collection.next()
    for theirs in policies_of_workers(collection):
        # A worker's selector has counted its own choices since.
        pending = {name: value for name, value in now.items() if name.endswith("pending")}
        assert_same_state(now, {**theirs, **pending})
    assert collection.cpu_s > 0.0


@pytest.mark.parametrize(
    "low", [pytest.param(low, marks=[] if low in OF_EACH_KIND else [pytest.mark.slow]) for low in TRAINED]
)
def test_a_copy_takes_all_that_a_policy_acts_by(low):
    warmup = ["low.warmup_steps=8"] if low in ("hyar", "hsac", "iql", "pdqn", "qpamdp", "td3_bc") else []
    small = [word for word in SHORT.get(low, []) if "warmup_steps" not in word]
    sizes = ["num_envs=8", "steps_per_batch=8", "eval.layouts=4", "compile_updates=false"]
    annealed = ["low.max_scale_final=0.7", "low.anneal_steps=64"] if low == "hppo" else []
    config = make_config([*sizes, "high=ucb", f"low={low}", *small, *warmup, *annealed])
    parts = assemble(config)
    collection = config.collector.build(config=config, parts=parts, frames=0)
    torch.manual_seed(1)
    copy = EnvShard(config, parts.agent.specs, 0, 8, env_seed=0, exploration_seed=1, low=None).make_policy()
    for _ in range(2):
        parts.agent.learn(collection.next())
    batch = collection.next()[:, 0].select(*parts.policy.in_keys, strict=False)
    copy.receive(pack_state(parts.policy))
    assert copy.cpu_s() > 0.0
    assert_same_state(parts.policy.state_dict(), copy.policy.state_dict())
    buffers, copied = (sorted(each.named_buffers(remove_duplicate=False)) for each in (parts.policy, copy.policy))
    assert_same_state(dict(buffers), dict(copied))  # those too that no state dict has
    torch.manual_seed(2)
    expected = parts.policy(batch.clone())
    torch.manual_seed(2)
    acted = copy(batch.clone())
    for name, leaf in expected.items(True, True):
        torch.testing.assert_close(acted[name], leaf, equal_nan=True, msg=str(name))


@pytest.mark.parametrize(
    "overrides",
    [["high=ucb", "env.sensor_noise=1"], ["env=gymnasium", "high=none", *GYMNASIUM, *UNSCALED]],
    ids=["boats", "copies"],
)
def test_shares_together_are_the_environments_of_a_single_process(overrides, tmp_path):
    whole = share(tmp_path, *overrides).make_env()
    halves = [share(tmp_path, *overrides, first_env=first, num_envs=4).make_env() for first in (0, 4)]
    torch.manual_seed(0)
    actions = whole.rand_action(whole.reset()).select(*whole.action_keys)
    starts = [half.reset() for half in halves]
    expected = whole.step(whole.reset().update(actions))
    acted = torch.cat([h.step(h.reset().update(a)) for h, a in zip(halves, actions.split(4), strict=True)])
    assert starts[0].shape == (4,)
    for name in ("observation", "reward"):
        torch.testing.assert_close(acted["next", name], expected["next", name])


def test_a_collection_goes_on_where_another_one_stood(workers, tmp_path):
    collection = workers[1]
    collection.next()
    state = collection.state()
    _, single = make(tmp_path, "collector=single")
    single.set_state(state)
    expected, batch = collection.next(), single.next()
    torch.testing.assert_close(batch["observation"][:, 0], expected["observation"][:, 0])


def test_batches_ahead_are_made_by_the_policy_from_before_the_last_update(quick_workers, tmp_path):
    words = ["high=uniform", "collector=multi", "collector.num_workers=1", "collector.ahead=true"]
    parts, collection = make(tmp_path, *words)
    with closing(collection):
        last = collection.next()
        before = {name: torch.as_tensor(value).clone() for name, value in parts.policy.state_dict().items()}
        as_given = last.clone()
        assert parts.agent.learn(last)
        state = copy.deepcopy(collection.state())
        (theirs,) = policies_of_workers(collection)
        assert_same_state(before, theirs)
        assert (last == as_given).all(), "the next batch is written elsewhere"

        batches = [last, collection.next(), collection.next()]
        for one, following in itertools.pairwise(batches):
            is_on = ~one["next", "done"][:, -1, 0]
            assert torch.equal(one["next", "observation"][:, -1][is_on], following["observation"][:, 0][is_on])
        collection.state()
        assert_same_state(parts.policy.state_dict(), *policies_of_workers(collection))

        collection.set_state(state)
        for batch in batches[1:]:
            same = collection.next()
            for name in ("observation", ("action", "parameters")):
                assert torch.equal(batch[name], same[name])


@pytest.mark.parametrize("collector", ["single", pytest.param("multi", marks=pytest.mark.slow)])
def test_a_resumed_run_of_a_gymnasium_environment_begins_new_episodes_with_the_saved_statistics(collector):
    words = [*SMALL, "env=gymnasium", "env.id=CartPole-v1", "env.observation_scaling=running", "high=none"]
    words += [f"collector={collector}", *(["collector.num_workers=2"] if collector == "multi" else [])]
    config, saved, firsts = make_config(words), None, []
    for frames in (0, 0, 320, 640):
        parts = assemble(config)
        with closing(config.collector.build(config=config, parts=parts, frames=frames)) as collection:
            if frames:
                collection.set_state(saved)
            batch = collection.next()
            if saved is None:
                for _ in range(10):
                    collection.next()
                saved = collection.state()
            scaling = parts.env.base_env.scaling
            firsts.append(batch[keys.OBSERVATION][:, 0])
            assert scaling.statistics.count > (300 if frames else 8 * 4)
    assert torch.equal(firsts[0], firsts[1])
    assert not torch.equal(firsts[2], firsts[3]) and not torch.equal(firsts[1], firsts[2])


def test_a_frozen_presser_goes_with_the_share(tmp_path):
    parts = assemble(make_config([*SMALL, "high=ucb", "low.freeze=true"]))
    torch.manual_seed(5)
    work = share(tmp_path, "high=ucb", "low.freeze=true", low=pack_state(parts.agent.router))
    env, policy = work.make_env(), work.make_policy()
    policy.receive(pack_state(parts.policy))
    one, other = parts.env.reset(), env.reset()
    option = torch.tensor([0, 1] * 4)
    one, other = parts.env.step(one.set("option", option)), env.step(other.set("option", option))
    torch.testing.assert_close(one["next", "reward"], other["next", "reward"])
    assert isinstance(policy, PolicyCopy) and policy.out_keys == ["option"]


def test_a_missing_ray_is_told_with_its_cure(monkeypatch, tmp_path):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "ray" else find(name))
    with pytest.raises(ConfigError, match=r"collector=ray: ray is not installed; pip install hpamdp\[ray\]"):
        run(compose_config([*SMALL, "collector=ray"]), tmp_path)


class InProcess:
    """Has the interface of TorchRL's collector of one worker, but steps the environments in this process."""

    def __init__(self, shard):
        self.deaths = []  # the names of the methods that will be its last
        env, policy = shard.make_env(), shard.make_policy()
        frames = shard.num_envs * shard.config.run.steps_per_batch
        self.collector = ShardCollector(
            env, policy, frames_per_batch=frames, total_frames=-1, auto_register_policy_transforms=False
        )

    def map_fn(self, method, arguments):
        if method in self.deaths:
            raise EOFError
        return [self.collector.cascade_execute(method, *arguments[0])]

    def shutdown(self):
        pass


class Mortal(WorkerCollection):
    """A collection whose workers live in this process, and die if a test says so."""

    def __init__(self, folder, max_restarts, *overrides, frames=0, **settings):
        config = make_config([*SMALL, "high=ucb", *overrides])
        self.parts = assemble(config)
        self.shards = []
        super().__init__(config, self.parts, frames, num_workers=2, max_restarts=max_restarts, **settings)

    def _start(self, shard):
        self.shards.append(shard)
        return InProcess(shard)

    def _death(self, worker, error):
        return "murder" if isinstance(error, EOFError) else None

    def have_die(self, number, at="collect"):
        self.workers[number].deaths.append(at)


def test_a_replaced_worker_begins_new_episodes_and_counts_no_half_ones(tmp_path, capsys):
    with closing(Mortal(tmp_path, 9, "steps_per_batch=3")) as collection:
        sums, starts = torch.zeros(8), 0
        for i in range(9):
            if i % 3 == 1:
                collection.have_die(i % 2)
            before = collection.state()["root"]["observation"]
            batch = collection.next()
            assert batch.shape == (8, 3)
            is_killed = (torch.arange(8) // 4 == i % 2) & (i % 3 == 1)
            assert ((before == batch["observation"][:, 0]).all(-1) == ~is_killed).all()
            for step in batch.unbind(-1):
                is_first = step[keys.EPISODE_STEPS].squeeze(-1) == 0
                starts += int(is_first.sum())
                sums = torch.where(is_first, 0.0, sums) + step["next", keys.REWARD].squeeze(-1)
                torch.testing.assert_close(step["next", keys.EPISODE_RETURN].squeeze(-1), sums)
        assert starts > 8
        name = "collector=single: worker {} of 2 died (murder); starting another (restart {} of 9)"
        assert capsys.readouterr().err.splitlines() == [name.format(1, 1), name.format(0, 2), name.format(1, 3)]
        seeds = {(shard.first_env, shard.env_seed, shard.exploration_seed) for shard in collection.shards}
        assert len(seeds) == 5 and len({shard.exploration_seed for shard in collection.shards}) == 5
        assert [shard.env_seed for shard in collection.shards[:2]] == [0, 0]


def test_no_worker_is_replaced_if_more_die_than_may_be_replaced(tmp_path, capsys):
    with closing(Mortal(tmp_path, 1)) as collection:
        collection.next()
        for number in range(2):
            collection.have_die(number)
        with pytest.raises(WorkerDiedError):
            collection.next()
        assert capsys.readouterr().err == ""


@pytest.mark.parametrize("at", ["policy.generator_state", "_carrier.to_dict"])
def test_a_worker_that_dies_while_its_state_is_read_is_replaced_for_the_next_batch(at, tmp_path):
    with closing(Mortal(tmp_path, 1)) as collection:
        collection.next()
        state = collection.state()
        collection.have_die(0, at)
        assert collection.state() is state
        collection.have_die(0)
        batch = collection.next()
        assert (batch[keys.EPISODE_STEPS][:4, 0] == 0).all()
        assert torch.equal(state["root"]["observation"][4:], batch["observation"][4:, 0])


def test_a_run_saves_before_it_waits_for_a_replacement_and_a_signal_ends_the_wait(tmp_path, monkeypatch):
    file, workers, seen = tmp_path / "run/checkpoint.safetensors", [], []

    def start(self, shard):
        if len(workers) == 2:  # the replacement never starts, as if Ray's node was gone
            time.sleep(60.0)
            raise RuntimeError("nothing ended the wait")
        workers.append(InProcess(shard))
        return workers[-1]

    def kill_and_stop():
        metrics = tmp_path / "run/metrics.csv"  # the third line is that of the first batches
        wait_until(lambda: metrics.is_file() and len(metrics.read_text().splitlines()) > 2, seconds=60)
        workers[0].deaths.append("collect")
        wait_until(file.is_file, seconds=30)
        time.sleep(0.5)
        seen.extend([checkpoint.progress_of(file)["frames"], time.monotonic()])
        os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(MultiCollection, "_start", start)
    monkeypatch.setattr(MultiCollection, "_death", Mortal._death)
    words = ["collector=multi", "collector.max_restarts=1", "total_frames=100000000", "log_every=32", "eval.every=0"]
    stopping = threading.Thread(target=kill_and_stop)
    stopping.start()
    assert run(compose_config([*SMALL, "high=ucb", *words]), tmp_path / "run") == 130
    stopping.join()
    frames, since = seen
    assert time.monotonic() - since < 10.0
    assert checkpoint.progress_of(file)["frames"] == frames > 0


def test_the_death_after_the_last_restart_ends_the_run_with_the_last_known_state(tmp_path):
    with closing(Mortal(tmp_path, 1)) as collection:
        collection.next()
        state = collection.state()
        collection.have_die(1)
        collection.next()
        collection.have_die(1, "env.env_state")
        collection.have_die(1)
        assert collection.state() is state
        with pytest.raises(WorkerDiedError, match=r"worker 1 of 2 died \(murder\)$"):
            collection.next()
        assert collection.state() is state


def fail_in_a_batch(collection, monkeypatch):
    """Have a batch fail at its second step."""
    step, numbers = BoatDockEnv.step_and_restart, itertools.count()

    def failing(self, td):
        if next(numbers):
            raise ProblemError("broken")
        return step(self, td)

    with monkeypatch.context() as patch, pytest.raises(ProblemError, match="broken"):
        patch.setattr(BoatDockEnv, "step_and_restart", failing)
        collection.next()


def test_an_error_in_a_batch_leaves_the_state_before_that_batch(tmp_path, monkeypatch):
    _, collection = make(tmp_path)
    for _ in range(3):
        collection.next()
    before = copy.deepcopy(collection.state())
    fail_in_a_batch(collection, monkeypatch)
    _, resumed = make(tmp_path)
    resumed.set_state(collection.state())
    assert torch.equal(resumed.next()["observation"][:, 0], before["root"]["observation"])


def test_an_error_in_workers_keeps_the_present_scale_of_observations(tmp_path):
    words = ["env=gymnasium", "env.id=CartPole-v1", "env.observation_scaling=running", "high=none"]
    with closing(Mortal(tmp_path, 0, *words, "env.reward_scaling=null")) as collection:
        collection.next()
        collection.have_die(1)
        with pytest.raises(WorkerDiedError):
            collection.next()
        present = collection.parts.env.env_state()
        assert_same_state(present, collection.state()["env"])
        assert {int(count) for name, count in present.items() if "count" in name} == {8 * 5}


def test_a_batch_that_was_learned_from_is_not_in_the_last_known_state(tmp_path):
    with closing(Mortal(tmp_path, 0, ahead=True)) as collection:
        collection.next()
        assert "coming" in collection.state()
        collection.have_die(1)  # in the batch after the one that is coming
        collection.next()
        assert "coming" not in collection.state()


@pytest.mark.parametrize(
    ("error", "kind", "text"),
    [
        (ProblemError("gave\nnothing"), ProblemError, "gave\nnothing"),
        (RuntimeError("a\nbug"), RemoteError, "RuntimeError: a bug\n\nIn a worker:\nTraceback"),
        (MemoryError("too much"), MemoryError, "too much"),
        (MisfitError([1], "a number"), ProblemError, "gave [1], which must be a number"),
    ],
)
def test_an_error_in_a_workers_environment_is_no_death(error, kind, text, tmp_path, monkeypatch, capsys):
    def failing(self, td):
        raise error

    with closing(Mortal(tmp_path, 5)) as collection:
        with monkeypatch.context() as patch, pytest.raises(kind) as raised:
            patch.setattr(BoatDockEnv, "step_and_restart", failing)
            collection.next()
        assert str(raised.value).startswith(text) and "died" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (OSError(28, "No space left on device"), "shared memory is full (/dev/shm)"),
        (RuntimeError("unable to mmap 64 bytes from file </torch_1>: No space left on device (28)"), "--shm-size"),
        (RuntimeError("can't start new thread"), "raise ulimit -u"),
        (ValueError("No space left on device"), None),
    ],
)
def test_a_limit_of_the_machine_is_reported_with_its_cure(error, words, tmp_path, monkeypatch):
    assert limit_of(error) is None if words is None else words in limit_of(error)
    if words is not None:
        monkeypatch.setattr(Mortal, "_start", lambda self, shard: (_ for _ in ()).throw(error))
        with pytest.raises(CollectionError, match=r"^collector=single: ") as raised:
            Mortal(tmp_path, 0)
        assert words in str(raised.value) and "\n" not in str(raised.value)


def test_a_shard_elsewhere_finds_the_users_classes_after_all_packages(tmp_path, monkeypatch):
    monkeypatch.chdir("/")
    monkeypatch.setattr(sys, "path", [*sys.path])
    sent = pickle.dumps(replace(share(tmp_path), working_dir=WorkingDir(str(tmp_path))).make_env)
    assert pickle.loads(sent)().batch_size == (8,)
    assert sys.path[-1] == str(tmp_path) == os.getcwd()
    (tmp_path / "own_problem.py").write_text("class Own: pass")
    own = importlib.import_module("own_problem").Own()
    sent = pickle.dumps(replace(share(tmp_path), working_dir=WorkingDir(str(tmp_path)), config=own))
    sys.path.remove(str(tmp_path))
    del sys.modules["own_problem"]
    assert type(pickle.loads(sent).config).__name__ == "Own"


def test_a_worker_that_is_killed_is_replaced(workers, quick_workers, capsys):
    collection = workers[1]
    collection.options = WorkerOptions(max_restarts=1)
    assert collection.next().shape == (8, 4)
    first, other = collection.workers
    collection.kill(first)
    batch = collection.next()
    assert batch.shape == (8, 4) and (batch[keys.EPISODE_STEPS][:4, 0] == 0).all()
    assert collection.workers[0] is not first and collection.workers[1] is other
    (notice,) = capsys.readouterr().err.splitlines()
    assert "worker 0 of 2 died (" in notice and notice.endswith("; starting another (restart 1 of 1)")


MORTAL = """
import os
import multiprocessing
import pathlib
import signal
import time

import gymnasium
import numpy as np
from gymnasium import spaces


class Mortal(gymnasium.Env):
    observation_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
    action_space = spaces.Tuple((spaces.Discrete(1), spaces.Tuple((spaces.Box(-1.0, 1.0, (1,)),))))

    def __init__(self, run, way):
        # Ray's actors are no children of multiprocessing.
        is_worker = multiprocessing.parent_process() is not None or way in ("kill", "exit", "problem")
        self.way = way if is_worker and os.getpid() != run else "none"
        self.steps = 0
        if self.way == "hang" and pathlib.Path("dead").exists():
            time.sleep(1000.0)

    def reset(self, *, seed=None, options=None):
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.steps += 1
        if self.way == "sleep":
            pathlib.Path("asleep").touch()
            time.sleep(1000.0)
        if self.steps == 70 and self.way == "hang":
            pathlib.Path("dead").touch()
        if self.steps == 70 and self.way in ("kill", "hang"):
            os.kill(os.getpid(), signal.SIGKILL)
        if self.steps == 70 and self.way == "exit":
            os._exit(7)
        return np.zeros(2 if self.steps == 70 and self.way == "problem" else 1, np.float32), 1.0, False, False, {}
"""


@pytest.fixture
def mortal(tmp_path, monkeypatch):
    """Return the words of a run whose workers end in a way of one's choice after 70 steps."""
    (tmp_path / "mortal.py").write_text(MORTAL)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path)])
    problem = ["env=gymnasium", "env.entry_point=mortal:Mortal", "env.max_steps=4", "env.staggered=false"]
    problem += ["high=none", "eval.every=0"]
    yield lambda way: [*SMALL, *problem, f"env.kwargs={{run:{os.getpid()},way:{way}}}"]
    sys.modules.pop("mortal", None)


@pytest.mark.slow
@pytest.mark.parametrize("way", ["kill", "exit"])
@pytest.mark.parametrize("collector", WORKERS)
def test_a_run_goes_on_after_its_workers_deaths_if_it_may(collector, way, mortal, tmp_path, capsys):
    words = [*mortal(way), f"collector={collector}", "total_frames=640", "log_every=32"]
    assert run(compose_config(words), tmp_path / "ends") == 1
    err = capsys.readouterr().err
    line = rf"collector={collector}: worker [01] of 2 died \(.+\) at frame 544; to go on: .* resume=.*"
    assert [text for text in err.splitlines() if re.fullmatch(line, text)] and "Traceback" not in err
    assert checkpoint.progress_of(tmp_path / "ends/checkpoint.safetensors")["frames"] == 544
    assert collector == "ray" or not multiprocessing.active_children()

    assert run(compose_config([*words, "collector.max_restarts=2"]), tmp_path / "goes_on") == 0
    assert len(re.findall(r"starting another \(restart [12] of 2\)", capsys.readouterr().err)) == 2
    rows = (tmp_path / "goes_on/metrics.csv").read_text().splitlines()
    column = rows[0].split(",").index("train/return")
    returns = {row.split(",")[column] for row in rows[1:]} - {""}
    assert {float(value) for value in returns} == {4.0}
    assert rows[-1].startswith("640,") or rows[-1].startswith("640.0,")


@pytest.mark.slow
@pytest.mark.parametrize("collector", WORKERS)
def test_a_problem_in_a_worker_is_reported_in_one_line_and_what_was_learned_is_saved(collector, mortal, tmp_path):
    with pytest.raises(ConfigError, match=r"^env: GymnasiumEnv: mortal:Mortal: environment \d: gave an observation"):
        run(compose_config([*mortal("problem"), f"collector={collector}", "total_frames=6400"]), tmp_path / "run")
    assert checkpoint.progress_of(tmp_path / "run/checkpoint.safetensors")["frames"] == 544


@pytest.mark.slow
@pytest.mark.parametrize(
    ("collector", "stop"),
    [
        ("multi", os.killpg),
        ("multi collector.ahead=true", os.killpg),
        pytest.param("ray", os.killpg, marks=NEEDS_RAY),
        pytest.param("ray", os.kill, marks=NEEDS_RAY),
    ],
)
def test_a_terminals_ctrl_c_and_a_signal_to_the_run_stop_all_processes_and_the_run_goes_on_in_one(
    collector, stop, tmp_path
):
    command = [sys.executable, str(CONF.parent / "run.py"), *f"collector={collector}".split(), *SMALL]
    command.append("total_frames=100000000")
    folder = f"hydra.run.dir={tmp_path / 'run'}"
    # A session of its own is what a terminal gives: the signal goes to all of its processes.
    process = subprocess.Popen([*command, "log_every=32", folder], start_new_session=True, cwd=tmp_path)
    metrics = tmp_path / "run/metrics.csv"
    try:
        wait_until(lambda: metrics.is_file() and len(metrics.read_text().splitlines()) > 3, seconds=240)
        stop(process.pid, signal.SIGINT if stop is os.killpg else signal.SIGTERM)
        assert process.wait(120) == 130
        wait_until(lambda: stop is os.kill or not processes_of(process.pid), seconds=10)
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    frames = len(metrics.read_text().splitlines())
    more = checkpoint.progress_of(tmp_path / "run/checkpoint.safetensors")["frames"] + 32
    overrides = [f"resume={tmp_path / 'run'}", "collector=single", f"total_frames={more}"]
    assert run(compose_config(overrides), tmp_path / "resumed", overrides) == 0 and frames > 3


@pytest.mark.slow
def test_workers_in_the_middle_of_a_step_end_when_the_run_is_killed(mortal, tmp_path):
    command = [sys.executable, str(CONF.parent / "run.py"), "collector=multi", *mortal("sleep")]
    process = subprocess.Popen(command, start_new_session=True, cwd=tmp_path)
    try:
        wait_until((tmp_path / "asleep").exists, seconds=240)
        process.kill()
        process.wait()
        wait_until(lambda: not processes_of(process.pid), seconds=20)
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)


@pytest.mark.slow
def test_a_signal_ends_a_run_whose_replacement_hangs_as_it_starts(mortal, tmp_path):
    words = ["collector=multi", "collector.max_restarts=2", "total_frames=6400", "hydra.run.dir=run"]
    command = [sys.executable, str(CONF.parent / "run.py"), *mortal("hang"), *words]
    process = subprocess.Popen(command, start_new_session=True, cwd=tmp_path)
    try:
        wait_until((tmp_path / "run/checkpoint.safetensors").is_file, seconds=240)
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 130
        wait_until(lambda: not processes_of(process.pid), seconds=20)
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)


def wait_until(condition, seconds):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.1)


def processes_of(session):
    """Return the processes of a session, whatever their parents."""
    listed = subprocess.run(["ps", "-eo", "sid=,pid=,stat="], capture_output=True, text=True, check=True).stdout
    rows = [line.split() for line in listed.splitlines()]
    return [pid for sid, pid, state in rows if int(sid) == session and not state.startswith("Z")]


@pytest.mark.slow
def test_a_script_without_its_guard_is_told_of_it_in_the_last_line(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "import hpamdp\n"
        "hpamdp.train('platform', low='random', high=None, total_frames=128, num_envs=4, steps_per_batch=32,\n"
        "             progress=False, collector='multi', **{'eval.layouts': 2})\n"
    )
    done = subprocess.run([sys.executable, script], cwd=CONF.parent, capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].endswith("died (as it started)")
    assert "hpamdp.train: a worker process imports this script again; put what the script runs below" in done.stderr
    script.write_text(f"if __name__ == '__main__':\n    {script.read_text().replace(chr(10), chr(10) + '    ')}")
    done = subprocess.run([sys.executable, script], cwd=CONF.parent, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
