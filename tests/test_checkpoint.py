"""A checkpoint is whole or not there, and opening one runs no code and ends in one line whatever is wrong with it."""

import json
import os
import pickle
import random
import zipfile
from pathlib import Path

import pytest
import torch
from conftest import compose_config, make_config, parts_of
from safetensors.torch import save_file
from test_grid import SHORT

import hpamdp
from hpamdp.config.errors import ConfigError
from hpamdp.run import checkpoint, state_file
from hpamdp.run.assemble import assemble
from hpamdp.run.train import run
from hpamdp.run.trainer import Trainer
from hpamdp.run_files import DIVERGED_NAME

SMALL = ["num_envs=8", "steps_per_batch=4", "total_frames=256", "eval.layouts=4", "eval.every=0", "high=ucb"]
PROGRESS = {"config": {}, "option_names": [], "frames": 0, "wall_s": 0.0, "cpu_s": 0.0, "last_score": None}
STATES = {name: {} for name in checkpoint.STATES}
PDQN = [*SMALL, "low=pdqn", *SHORT["pdqn"]]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run") / "pdqn"
    assert run(compose_config(PDQN), folder, PDQN) == 0
    return folder


@pytest.fixture
def parts():
    return assemble(make_config(PDQN))


def changed(file, target, **parts):
    """Copy a saved agent with other parts; None leaves a part out."""
    parts = parts_of(file) | parts
    state_file.write(target, {name: part for name, part in parts.items() if part is not None})
    return target


def load(file, parts):
    return checkpoint.load(file, parts.agent, parts.device, with_training=True)


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


@pytest.mark.parametrize("save", [lambda value, file: pickle.dump(value, file.open("wb")), torch.save])
def test_nothing_in_a_file_is_ever_executed(save, tmp_path):
    for value in (Malicious(tmp_path / "executed"), {"format": 3, "agent": Malicious(tmp_path / "executed")}):
        save(value, tmp_path / "evil")
        with pytest.raises(ConfigError, match=r"not a checkpoint of this program|of version 0\.3"):
            hpamdp.load(tmp_path / "evil")
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize("name", checkpoint.OLD_NAMES)
def test_a_file_of_version_03_is_refused_with_the_name_of_the_script_that_converts_it(name, tmp_path):
    torch.save({"format": 2}, tmp_path / name)
    for path in (tmp_path, tmp_path / name) if name != "best.pt" else (tmp_path / name,):
        with pytest.raises(ConfigError) as error:
            hpamdp.load(path)
        line = "a zip archive; if it is a checkpoint of version 0.3, experiments/convert_checkpoints.py converts it"
        assert str(error.value) == f"load={tmp_path / name}: {line}"


def test_a_file_of_another_format_is_refused(trained, parts, tmp_path):
    file = changed(trained / "policy.safetensors", tmp_path / "policy.safetensors", format=4)
    assert "format 4, but this version reads 3" in refusal(file, parts)


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


@pytest.mark.parametrize("numbers", [range(60), pytest.param(range(1000, 1500), marks=pytest.mark.slow)], ids=len)
def test_a_damaged_checkpoint_is_refused_in_one_line(numbers, trained, parts, tmp_path):
    data = (trained / "checkpoint.safetensors").read_bytes()
    file = tmp_path / "damaged"
    for number in numbers:
        spoiled = damaged(data, number)
        if spoiled == data:  # zeros in the place of zeros
            continue
        file.write_bytes(spoiled)
        with pytest.raises(ConfigError) as error:
            load(checkpoint.find(file, "resume"), parts)
        assert "\n" not in str(error.value), number


def test_a_changed_number_of_a_network_is_called_damage(trained, parts, tmp_path):
    data = (trained / "checkpoint.safetensors").read_bytes()
    weights = parts_of(trained / "checkpoint.safetensors")["agent"]
    place = data.index(max(weights.values(), key=torch.numel).numpy().tobytes())
    (tmp_path / "damaged").write_bytes(data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :])
    assert "damaged, or not a checkpoint of this program (the checksum of" in refusal(tmp_path / "damaged", parts)


def test_missing_parts_foreign_files_and_other_agents_are_refused(trained, parts, tmp_path):
    file = trained / "checkpoint.safetensors"
    for gone in ("format", "progress", "agent", "rng", "learner0_actor", "collection"):
        refusal(changed(file, tmp_path / f"no-{gone}", **{gone: None}), parts)
    save_file({"weight": torch.zeros(3)}, tmp_path / "no-metadata")
    refusal(tmp_path / "no-metadata", parts)
    for number, text in enumerate(("not json", "[]", "{}", "[" * 100_000, '{"state": 1' + "0" * 5000 + "}")):
        save_file({}, tmp_path / f"foreign-{number}", {"hpamdp": text})
        refusal(tmp_path / f"foreign-{number}", parts)
    with zipfile.ZipFile(tmp_path / "foreign.zip", "w") as archive:
        archive.writestr("word/document.xml", "<a/>")
    refusal(tmp_path / "foreign.zip", parts)
    hppo = assemble(make_config([*SMALL, "low=hppo", *SHORT["hppo"]]))
    assert "does not fit this agent" in refusal(file, hppo)


def test_weights_that_are_nan_are_refused(trained, parts, tmp_path):
    with torch.no_grad():
        next(parts.agent.parameters()).fill_(torch.nan)
    checkpoint.save(tmp_path / "nan", parts.agent, STATES, PROGRESS)
    other = assemble(make_config(PDQN))
    assert "holds NaN" in refusal(tmp_path / "nan", other)


def test_a_checkpoint_without_the_replay_is_smaller_and_can_be_resumed(tmp_path, capsys):
    given = [*PDQN, "checkpoint_replay=false"]
    assert run(compose_config(given), tmp_path / "a", given) == 0
    words = [f"resume={tmp_path / 'a'}", "total_frames=320"]
    assert run(compose_config(words), tmp_path / "b", words) == 0
    assert "holds no replay (checkpoint_replay=false)" in capsys.readouterr().err


def test_a_policy_file_is_scored_like_the_run_that_it_is_of(trained, tmp_path):
    words = ["mode=eval", f"checkpoint={trained / 'policy.safetensors'}"]
    assert run(compose_config(words), tmp_path / "scored", words) == 0
    scores = [json.loads((folder / "summary.json").read_text())["score"] for folder in (trained, tmp_path / "scored")]
    assert scores[0] == scores[1]


@pytest.fixture(scope="module")
def scaled(tmp_path_factory):
    """A policy that reads observations scaled by running statistics."""
    settings = {"total_frames": 64, "num_envs": 2, "steps_per_batch": 32, "eval.layouts": 1}
    settings |= {"observation_scaling": "running", "low.minibatch_size": 32, "low.hidden_dims": [8]}
    agent = hpamdp.train("CartPole-v1", high="none", low="hppo", **settings)
    file = tmp_path_factory.mktemp("scaled") / "policy.safetensors"
    agent.save(file)
    return file


@pytest.mark.parametrize("collection", [None, {"env": {}}])
def test_a_policy_file_without_the_statistics_that_scale_its_observations_is_refused(scaled, tmp_path, collection):
    assert hpamdp.load(scaled, trust=True)._env.statistics()["observation_count"] > 0
    file = changed(scaled, tmp_path / "policy.safetensors", collection=collection)
    with pytest.raises(ConfigError, match="it lacks the running statistics observation_count, observ") as error:
        hpamdp.load(file, trust=True)
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


def test_a_kill_while_writing_leaves_the_old_checkpoint_and_its_leftover_is_removed_later(trained, parts, tmp_path):
    file = tmp_path / "checkpoint.safetensors"
    checkpoint.save(file, parts.agent, STATES, {**PROGRESS, "frames": 1})
    leftover = tmp_path / ".checkpoint.safetensors.999.partial.safetensors"
    leftover.write_bytes(b"half a checkpo")
    os.utime(leftover, (0.0, 0.0))
    assert checkpoint.progress_of(file)["frames"] == 1
    checkpoint.save(file, parts.agent, STATES, {**PROGRESS, "frames": 2})
    assert checkpoint.progress_of(file)["frames"] == 2
    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == ["checkpoint.safetensors"]


def test_a_full_disk_leaves_the_old_checkpoint(parts, tmp_path, monkeypatch):
    file = tmp_path / "checkpoint.safetensors"
    checkpoint.save(file, parts.agent, STATES, {**PROGRESS, "frames": 1})
    before = file.read_bytes()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space left"):
        checkpoint.save(file, parts.agent, STATES, {**PROGRESS, "frames": 2})
    assert file.read_bytes() == before
    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == ["checkpoint.safetensors"]


def test_a_checkpoint_that_may_not_be_opened_or_is_no_file_is_named_with_the_reason(tmp_path, monkeypatch):
    (tmp_path / "run/checkpoint.safetensors").mkdir(parents=True)
    with pytest.raises(ConfigError) as error:
        checkpoint.find(tmp_path / "run", "resume")
    found = f"resume={tmp_path / 'run/checkpoint.safetensors'}"
    assert str(error.value) == f"{found}: is a folder, a pipe or a device, but must be a regular file"
    (tmp_path / "own").write_bytes(b"")

    def closed(self, *_):
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "open", closed)
    with pytest.raises(ConfigError, match=r"^load=.*own: Permission denied$"):
        checkpoint.find(tmp_path / "own", "load")
