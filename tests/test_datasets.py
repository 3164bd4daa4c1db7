"""The data sets of the offline benchmark, and what a run makes of data sets of Minari."""

import argparse
import json

import pytest
import torch
from conftest import compose_config, make_config

from hpamdp import keys
from hpamdp.commands import datasets
from hpamdp.commands.judge import judged
from hpamdp.config.errors import ConfigError
from hpamdp.data import DataError, minari
from hpamdp.env.catch_point.environment import CatchPointEnv
from hpamdp.run.assemble import assemble
from hpamdp.run.train import run

library = pytest.importorskip("minari")
h5py = pytest.importorskip("h5py")
WORDS = ["mode=offline", "env=platform", "high=none", "low=iql", "offline.updates=20", "offline.eval_every=0"]
WORDS += ["eval.layouts=4", "low.batch_size=16", "film=false", "data=minari"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Return Minari's folder, for data sets of ten episodes."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    for settings in datasets.DOMAINS.values():
        monkeypatch.setitem(settings, "episodes", 10)
        monkeypatch.setitem(settings, "frames", 2048)
    return tmp_path


@pytest.mark.parametrize("name", ["platform/mixed", "goal/replay", "boatdock/medium"])
def test_a_data_set_of_the_benchmark_is_the_same_again_and_comes_back_from_minari(name, folder):
    domain, part = name.split("/")
    rows = datasets.transitions(domain, part)
    assert minari.checksum(rows) == minari.checksum(datasets.transitions(domain, part))
    datasets.make(domain, part)
    dataset = library.load_dataset(f"hpamdp/{name}-v0")
    assert dataset.total_episodes == 10 and dataset.storage.metadata["ref_max_score"] > 0.9
    assert dataset[0].observations.shape[1:] == dataset.observation_space.shape
    env = dataset.recover_environment()
    assert env.action_space == dataset.action_space
    loaded = minari.load(f"hpamdp/{name}-v0").exclude("collector")
    assert set(loaded.keys(True, True)) == set(rows.keys(True, True))
    for key, value in rows.items(True, True):
        assert loaded[key].dtype == value.dtype and loaded[key].equal(value), key


def test_the_command_lists_the_data_sets_and_makes_a_named_one_once(folder, capsys, monkeypatch):
    assert datasets.main([], argparse.ArgumentParser()) == 0
    assert capsys.readouterr().out.splitlines() == datasets.names()
    name = "hpamdp/platform/expert-v0"
    assert datasets.main([name], argparse.ArgumentParser()) == 0
    monkeypatch.setattr(datasets, "make", None)
    assert datasets.main([name], argparse.ArgumentParser()) == 0
    assert f"{name}: 10 episodes, 90 steps, mean return" in capsys.readouterr().out
    with pytest.raises(ConfigError, match=r"^hpamdp/x-v0: no data set of the package; hpamdp datasets lists them$"):
        datasets.main(["hpamdp/x-v0"], argparse.ArgumentParser())


def test_a_run_learns_from_a_data_set_of_minari(folder, tmp_path):
    datasets.make("platform", "mixed")
    words = [*WORDS, "data.dataset=hpamdp/platform/mixed-v0"]
    assert run(compose_config(words), tmp_path / "run", words) == 0
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["frames"] == 20


def test_held_out_episodes_judge_what_has_not_learned_from_them(folder, tmp_path):
    datasets.make("platform", "mixed")
    words = [*WORDS, "data.dataset=hpamdp/platform/mixed-v0", "data.held_out=0.4"]
    data = assemble(make_config(words)).data
    kept, held_out = (batch["collector", "traj_ids"].unique().tolist() for batch in (data.batch, data.held_out))
    assert held_out == [2, 4, 7, 9] and kept == [0, 1, 3, 5, 6, 8]
    assert run(compose_config(words), tmp_path / "run", words) == 0
    given = ["data=minari", words[-2], "offline.updates=5", "low.batch_size=16"]
    for more, is_doubted in ([], False), (["data.held_out=0.4"], False), (["data.held_out=0.5"], True):
        row = judged([str(tmp_path / "run")], given + more, episodes=4)[0]
        assert any("may have learned" in doubt for doubt in row["doubts"]) == is_doubted
    almost_all = assemble(make_config([*words[:-1], "data.held_out=0.99999999"])).data
    assert almost_all.batch["collector", "traj_ids"].unique().tolist() == [0]
    with pytest.raises(ConfigError, match=r"data.held_out=0.05: is less than one of 10 episodes"):
        assemble(make_config([*words[:-1], "data.held_out=0.05"]))


def with_nan(group):
    group["rewards"][0] = float("nan")


def without_a_part(group):
    actions = group["actions"]
    actions.move("_index_0", "discrete")


@pytest.mark.parametrize(
    ("word", "spoil", "said"),
    [
        ("env=goal", None, "was recorded in hpamdp/Platform-v0, which is another problem"),
        ("data.dataset=hpamdp/none-v0", None, "hpamdp/none-v0: is not in .*`hpamdp datasets` makes those"),
        ("data.dataset=../x", None, "data=minari: ../x: "),
        ("data.dataset=", None, "data.dataset: names no data set"),
        ("seed=1", with_nan, "the transitions, row 0: next.reward is nan, but must be finite"),
        ("seed=1", without_a_part, "cannot be read as transitions"),
    ],
)
def test_another_problem_and_a_wrong_or_missing_data_set_are_refused_in_one_line(word, spoil, said, folder, tmp_path):
    datasets.make("platform", "expert")
    if spoil is not None:
        with h5py.File(folder / "hpamdp/platform/expert-v0/data/main_data.hdf5", "a") as file:
            spoil(file["episode_0"])
    words = [*WORDS, "data.dataset=hpamdp/platform/expert-v0", word]
    with pytest.raises(ConfigError, match=said) as refused:
        run(compose_config(words), tmp_path / "run", words)
    assert "\n" not in str(refused.value)


def test_a_data_set_of_another_problem_of_the_same_sizes_is_refused(folder, tmp_path):
    datasets.make("platform", "expert")
    metadata = folder / "hpamdp/platform/expert-v0/data/metadata.json"
    metadata.write_text(metadata.read_text().replace("hpamdp/Platform-v0", "hpamdp/Moving-v0"))
    words = [*WORDS, "data.dataset=hpamdp/platform/expert-v0"]
    with pytest.raises(ConfigError, match="expert-v0: was recorded in hpamdp/Moving-v0, which is another problem"):
        run(compose_config(words), tmp_path / "run", words)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda rows: rows[:-1], "their last episode has no end"),
        (lambda rows: rows[:0], r"have shape \[0\]"),
        (lambda rows: rows.exclude("action"), "they have no .*discrete"),
        (
            lambda rows: rows.clone().apply_(lambda leaf: leaf.fill_(torch.nan) if leaf.is_floating_point() else leaf),
            "is not finite",
        ),
    ],
)
def test_what_would_not_come_back_is_not_exported(change, said, folder):
    rows = change(datasets.transitions("platform", "expert"))
    with pytest.raises(DataError, match=said):
        minari.export(rows, "tt/rows-v0", minari.MinariLayout(), env_id="hpamdp/Platform-v0")
    assert not minari.is_there("tt/rows-v0")


def test_an_environment_that_does_not_fit_leaves_nothing_behind(folder):
    rows = datasets.transitions("platform", "expert")
    with pytest.raises(DataError, match="tt/cart-v0: Minari refuses the data"):
        minari.export(rows, "tt/cart-v0", minari.MinariLayout(), env_id="CartPole-v1")
    assert not minari.is_there("tt/cart-v0")


def test_an_unusable_folder_is_said_in_one_line(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "file"))
    with pytest.raises(ConfigError, match=r"^MINARI_DATASETS_PATH: Minari's folder cannot be used"):
        datasets.main(["hpamdp/platform/random-v0"], argparse.ArgumentParser())


def test_pictures_are_stored_exactly(folder):
    env = CatchPointEnv(2, observation="picture")
    played = env.rollout(3, break_when_any_done=False)
    rows = torch.cat([played[0], played[1]])
    ends = torch.tensor([False, False, True] * 2).unsqueeze(1)
    rows[keys.IS_DECISION], rows["next", keys.IS_DECISION] = ends.roll(1, 0), ends
    rows["next", keys.DONE] = rows["next", keys.TRUNCATED] = ends
    minari.export(
        rows,
        "hpamdp/pictures-v0",
        minari.MinariLayout(),
        env_id="hpamdp/CatchPoint-v0",
        env_kwargs={"observation": "picture"},
    )
    stored = torch.from_numpy(library.load_dataset("hpamdp/pictures-v0")[1].observations)
    assert stored.dtype == torch.uint8 and stored[:-1].equal(rows[keys.OBSERVATION][3:])
