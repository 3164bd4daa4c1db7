"""PinballEnv: its settings, its maps and their files, its hand-written player and its options."""

from __future__ import annotations

import json
import os

import gymnasium
import numpy as np
import pytest
import torch
from batched_players import action, play
from conftest import compose_config, make_config

import hpamdp
from hpamdp import keys
from hpamdp.config.errors import ConfigError
from hpamdp.config.saved import needs_trust, read_saved
from hpamdp.env.pinball import maps
from hpamdp.env.pinball.environment import PinballEnv
from hpamdp.env.pinball.options import SOURCE_MAPS
from hpamdp.run.assemble import assemble
from hpamdp.run.train import run
from hpamdp.settings import SettingError
from hpamdp.specs import PAMDPSpecs

# A table with one wall between the start and the hole.
TABLE = {
    "ball": 0.03,
    "start": [0.2, 0.5],
    "target": [0.8, 0.5, 0.05],
    "polygons": [[[0.5, 0.2], [0.55, 0.2], [0.55, 0.8], [0.5, 0.8]]],
}
SMALL = ["num_envs=8", "steps_per_batch=4", "total_frames=320", "eval.layouts=4", "eval.every=0"]
each_map = pytest.mark.parametrize("name", SOURCE_MAPS)


def scripted(env: PinballEnv):
    discrete, strength = env.scripted_action(env.state)
    return action(discrete, strength.unsqueeze(-1).expand(-1, 4))


def written(folder, table: object) -> str:
    file = folder / "table.json"
    file.write_text(table if isinstance(table, str) else json.dumps(table))
    return str(file)


def test_learners_see_four_pushes_of_one_sign_each_and_none_without_a_parameter():
    env = PinballEnv(2)
    assert PAMDPSpecs.from_env(env) == PAMDPSpecs(4, (), (1, 1, 1, 1, 0), (0.0, 0.0, -1.0, -1.0), (1.0, 1.0, 0.0, 0.0))
    assert env.discrete_names == ("right", "up", "left", "down", "none")


@each_map
def test_every_episode_begins_at_rest_at_the_start_of_the_map(name):
    env = PinballEnv(3, map=name)
    for _ in range(2):
        seen = env.reset()[keys.OBSERVATION]
        expected = [2.0 * each - 1.0 for each in maps.read(name).start] + [0.0, 0.0]
        torch.testing.assert_close(seen, torch.tensor(expected).expand(3, -1))


@each_map
def test_episodes_that_begin_anywhere_begin_at_rest_between_the_walls_and_outside_the_hole(name):
    env = PinballEnv(2000, map=name, start="anywhere", seed=1)
    env.reset()
    state, table = env.state, env.map
    places = torch.stack([state.x, state.y], -1).double().numpy()
    assert (table.clearance(places) > table.ball - 1e-6).all()
    assert (np.hypot(*(places - table.target[:2]).T) >= table.target[2] - 1e-6).all()
    assert not state.vx.any() and not state.vy.any()
    assert len(np.unique(places, axis=0)) > 1000 and places.min() < 0.05 and places.max() > 0.95


def test_training_may_begin_anywhere_while_evaluation_begins_at_the_start_of_the_map():
    env = PinballEnv(100, training_start="anywhere")
    everywhere = PinballEnv(100, start="anywhere")
    for env_seen in (env, everywhere):
        env_seen.reset()
    assert torch.equal(env.state.x, everywhere.state.x) and torch.equal(env.state.y, everywhere.state.y)
    env.seed_evaluation(3)
    expected = torch.tensor([2.0 * each - 1.0 for each in env.map.start])
    torch.testing.assert_close(env.reset()[keys.OBSERVATION][:, :2], expected.expand(100, -1))
    assert env.references({}) != {}


def test_half_of_the_training_may_begin_at_the_start_of_the_map_and_half_anywhere():
    env = PinballEnv(2000, training_start="both")
    env.reset()
    begins = torch.tensor(env.map.start, dtype=env.state.x.dtype)
    at_start = (env.state.x == begins[0]) & (env.state.y == begins[1])
    assert 0.45 < at_start.float().mean() < 0.55
    assert env.state.x[~at_start].unique().numel() > 50
    env.seed_evaluation(3)
    env.reset()
    assert ((env.state.x == begins[0]) & (env.state.y == begins[1])).all()


@each_map
def test_the_hand_written_player_reaches_the_hole_with_the_return_of_the_references(name):
    env = PinballEnv(1, map=name)
    last, total = play(env, scripted)
    reference = env.references({})["scripted"]
    assert env.results(last)["success"].all() and reference["success"] == 1.0
    assert total.item() == pytest.approx(reference["score"], abs=20.0)


@each_map
def test_the_hand_written_player_reaches_the_hole_from_nearly_anywhere(name):
    env = PinballEnv(500, map=name, start="anywhere", seed=2)
    last, _ = play(env, scripted)
    assert env.results(last)["success"].float().mean() > 0.97
    assert env.references({}) == {}


@pytest.mark.parametrize(("name", "share", "error"), [("simple", 0.042, 0.015), ("hard", 0.0, 0.005)])
def test_random_pushes_reach_the_hole_once_in_24_episodes_of_the_simple_map_and_hardly_ever_in_the_hard_one(
    name, share, error
):
    env = PinballEnv(1000, map=name, seed=5)
    generator = torch.Generator().manual_seed(5)
    strength = torch.tensor([1.0, 1.0, -1.0, -1.0])
    env.reset()
    for _ in range(env.max_steps):
        discrete = torch.randint(5, (1000,), generator=generator)
        last = env.step(action(discrete, strength * torch.rand(1000, 4, generator=generator)))["next"]
    assert env.results(last)["success"].float().mean().item() == pytest.approx(share, abs=error)
    assert last[keys.DONE].all()


def test_a_map_of_ones_own_is_played_by_the_rules_and_the_player(tmp_path):
    env = PinballEnv(1, map=written(tmp_path, TABLE))
    last, total = play(env, scripted)
    assert env.results(last)["success"].all() and total > 9_000.0
    assert env.references({}) == {}
    assert env.draw([env.state]).shape == (480, 480, 3)
    made = gymnasium.make("hpamdp/PinballHard-v0", map=written(tmp_path, TABLE)).unwrapped
    assert made.reset()[0].tolist() == pytest.approx([-0.6, 0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"target": [0.5, 0.5]}, "target[2]: Field required"),
        ({"target": [0.99, 0.5, 0.05]}, "target: the circle around (0.99, 0.5) with radius 0.05 must lie inside"),
        ({"start": [0.51, 0.5]}, "start: lies inside a wall, but the ball has radius 0.03"),
        ({"polygons": [[[0.1, 0.1], [0.2, 0.1], [0.2, 0.1]]]}, "polygons[0][1]: is less than 1e-06 from the next"),
        ({"polygons": [[[0.1, 0.1], [0.2, 0.1], [0.2, 0.2]]] * 700}, "polygons: have 2100 corners, but may have at"),
    ],
)
def test_a_file_that_is_no_map_is_refused_in_one_line_that_says_where(change, message, tmp_path):
    file = written(tmp_path, TABLE | change)
    with pytest.raises(SettingError) as caught:
        PinballEnv(1, map=file)
    assert str(caught.value).startswith(f"map={file!r}: {message}") and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[" * 100_000, "no JSON: maximum recursion depth"),
        ('{"ball": 0.01, "ball": 0.2}', "ball is given twice"),
        ("7" * 2**21, "has 2097152 bytes, but may have at most 1048576"),
    ],
)
def test_a_file_of_another_form_is_refused_in_one_line(content, message, tmp_path):
    with pytest.raises(SettingError, match=r"^map='.*/table.json': ") as caught:
        PinballEnv(1, map=written(tmp_path, content))
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_what_is_no_regular_file_is_refused_and_never_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path, message in (
        (tmp_path / "pipe", "a pipe or a device, but must be a regular file"),
        (tmp_path, "is a folder, "),
        (tmp_path / "gone.json", "there is no such file; use simple, hard or the path of a JSON file"),
        ("/dev/zero", "or a device"),
    ):
        with pytest.raises(SettingError, match=message):
            PinballEnv(1, map=str(path))


def test_a_player_says_where_no_way_leads(tmp_path):
    wall = [[[0.5, 0.0], [0.55, 0.0], [0.55, 1.0], [0.5, 1.0]]]
    with pytest.raises(SettingError, match="start: no way leads from there to the target"):
        PinballEnv(1, map=written(tmp_path, TABLE | {"polygons": wall}), oracle=True)


def test_a_run_does_not_continue_on_a_map_that_was_edited_since(tmp_path):
    file, folder = written(tmp_path, TABLE), tmp_path / "run"
    words = ["env=pinball", "high=none", "low=random", f"env.map={file}", *SMALL, "total_frames=64", "env.max_steps=20"]
    assert run(compose_config(words), folder, words) == 0
    resume = [f"resume={folder}", "trust=true", "total_frames=128"]
    written(tmp_path, TABLE | {"start": [0.2, 0.6]})
    with pytest.raises(ConfigError, match=r"env\.map='.*table\.json' is no longer the one of this state"):
        run(compose_config(resume), folder, resume)
    written(tmp_path, TABLE)
    assert run(compose_config(resume), folder, resume) == 0


def test_an_evaluation_on_a_map_that_was_edited_since_says_so(tmp_path, capfd):
    file, folder = written(tmp_path, TABLE), tmp_path / "run"
    words = ["env=pinball", "high=uniform", "env.grouping=default", "low=random", f"env.map={file}", *SMALL]
    words += ["total_frames=64", "env.max_steps=20", "film=false"]
    assert run(compose_config(words), folder, words) == 0
    line = "the agent was trained with another file of env.map, or it was edited since"
    for table, is_other in ((TABLE, False), (TABLE | {"start": [0.2, 0.6]}, True)):
        written(tmp_path, table)
        for saved in ("policy.safetensors", "checkpoint.safetensors"):
            capfd.readouterr()
            evaluate = ["mode=eval", f"checkpoint={folder / saved}", "trust=true", "eval.layouts=2", "film=false"]
            assert run(compose_config(evaluate), tmp_path / f"{saved}_{is_other}", evaluate) == 0
            assert (f"{saved}: {line}" in capfd.readouterr().err) == is_other
        hpamdp.load(folder, trust=True)
        assert (line in capfd.readouterr().err) == is_other


def test_a_saved_config_names_a_file_with_consent_alone_but_a_map_of_the_source_without():
    for value, is_asked in (("simple", False), ("hard", False), ("/etc/passwd", True)):
        config = make_config(["env=pinball", "high=none", "low=random", f"env.map={value}"])
        assert needs_trust(config) == is_asked
        saved = config.to_dict()
        if is_asked:
            with pytest.raises(ConfigError, match=r'^env\.map="/etc/passwd": set by .*trust=true'):
                read_saved(saved)
        assert read_saved(saved, trust=True).env.settings["map"] == value
        assert is_asked or read_saved(saved).env.settings["map"] == value


def test_the_options_to_begin_with_are_the_axes_and_none():
    words = ["env=pinball", "+env.grouping=default", "high=uniform", "low=random", *SMALL]
    env = assemble(make_config(words)).env
    specs = PAMDPSpecs.from_env(env)
    assert specs.option_names == ("horizontal", "vertical", "none")
    assert specs.option_actions == (
        (True, False, True, False, False),
        (False, True, False, True, False),
        (False, False, False, False, True),
    )
