"""The game's rules: the presses that follow from key events, their effects, and the equality of the page's script."""

import json
import random
import shutil
import subprocess

import numpy as np
import pytest
import torch
from play_players import docked, events_of, played, random_events

from hpamdp.env.boatdock import harbour, physics
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.boatdock.play import episodes
from hpamdp.env.boatdock.play.boat_page import BoatPage
from hpamdp.env.boatdock.play.replay import HELD, Press, settle
from hpamdp.env.play_page import EpisodeError
from hpamdp.run.players import load_agent

NODE = shutil.which("node")
START, GOAL = (0.0, 60.0), (0.0, -60.0)  # key 1 of the congruent controller goes from one to the other


def test_a_new_press_ends_the_one_before_whose_release_then_counts_for_nothing():
    events = [(0.0, "down", 0), (0.4, "down", 2), (0.5, "up", 0), (0.9, "up", 2)]
    assert settle(events) == [Press(0, 0.0, 0.4), Press(2, 0.4, 0.5)]


def test_a_press_ends_when_the_window_loses_its_focus():
    assert settle([(0.0, "down", 0), (0.3, "blur", -1), (2.0, "up", 0)]) == [Press(0, 0.0, 0.3)]


def test_a_press_of_no_measurable_time_is_none_and_a_key_still_down_is_held():
    assert settle([(0.1, "down", 0), (0.1, "up", 0), (0.2, "down", 1)]) == [Press(1, 0.2, HELD)]


def test_there_are_no_more_presses_than_an_episode_has():
    events = [(float(i), kind, 0) for i in range(40) for kind in ("down", "blur")]
    spread = [(time + 0.5 * (kind == "blur"), kind, key) for time, kind, key in events]
    assert len(settle(spread)) == 25


def test_presses_from_rest_do_what_they_do_in_the_environment():
    num = 60
    layout = harbour.fixed_layouts(num, 3)
    rng = random.Random(0)
    env = BoatDockEnv(num, controller="congruent")
    td = env.reset(env.fixed_episodes(3))
    presses = [[(rng.randrange(3), rng.random()) for _ in range(3)] for _ in range(num)]
    for j in range(3):
        td = env.rand_action(td)
        td["action", "discrete"] = torch.tensor([row[j][0] for row in presses])
        td["action", "parameters"] = torch.tensor([[row[j][1]] * 3 for row in presses])
        td = env.step(td)["next"]
    for i, row in enumerate(presses):
        start, goal = ((layout[k][i].item(), layout[k + 1][i].item()) for k in (0, 2))
        episode = played(start, goal, "congruent", events_of(row))
        assert physics.OUTCOMES[int(td["outcome"][i])] == episode["outcome"]
        np.testing.assert_allclose(env.position[i], episode["end"], atol=1e-3)
        assert td["fuel"][i].item() == pytest.approx(episode["fuel"], abs=1e-6)


def test_a_new_press_stops_the_glide_where_the_boat_is():
    events = [{"t": t, "type": kind, "key": 1} for t, kind in ((0.0, "down"), (0.5, "up"), (0.7, "down"), (0.8, "up"))]
    episode = played(START, GOAL, "congruent", events)
    glided = physics.distance_at(torch.tensor(0.5).double(), torch.tensor(0.7).double()).item()
    whole = physics.total_distance(torch.tensor(0.1).double()).item()
    assert episode["end"] == pytest.approx([0.0, 60.0 - glided - whole], abs=1e-6)


@pytest.mark.parametrize(
    ("start", "presses", "outcome"),
    [
        ((0.0, 60.0), [(1, 1.2)], "success"),
        ((0.0, 60.0), [(1, 2.0)], "too_fast"),
        ((60.0, 60.0), [(1, 2.0)], "out_of_bounds"),
        ((0.0, 60.0), [(1, 0.3), (0, 0.3), (2, 0.3)] * 7, "out_of_fuel"),
        ((0.0, 60.0), [(k % 3, 0.01) for k in range(25)], "time_limit"),
    ],
)
def test_an_episode_ends_in_every_way_that_it_can(start, presses, outcome):
    episode = played(start, GOAL, "congruent", events_of(presses))
    assert episode["outcome"] == outcome
    assert episode["score"] == (pytest.approx(5.0 * episode["fuel"]) if outcome == "success" else -1.0)
    assert episodes.check(json.loads(json.dumps(episode))).outcome == outcome


def test_an_empty_tank_ends_the_last_press_and_nothing_interrupts_its_glide():
    presses = [(1, 0.3), (0, 0.3), (2, 0.3)] * 6 + [(1, 0.3)]
    dry = [*events_of(presses), {"t": 60.0, "type": "down", "key": 0}]
    episode = played(START, GOAL, "congruent", dry)
    assert episode["outcome"] == "out_of_fuel" and episode["fuel"] == 0.0
    assert sum(press["duration"] for press in episode["presses"]) == pytest.approx(6.0)


def test_a_dock_that_is_reached_with_the_key_down_stops_the_burn():
    episode = played((0.0, -15.0), GOAL, "congruent", [{"t": 1.0, "type": "down", "key": 1}])
    (press,) = episode["presses"]
    assert press["duration"] == pytest.approx(physics.duration_for(torch.tensor(30.0).double()).item())
    assert episode["fuel"] == pytest.approx(1.0 - press["duration"] / 6.0)


GOOD = docked(1)[0]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"score": 5.0}, "score"),
        ({"fuel": 0.99}, "fuel"),
        ({"outcome": "too_fast"}, "outcome"),
        ({"presses": [{"key": 0, "start": 0.3, "duration": 0.2}]}, "presses"),
        ({"events": GOOD["events"][:1]}, "presses"),
        ({"events": GOOD["events"][::-1]}, "times must not decrease"),
        ({"goal": GOOD["start"]}, "goal"),
        ({"consent": False}, "consent"),
        ({"address": "secret"}, "address"),
    ],
)
def test_an_episode_that_nobody_can_have_played_is_refused_in_a_line(change, said):
    with pytest.raises(EpisodeError, match=said) as refused:
        episodes.check({**GOOD, **change})
    assert "\n" not in str(refused.value)


def test_an_episode_that_is_not_over_is_refused():
    with pytest.raises(EpisodeError, match="Input should be"):
        episodes.check(played(START, GOAL, "congruent", events_of([(1, 0.2)])))


def in_node(script, given, tmp_path):
    """Run the page's scripts in node on JSON values and return what `script`, a function body, returns of them."""
    (tmp_path / "given.json").write_text(json.dumps(given))
    source = f"""
        const given = JSON.parse(require("fs").readFileSync({str(tmp_path / "given.json")!r}));
        const {{ makePhysics }} = require({str(BoatPage.files["physics.js"])!r});
        const {{ makeAgents }} = require({str(BoatPage.files["network.js"])!r});
        console.log(JSON.stringify((() => {{ {script} }})()));
    """
    ended = subprocess.run([NODE, "-e", source], capture_output=True, text=True, check=True, timeout=60)
    return json.loads(ended.stdout)


needs_node = pytest.mark.skipif(NODE is None, reason="needs node")


@pytest.fixture(scope="module")
def page_data():
    """The data of a page with one block of rounds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hpamdp.env.boatdock.play.boat_page.NUM_BLOCKS", 1)
        return BoatPage(seed=0).data([], has_server=False)


@needs_node
def test_ten_thousand_random_presses_end_where_python_ends_them(tmp_path, page_data):
    rng = random.Random(5)
    num = 2500
    layout = harbour.fixed_layouts(num, 5)
    given = []
    for i in range(num):
        start, goal = ([layout[k][i].item(), layout[k + 1][i].item()] for k in (0, 2))
        controller, keymap = rng.choice(harbour.CONTROLLERS), rng.choice([1, 2])
        events = random_events(rng, rng.randint(0, 12))
        given.append({"start": start, "goal": goal, "controller": controller, "keymap": keymap, "events": events})
    script = """
        const p = makePhysics(given.rules);
        return given.episodes.map((e) => {
          const row = e.controller === "congruent" ? "congruent" : `incongruent_${e.keymap}`;
          return p.sail(e, { directions: given.directions[row] }, p.settle(e.events), Infinity);
        });
    """
    found = in_node(script, {**page_data, "episodes": given}, tmp_path)
    bare = [episodes.Episode.model_construct(**{**e, "presses": []}) for e in given]
    settled = [settle((e["t"], e["type"], e["key"]) for e in each["events"]) for each in given]
    sailed = episodes.sail(bare, settled)
    assert sum(map(len, settled)) > 10_000
    assert [physics.OUTCOMES[code] for code in sailed.outcome.tolist()] == [e["outcome"] for e in found]
    assert {e["outcome"] for e in found} >= {"sailing", "success", "too_fast", "out_of_bounds", "out_of_fuel"}
    assert sailed.num_presses.tolist() == [len(e["presses"]) for e in found]
    np.testing.assert_allclose(sailed.end_x, [e["x"] for e in found], atol=1e-6)
    np.testing.assert_allclose(sailed.end_y, [e["y"] for e in found], atol=1e-6)
    np.testing.assert_allclose(sailed.fuel, [e["fuel"] for e in found], atol=1e-12)
    np.testing.assert_allclose(sailed.ended, [e["ended"] for e in found], atol=1e-3)
    for i, e in enumerate(found):
        said = [press["duration"] for press in e["presses"]]
        np.testing.assert_allclose(sailed.burnt[i, : len(said)], said, atol=1e-12)


@needs_node
def test_agents_act_in_the_page_as_they_do_in_torch(tmp_path, page_data):
    words = ["high=meta_critic", "low=hppo", "eval.layouts=20", "eval.seed=9", "film=false"]
    linucb = ["high=linucb", *words[1:]]
    for settings in (words, [*words, "agent.sharing=shared"], linucb, [*linucb, "high.features=polynomial"]):
        player = load_agent(None, settings)
        if "high=linucb" in settings:
            selector = player.agent.selector
            selector.moment.copy_(torch.randn_like(selector.moment))
            selector.gram.add_(torch.eye(selector.gram.shape[-1]))
        results = player.evaluation().run(player.agent.policy)
        entry = {"name": "a", "title": "a", "controller": "choose", "keymap": 1, "agent": player.agent.exported()}
        places = [{"start": s.tolist(), "goal": g.tolist()}
                  for s, g in zip(results["start"], results["goal"], strict=True)]  # fmt: skip
        script = """
            const crew = makeAgents(given, makePhysics(given.rules));
            return given.places.map((layout) => crew.agents[0].sail(layout));
        """
        found = in_node(script, {**page_data, "agents": [entry], "places": places}, tmp_path)
        assert [harbour.CONTROLLERS.index(each["controller"]) for each in found] == results["option"].tolist()
        outcomes = [physics.OUTCOMES[code] for code in results["outcome"]]
        same = [one == other for one, other in zip(outcomes, [e["outcome"] for e in found], strict=True)]
        assert np.mean(same) >= 0.95  # float32 there, float64 here
        ends = np.array([each["points"][-1] for each in found])
        last = np.array([path[np.isfinite(path).all(1)][-1] for path in results["path"]])
        np.testing.assert_allclose(ends[same], last[same], atol=0.05)


@needs_node
def test_the_plans_of_the_page_score_what_the_planner_says(tmp_path, page_data):
    script = """
        const crew = makeAgents(given, makePhysics(given.rules));
        return given.layouts.free.flatMap((layout) =>
          ["congruent", "incongruent"].map((boat) => crew.sailPlan(layout, boat))).map((s) => [s.score, s.planned]);
    """
    scores = np.array(in_node(script, page_data, tmp_path))
    np.testing.assert_allclose(scores[:, 0], scores[:, 1], atol=1e-3)


def test_the_layouts_of_the_page_are_those_of_no_evaluation_and_follow_the_rules(page_data, monkeypatch):
    layouts = [layout for mode in page_data["layouts"].values() for layout in mode]
    assert [len(page_data["layouts"][mode]) for mode in ("practice", "round")] == [10, 60]
    start, goal = (np.array([layout[name] for layout in layouts]) for name in ("start", "goal"))
    assert np.linalg.norm(start, axis=1).max() <= 110.001 and np.linalg.norm(start - goal, axis=1).min() >= 29.999
    evaluated = torch.stack(harbour.fixed_layouts(1000, 0)[:2], -1).numpy()
    assert np.abs(start[:, None] - evaluated).max(-1).min() > 1e-4
    monkeypatch.setattr("hpamdp.env.boatdock.play.boat_page.NUM_BLOCKS", 1)
    assert BoatPage(seed=1).data([], has_server=False)["layouts"] != page_data["layouts"]


def test_an_agent_of_other_rules_is_refused():
    entry = {"name": "other", "title": "a", "score": None, "env": {"slip": 0.1}, "agent": {}}
    with pytest.raises(EpisodeError, match=r"^other: was trained with env\.slip=0\.1, but the page has 0\.0$"):
        BoatPage(seed=0).data([entry], has_server=True)
