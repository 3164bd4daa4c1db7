"""Episodes of `hpamdp play` as data: the tables, the command line of the recording, learning, and references."""

import json
import os
import re

import numpy as np
import pytest
import torch
from conftest import compose_config
from play_players import docked, events_of, played

from hpamdp import keys
from hpamdp.commands.page_server import EpisodeFile
from hpamdp.data import DataError
from hpamdp.data.human import played_file
from hpamdp.data.human.cli import main
from hpamdp.data.human.demonstrations import PlayedDemonstrations
from hpamdp.data.human.episodes import score
from hpamdp.data.human.statistics import figures
from hpamdp.env.boatdock import physics
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.boatdock.play import episodes
from hpamdp.env.boatdock.play.boat_page import BoatPage
from hpamdp.run.train import run

START, GOAL = (0.0, 60.0), (0.0, -60.0)
SECOND = {"t": 1.35, "type": "down", "key": 0, "code": "KeyJ"}
EPISODES = [
    *docked(30),
    *docked(4, player="f" * 16),
    played(START, GOAL, "congruent", events_of([(1, 2.0)]), index=90),
    # The second press stops the glide of the first.
    played(START, GOAL, "congruent", [*events_of([(1, 0.9)]), SECOND], index=91),
    *docked(1, mode="practice", player="e" * 16),
]  # fmt: skip


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("played") / "played.jsonl"
    path.write_text("".join(f"{json.dumps(episode)}\n" for episode in EPISODES))
    return path


def test_the_tables_hold_the_episodes_and_their_presses(file):
    data = played_file.read(file)
    rounds = [episode for episode in EPISODES if episode["mode"] == "round"]
    assert len(data.episodes) == len(rounds)
    assert data.episodes["person"].tolist() == [0] * 30 + [1] * 4 + [0, 0]
    assert data.episodes["index"].tolist() == [*range(30), *range(4), 30, 31]
    assert data.episodes["complete"].all() and (data.episodes["centre"] == torch.tensor([640.0, 512.0])).all()
    np.testing.assert_allclose(score(data), [episode["score"] for episode in rounds], atol=0.5 * 5.0 / 360 + 1e-6)
    names = [physics.OUTCOMES[code] for code in data.episodes["outcome"]]
    assert names == [episode["outcome"] for episode in rounds]
    made = [press["duration"] for episode in rounds for press in episode["presses"]]
    np.testing.assert_allclose(data.presses["duration"], made, rtol=1e-6)
    assert data.presses["is_final"].sum() == len(rounds)
    assert len(played_file.read(file, practice=True).episodes) == len(rounds) + 1


def test_an_interrupted_press_leads_to_where_the_next_one_began(file):
    data = played_file.read(file)
    first = data.presses[data.presses["episode"] == len(data.episodes) - 1][0]
    way = physics.distance_at(torch.tensor(0.9).double(), torch.tensor(1.05).double()).item()
    moved = first["next_position"] - first["position"]
    np.testing.assert_allclose(moved, [0.0, -way], atol=1e-4)
    assert way < physics.total_distance(torch.tensor(0.9)).item() - 5.0


def test_presses_from_rest_are_in_the_environment_what_they_were_in_the_game(file):
    env = BoatDockEnv(1, controller="choose")
    made = PlayedDemonstrations(env, path=str(file), practice=False, successes=True, best_people=1, rest_to_rest=True)
    rows = made.batch.squeeze(0)
    ends = rows["next", keys.DONE].squeeze(-1)
    assert rows["next", keys.TERMINATED].sum() / ends.sum() > 0.9
    assert made.decisions["next", keys.OPTION_RETURN].mean() > 3.5
    # Sailed by the environment, each first press of an episode leads to where the game put the boat.
    is_first = rows[keys.IS_DECISION].squeeze(-1) & ~ends
    start, goal = (
        rows[keys.OBSERVATION][is_first][:, i : i + 2] * 120.0 + torch.tensor([640.0, 512.0]) for i in (0, 2)
    )
    sailors = BoatDockEnv(int(is_first.sum()))
    td = sailors.reset(sailors.fake_tensordict().select().update({"start": start, "goal": goal}))
    td.update(rows[is_first].select(keys.OPTION, keys.ACTION))
    there = sailors.step(td)["next", keys.OBSERVATION][:, 8:10]
    np.testing.assert_allclose(there * 120.0, rows["next", keys.OBSERVATION][is_first][:, 8:10] * 120.0, atol=0.05)


def test_a_learner_trains_from_the_file_and_you_stand_in_the_table(file, tmp_path, capsys):
    words = ["low=bc", "high=linucb", "mode=offline", "offline.updates=3", "data=recorded", f"data.path={file}"]
    words += [f"env.recording={file}", "eval.layouts=8", "offline.eval_every=0"]
    assert run(compose_config(words), tmp_path, words) == 0
    references = json.loads((tmp_path / "summary.json").read_text())["references"]
    assert references["you"]["score"] == pytest.approx(figures(played_file.read(file))["score"], abs=0.01)
    assert {*references} == {"you", "ceiling", "random"} and "you" in capsys.readouterr().out


def test_figures_of_one_boat_are_of_its_episodes_alone(file):
    env = BoatDockEnv(1, controller="incongruent", recording=str(file))
    own = [e["score"] for e in EPISODES if e["mode"] == "round" and e["controller"] == "incongruent"]
    you = env.references({"ceiling": 3.5})["you"]
    assert you["score"] == pytest.approx(np.mean(own)) and you["success"] == 1.0 and you["option_congruent"] == 0.0


def test_the_commands_of_the_recording_work_on_the_file(file, tmp_path, capsys):
    assert main(["check", str(file)]) == 0
    assert f"all {len(EPISODES)} episodes, including practice" in capsys.readouterr().out
    assert main(["summary", str(file), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["all"]["episodes"] == len(EPISODES) - 1
    assert main(["export", str(file), "--format", "csv", "--to", str(tmp_path / "tables"), "--successes"]) == 0
    assert main(["export", str(file), "--format", "memmap", "--to", str(tmp_path / "rows")]) == 0
    assert any(tmp_path.rglob("*.csv"))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "there is no such file"),
        ("no json\n[]\n", "line 1: no JSON: .*; no line is an episode"),
        (
            json.dumps({**EPISODES[0], "outcome": "too_fast", "score": -1.0}) + "\n",
            "line 1: outcome: too_fast, but the presses lead to success",
        ),
        (json.dumps(EPISODES[-1]) + "\n", "except practice"),
    ],
)
def test_a_file_that_is_not_one_of_episodes_is_refused_in_a_line(tmp_path, text, said):
    path = tmp_path / "a.jsonl"
    if text is not None:
        path.write_text(text, encoding="utf-8")
    with pytest.raises(DataError, match=said) as refused:
        played_file.read(path)
    assert "\n" not in str(refused.value)


def test_lines_that_are_no_episodes_are_named_and_the_others_read(tmp_path, capsys):
    good = [json.dumps(episode) for episode in EPISODES[:3]]
    first = EPISODES[0]
    bad = {
        "no JSON": [b'{"format":1,"soft' + good[0].encode(), b"\0" * 99, bytes(range(128, 255)), b"{" * 9999, b"1 2"],
        "longer than 1048576 bytes": [b"[" + b"1," * 600_000 + b"1]"],
        "the same episode as line 1": [good[0].encode(), json.dumps({**first, "software": "9"}).encode()],
        "fuel: does not follow from the presses": [json.dumps({**first, "fuel": 0.123}).encode()],
        "presses.0.duration: Input should be greater than 0": [changed(first, duration=-1.0)],
        "presses.0.duration: Input should be a valid number": [changed(first, duration="0.5")],
        "presses.0.key: Field required": [changed(first, key=None)],
        "extra: Extra inputs are not permitted": [json.dumps({**first, "extra": 1}).encode()],
        "episode: Input should be an object": [b"[]", b"17", b"null", b'"text"'],
    }
    for constant in ("NaN", "Infinity", "-Infinity"):
        bad["no JSON"].append(good[0].replace('"end": [', f'"end": [{constant}, ').encode())
    bad["episode: is not a JSON object"] = [re.sub('"end": .[^,]*', '"end": [1e999', good[0]).encode()]
    for problem, lines in bad.items():
        for line in lines:
            path = tmp_path / "a.jsonl"
            path.write_bytes(b"\xef\xbb\xbf" + f"{good[0]}\r\n".encode() + line + f"\n\n{good[1]}\n{good[2]}".encode())
            assert len(played_file.read(path).episodes) == 3
            episodes.warn_once.cache_clear()
            said = capsys.readouterr().err
            assert said.startswith(f"{path}: 1 of 4 lines left out: line 2 ({problem}") and said.count("\n") == 1, line
            assert main(["check", str(path)]) == 2
            assert f"line 2: {problem}" in capsys.readouterr().err


def changed(episode, **fields):
    press = {name: value for name, value in {**episode["presses"][0], **fields}.items() if value is not None}
    return json.dumps({**episode, "presses": [press, *episode["presses"][1:]]}).encode()


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda path: path.mkdir(), "is a folder, a pipe or a device, but must be a regular file"),
        (lambda path: path.symlink_to("/dev/zero"), "is a folder, a pipe or a device, but must be a regular file"),
        (lambda path: os.truncate(os.open(path, os.O_CREAT | os.O_WRONLY), 2**33), "may have at most"),
    ],
)
def test_a_path_that_is_no_file_of_episodes_is_refused_in_one_line_and_never_blocks(tmp_path, make, said):
    path = tmp_path / "a.jsonl"
    make(path)
    page = BoatPage(seed=0)
    for read, error in ((played_file.read, DataError), (lambda path: EpisodeFile(path, page), OSError)):
        with pytest.raises(error, match=said) as refused:
            read(path)
        assert "\n" not in str(refused.value)
    for ending in (".mat", ".jsonl"):  # and as people's recording
        assert main(["check", str(path.rename(path.with_suffix(ending)))]) == 2
        path = path.with_suffix(ending)


def test_a_last_line_that_was_cut_short_is_left_out(file, tmp_path):
    (tmp_path / "a.jsonl").write_text(file.read_text()[:-40])
    assert len(played_file.read(tmp_path / "a.jsonl", practice=True).episodes) == len(EPISODES) - 1


def test_a_forged_episode_is_found_by_the_check(tmp_path, capsys):
    events = EPISODES[0]["events"]
    forged = {**EPISODES[0], "events": [{**events[0], "t": events[0]["t"] + 0.001}, *events[1:]]}
    (tmp_path / "a.jsonl").write_text(json.dumps(forged) + "\n")
    assert main(["check", str(tmp_path / "a.jsonl")]) == 2
    assert "line 1: presses.0: does not follow from the events" in capsys.readouterr().err
