"""A checkpoint is whole or not there, and opening one runs no code and ends in one line whatever is wrong with it."""

import io
import json
import os
import pickle
import random
import zipfile
from pathlib import Path

import pytest
import torch
from conftest import compose_config, make_config
from test_grid import SHORT

import hpamdp
from hpamdp.config.errors import ConfigError
from hpamdp.run import checkpoint
from hpamdp.run.assemble import assemble
from hpamdp.run.state_checks import check_optimizer, example_steps, state_after_a_step
from hpamdp.run.train import run
from hpamdp.run.trainer import Trainer
from hpamdp.run_files import DIVERGED_NAME

SMALL = ["num_envs=8", "steps_per_batch=4", "total_frames=256", "eval.layouts=4", "eval.every=0", "high=ucb"]
PROGRESS = {"config": {}, "option_names": [], "frames": 0, "wall_s": 0.0, "cpu_s": 0.0, "last_score": None}
PDQN = [*SMALL, "low=pdqn", *SHORT["pdqn"]]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run") / "pdqn"
    assert run(compose_config(PDQN), folder, PDQN) == 0
    return folder


@pytest.fixture
def parts():
    return assemble(make_config(PDQN))


def rewritten(file, target, change):
    """Copy a checkpoint, with each member as `change(name, data)` gives it; None leaves it out."""
    with zipfile.ZipFile(file) as archive, zipfile.ZipFile(target, "w") as copy:
        for name in archive.namelist():
            data = change(name, archive.read(name))
            if data is not None:
                copy.writestr(name, data)
    return target


def load(file, parts):
    steps = example_steps(parts.env, parts.policy)
    return checkpoint.load(file, parts.agent, parts.device, with_training=True, steps=steps)


def refusal(file, parts) -> str:
    weights = {name: value.clone() for name, value in parts.agent.state_dict().items() if torch.is_tensor(value)}
    with pytest.raises(ConfigError) as error:
        load(file, parts)
    assert "\n" not in str(error.value) and str(file) in str(error.value)
    now = parts.agent.state_dict()
    assert all(torch.equal(value, now[name]) for name, value in weights.items()), "the agent was changed"
    return str(error.value)


class Malicious:
    """Leaves a file when it is unpickled."""

    def __init__(self, path) -> None:
        self.path = str(path)

    def __reduce__(self):
        return os.mkdir, (self.path,)


@pytest.mark.parametrize("kind", ["pickle", "torch"])
@pytest.mark.parametrize("member", ["agent", "rng", "collection", "recorder", "learner0_buffer", "learner0_actor"])
def test_nothing_in_a_checkpoint_is_ever_executed(member, kind, trained, parts, tmp_path):
    stream = io.BytesIO()
    (pickle.dump if kind == "pickle" else torch.save)(Malicious(tmp_path / "executed"), stream)
    data = stream.getvalue()

    def change(name, old):
        if name == f"{member}.pt":
            return data
        if name == "manifest.json":
            manifest = json.loads(old)
            assert member in manifest["members"]
            manifest["members"][member] = checkpoint.hashlib.sha256(data).hexdigest()
            return json.dumps(manifest)
        return old

    file = rewritten(trained / "checkpoint.zip", tmp_path / "evil.zip", change)
    assert "damaged, or not a checkpoint" in refusal(file, parts)
    assert not (tmp_path / "executed").exists()


def test_a_policy_file_is_never_executed_either(trained, parts, tmp_path):
    torch.save({"format": 2, "progress": "{}", "agent": Malicious(tmp_path / "executed")}, tmp_path / "policy.pt")
    refusal(tmp_path / "policy.pt", parts)
    assert not (tmp_path / "executed").exists()


def test_a_policy_file_of_another_format_is_refused(trained, parts, tmp_path):
    saved = torch.load(trained / "policy.pt", weights_only=True)
    torch.save({**saved, "format": 1}, tmp_path / "policy.pt")
    assert "format 1, but this version reads 2" in refusal(tmp_path / "policy.pt", parts)


def damaged(data: bytes, number: int) -> bytes:
    """Return a checkpoint's bytes with the damage of a number: a flipped bit, a cut, or a run of zeros."""
    chance = random.Random(number)
    place = chance.randrange(len(data))
    kind = number % 3
    if kind == 0:
        return data[:place] + bytes([data[place] ^ (1 << chance.randrange(8))]) + data[place + 1 :]
    if kind == 1:
        return data[:place]
    length = min(chance.randrange(1, 2000), len(data) - place)
    return data[:place] + bytes(length) + data[place + length :]


def load_damaged(numbers, trained, parts, tmp_path) -> int:
    data = (trained / "checkpoint.zip").read_bytes()
    refused = 0
    for number in numbers:
        file = tmp_path / f"{number}.zip"
        file.write_bytes(damaged(data, number))
        try:
            checkpoint.find(file, "resume")
            load(file, parts)
        except ConfigError as error:
            assert "\n" not in str(error), number
            refused += 1
        file.unlink()
    return refused


def test_a_damaged_checkpoint_is_refused_in_one_line(trained, parts, tmp_path):
    # A few bits, such as those of a time stamp, mean nothing.
    assert load_damaged(range(60), trained, parts, tmp_path) >= 50


@pytest.mark.slow
def test_five_hundred_damaged_checkpoints_end_in_one_line_each(trained, parts, tmp_path):
    assert load_damaged(range(1000, 1500), trained, parts, tmp_path) >= 440


def test_missing_members_foreign_files_and_other_agents_are_refused(trained, parts, tmp_path):
    file = trained / "checkpoint.zip"
    for gone in ("agent.pt", "rng.pt", "learner0_actor.pt", "collection.pt"):
        copy = rewritten(
            file, tmp_path / f"no-{gone}.zip", lambda name, data, gone=gone: None if name == gone else data
        )
        refusal(copy, parts)
    copy = rewritten(file, tmp_path / "no-manifest.zip", lambda name, data: None if name == "manifest.json" else data)
    refusal(copy, parts)
    for manifest in ("[]", "{}", "not json", json.dumps({"format": 1, "members": {}, "progress": {}})):
        copy = rewritten(
            file, tmp_path / "other.zip", lambda name, data, text=manifest: text if name == "manifest.json" else data
        )
        refusal(copy, parts)
    with zipfile.ZipFile(tmp_path / "foreign.zip", "w") as archive:
        archive.writestr("word/document.xml", "<a/>")
    refusal(tmp_path / "foreign.zip", parts)
    hppo = assemble(make_config([*SMALL, "low=hppo", *SHORT["hppo"]]))
    assert "does not fit this agent" in refusal(file, hppo)


def test_weights_that_are_nan_are_refused(trained, parts, tmp_path):
    with torch.no_grad():
        next(parts.agent.parameters()).fill_(torch.nan)
    states = {"collection": {}, "recorder": {}}
    checkpoint.save(tmp_path / "nan.zip", parts.agent, states, PROGRESS)
    other = assemble(make_config(PDQN))
    assert "holds NaN" in refusal(tmp_path / "nan.zip", other)


def test_the_error_about_an_optimizer_names_both_numbers_of_its_groups():
    weights = [torch.nn.Parameter(torch.zeros(2)) for _ in range(2)]
    own = state_after_a_step(torch.optim.Adam([{"params": [weight]} for weight in weights]))
    saved = state_after_a_step(torch.optim.Adam(weights))
    with pytest.raises(ValueError, match="low_optimizer has 1 param_groups, but must have 2"):
        check_optimizer("low_optimizer", saved, own)


def test_a_replay_takes_the_place_of_what_is_in_it(trained):
    # 256 steps of a buffer for hundreds of thousands.
    assert (trained / "checkpoint.zip").stat().st_size < 2_000_000
    assert (trained / "policy.pt").stat().st_size < 1_000_000


def test_a_checkpoint_without_the_replay_is_smaller_and_can_be_resumed(tmp_path, capsys):
    given = [*PDQN, "checkpoint_replay=false"]
    assert run(compose_config(given), tmp_path / "a", given) == 0
    words = [f"resume={tmp_path / 'a'}", "total_frames=320"]
    assert run(compose_config(words), tmp_path / "b", words) == 0
    assert "holds no replay (checkpoint_replay=false)" in capsys.readouterr().err


def test_a_policy_file_is_scored_like_the_run_that_it_is_of(trained, tmp_path):
    words = ["mode=eval", f"checkpoint={trained / 'policy.pt'}"]
    assert run(compose_config(words), tmp_path / "scored", words) == 0
    scores = [json.loads((folder / "summary.json").read_text())["score"] for folder in (trained, tmp_path / "scored")]
    assert scores[0] == scores[1]


@pytest.fixture(scope="module")
def scaled(tmp_path_factory):
    """A policy that reads observations scaled by running statistics."""
    agent = hpamdp.train(
        "CartPole-v1",
        high="none",
        low="hppo",
        total_frames=64,
        num_envs=2,
        steps_per_batch=32,
        observation_scaling="running",
        **{"low.minibatch_size": 32, "low.hidden_dims": [8], "eval.layouts": 1},
    )
    file = tmp_path_factory.mktemp("scaled") / "policy.pt"
    agent.save(file)
    return file


@pytest.mark.parametrize("collection", [None, {}, {"env": {}}])
def test_a_policy_file_without_the_statistics_that_scale_its_observations_is_refused(scaled, tmp_path, collection):
    saved = torch.load(scaled, weights_only=True)
    assert hpamdp.load(scaled, trust=True)._env.statistics()["observation_count"] > 0
    del saved["collection"]
    torch.save(saved if collection is None else {**saved, "collection": collection}, tmp_path / "policy.pt")
    with pytest.raises(ConfigError, match="it lacks the running statistics observation_count, observ") as error:
        hpamdp.load(tmp_path / "policy.pt", trust=True)
    assert "\n" not in str(error.value)


def test_an_agent_that_diverged_is_kept_with_the_statistics_that_scale_its_observations(tmp_path):
    words = ["env=gymnasium", "env.id=CartPole-v1", "env.observation_scaling=running", "high=none", "low=hppo"]
    config = make_config([*words, *SMALL[:-1]])
    parts = assemble(config)
    parts.env.rollout(3)
    before = parts.env.base_env.statistics()
    Trainer(config, parts, tmp_path).keep_for_inspection()
    saved = checkpoint.load(tmp_path / DIVERGED_NAME, parts.agent, parts.device, with_training=False)
    other = assemble(config).env.base_env
    saved.set_statistics(other)
    assert all(torch.equal(column, before[name]) for name, column in other.statistics().items())


def test_a_policy_file_of_an_earlier_version_without_statistics_is_read(trained, tmp_path):
    saved = torch.load(trained / "policy.pt", weights_only=True)
    del saved["collection"]
    torch.save(saved, tmp_path / "policy.pt")
    assert hpamdp.load(tmp_path / "policy.pt")._env.statistics() == {}


def test_a_kill_while_writing_leaves_the_old_checkpoint_and_its_leftover_is_removed_later(trained, parts, tmp_path):
    file = tmp_path / "checkpoint.zip"
    states = {"collection": {}, "recorder": {}}
    checkpoint.save(file, parts.agent, states, {**PROGRESS, "frames": 1})
    leftover = tmp_path / ".checkpoint.zip.999.partial.zip"
    leftover.write_bytes(b"half a checkpo")
    os.utime(leftover, (0.0, 0.0))
    assert checkpoint.progress_of(file)["frames"] == 1
    checkpoint.save(file, parts.agent, states, {**PROGRESS, "frames": 2})
    assert checkpoint.progress_of(file)["frames"] == 2
    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == ["checkpoint.zip"]


def test_a_full_disk_leaves_the_old_checkpoint(parts, tmp_path, monkeypatch):
    file = tmp_path / "checkpoint.zip"
    states = {"collection": {}, "recorder": {}}
    checkpoint.save(file, parts.agent, states, {**PROGRESS, "frames": 1})
    before = file.read_bytes()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(zipfile.ZipFile, "writestr", full)
    with pytest.raises(OSError, match="No space left"):
        checkpoint.save(file, parts.agent, states, {**PROGRESS, "frames": 2})
    assert file.read_bytes() == before
    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == ["checkpoint.zip"]


def test_a_checkpoint_that_may_not_be_opened_or_is_no_file_is_named_with_the_reason(tmp_path, monkeypatch):
    (tmp_path / "run/checkpoint.zip").mkdir(parents=True)
    with pytest.raises(ConfigError) as error:
        checkpoint.find(tmp_path / "run", "resume")
    found = f"resume={tmp_path / 'run/checkpoint.zip'}"
    assert str(error.value) == f"{found}: is a folder, but must be a regular file"
    (tmp_path / "own.pt").write_bytes(b"")

    def closed(self, *_):
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "open", closed)
    with pytest.raises(ConfigError, match=r"^load=.*own\.pt: Permission denied$"):
        checkpoint.find(tmp_path / "own.pt", "load")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read")
def test_a_folder_that_may_not_be_searched_is_named_with_the_reason(tmp_path):
    (tmp_path / "run").mkdir(mode=0o000)
    for where in ("resume", "load"):
        with pytest.raises(ConfigError, match=rf"^{where}=.*/run/checkpoint\.zip: Permission denied$"):
            checkpoint.find(tmp_path / "run", where)
