"""Sessions that people play: their check from the key events on, the page's boats, and the page's script."""

import copy
import json
import random

import numpy as np
import pytest
import torch
from play_players import docked, events_of, random_events, recorded, sailed
from test_play_replay import in_node, needs_node

from hpamdp.commands.page_server import EpisodeFile
from hpamdp.env.boatdock import harbour, physics
from hpamdp.env.boatdock.play import episodes
from hpamdp.env.boatdock.play.replay import Press, settle
from hpamdp.env.boatdock_unseen import fleet, planner
from hpamdp.env.boatdock_unseen.environment import UnseenBoatsEnv
from hpamdp.env.boatdock_unseen.options import UnseenBoatsOptions
from hpamdp.env.boatdock_unseen.play import sessions
from hpamdp.env.boatdock_unseen.play.session_page import SessionPage
from hpamdp.env.play_page import EpisodeError

TRIPS = 3


def page_of(**settings):
    return SessionPage(seed=0, options=UnseenBoatsOptions(trips=TRIPS, **settings))


def play(page, number=0, **which):
    """Return a session in which somebody tries each key for a moment, and then plays the best plan from there."""
    drawn = page.data([], has_server=True)["sessions"][number]
    trips = []
    for i, layout in enumerate(drawn["trips"]):
        boat = i % len(drawn["boats"])
        does = drawn["boats"][boat]
        tried = [(key, page.rules.shortest_press) for key in range(3)] if i == 0 else []
        trips.append({"boat": boat, **dock(layout, does, tried, page.rules.shortest_press)})
    return {**recorded(**which), "rules": page.rules.model_dump(), "boats": drawn["boats"], "trips": trips}


def dock(layout, does, tried, shortest):
    x, y = layout["start"]
    fuel = physics.TANK
    for key, seconds in tried:
        way = does["strength"] * (1.0 + physics.GLIDE * does["glide"]) * physics.pressed_distance(torch.tensor(seconds))
        x, y = x + way.item() * does["directions"][key][0], y + way.item() * does["directions"][key][1]
        fuel -= seconds
    row = [torch.tensor([value]) for value in (x, y, *layout["goal"], fuel)]
    boat = [torch.tensor([does[name]]) for name in fleet.Boats._fields]
    plan = planner.best_plan(*row, *boat, shortest_press=shortest, is_rough=True)
    presses = [(int(plan.keys[0, j]), plan.durations[0, j].item()) for j in range(int(plan.num_presses[0]))]
    # A boat that glides on would be stopped by the next press, so wait longer than people's boats need.
    events = events_of([*tried, *presses], gap=1.0)
    unlike = {name: does[name] for name in ("strength", "glide")}
    return sailed(layout["start"], layout["goal"], does["directions"], events, **unlike, shortest=shortest, longest=2.0)


@pytest.mark.parametrize("settings", [{}, {"family": "strength", "boats": 2}], ids=str)
def test_a_session_that_was_sailed_is_accepted(settings):
    page = page_of(**settings)
    made = json.loads(json.dumps(play(page)))
    stored = page.check(made)
    assert stored == made and [trip["outcome"] for trip in stored["trips"]] == ["success"] * TRIPS
    # Finding out costs fuel, and the best plan of somebody who knows the boat cannot be beaten.
    best = [trip["best"] for trip in page.data([], has_server=True)["sessions"][0]["trips"]]
    assert all(trip["score"] < known + 0.07 for trip, known in zip(stored["trips"], best, strict=True))


PAGE = page_of()
GOOD = play(PAGE)


def forged(**changes):
    """Return the session with other values, under names such as `trips__1__score`."""
    made = copy.deepcopy(GOOD)
    for path, value in changes.items():
        *parents, last = (int(name) if name.isdecimal() else name for name in path.split("__"))
        place = made
        for name in parents:
            place = place[name]
        place[last] = value
    return made


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"trips__1__score": 5.0}, "trips.1.score: does not follow from the presses"),
        ({"trips__2__events__0__t": 0.31}, "trips.2.presses.0: does not follow from the events"),
        ({"trips": GOOD["trips"][:2]}, "trips: 2, but the session has 3"),
        ({"boats__0__strength": 1.3}, "boats.0.strength: not those of boat"),
        # The session's first presses last 0.15 s each.
        ({"rules__shortest_press": 0.2}, "trips.0.presses.0"),
        ({"trips__0__goal": GOOD["trips"][0]["start"]}, "trips.0.goal"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_session_that_nobody_can_have_sailed_is_refused_in_a_line(change, said):
    with pytest.raises(EpisodeError, match=said.replace(".", r"\.")) as refused:
        sessions.check(forged(**change))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("value", [None, [], 1, {}, docked(1)[0]], ids=str)
def test_what_is_no_session_is_refused_in_a_line(value):
    with pytest.raises(EpisodeError) as refused:
        sessions.check(value)
    assert "\n" not in str(refused.value)


def test_a_key_that_is_tapped_stays_down_for_the_shortest_press_and_no_other_key_counts_until_then():
    tap = [(0.0, "down", 0), (0.125, "up", 0)]
    assert settle(tap, 0.25, 2.0) == [Press(0, 0.0, 0.25)]
    assert settle([*tap, (0.125, "down", 1), (1.0, "up", 1)], 0.25, 2.0) == [Press(0, 0.0, 0.25), Press(1, 0.25, 0.75)]
    assert settle([*tap, (0.125, "down", 1), (0.25, "up", 1)], 0.25, 2.0) == [Press(0, 0.0, 0.25)]
    assert settle([(0.0, "down", 0)], 0.25, 2.0) == [Press(0, 0.0, 2.0)]


def test_the_pages_boats_and_layouts_are_those_of_no_training_and_no_evaluation():
    drawn = PAGE.data([], has_server=True)["sessions"]
    numbers = [boat["number"] for each in drawn for boat in each["boats"]]
    assert len(set(numbers)) == len(numbers) and all(number % 2 for number in numbers)
    env = UnseenBoatsEnv(len(numbers), trips=TRIPS)
    env.reset(env.fixed_episodes(0))
    assert not {*numbers} & {*env.state.first_boat.tolist()}
    start, goal = (np.array([trip[name] for each in drawn for trip in each["trips"]]) for name in ("start", "goal"))
    assert np.linalg.norm(start, axis=1).max() <= 110.001 and np.linalg.norm(start - goal, axis=1).min() >= 29.999
    assert len({*map(tuple, start)}) == len(numbers) * TRIPS
    evaluated = torch.stack(harbour.fixed_layouts(1000, 0)[:2], -1).numpy()
    assert np.abs(start[:, None] - evaluated).max(-1).min() > 1e-4


def test_the_means_by_trip_are_told_beside_those_of_the_best_plans():
    made = [play(PAGE, number, index=number) for number in range(2)]
    other = play(page_of(family="strength"))
    told = PAGE.told([PAGE.check(each) for each in (*made, other)])
    assert told.startswith("mean score by number of the trip, 2 sessions: ")
    you, best = ([float(mean) for mean in part.rpartition(": ")[2].split(", ")] for part in told.split("; "))
    mean = np.mean([[trip["score"] for trip in each["trips"]] for each in made], 0)
    np.testing.assert_allclose(you, mean, atol=0.0051)
    drawn = PAGE.data([], has_server=True)["sessions"][:2]
    np.testing.assert_allclose(
        best, np.mean([[trip["best"] for trip in each["trips"]] for each in drawn], 0), atol=0.0051
    )
    assert PAGE.told([other]) == ""


def test_a_file_of_sessions_takes_each_once_and_no_episodes_of_people_s_two_boats(tmp_path):
    file = EpisodeFile(tmp_path / "sessions.jsonl", PAGE)
    stored = PAGE.check(GOOD)
    assert file.add(stored) and not file.add(stored)
    assert EpisodeFile(tmp_path / "sessions.jsonl", PAGE).add(PAGE.check(play(PAGE, index=1)))
    (tmp_path / "boats.jsonl").write_text(json.dumps(docked(1)[0]) + "\n")
    with pytest.raises(EpisodeError, match="no line is an episode; take another file"):
        EpisodeFile(tmp_path / "boats.jsonl", PAGE)
    with pytest.raises(EpisodeError, match=r"line 1: trips: is a session with unknown boats, but must be an episode"):
        episodes.read(tmp_path / "sessions.jsonl")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["env.sensor_noise=2"], "env: UnseenBoatsEnv: sensor_noise=2.0, but the page has 0.0"),
        (["env.frame=first_press"], "frame=first_press, but the page has screen"),
        (["--agent", "linucb_hppo"], "--agent linucb_hppo: people play env=boatdock_unseen alone; leave it out"),
        (["--to", "nowhere/a.jsonl", "--agent", "none"], "No such file or directory"),
    ],
)
def test_play_tells_what_does_not_go_with_sessions_in_one_line(command, words, said):
    code, _, err = command("play", "env=boatdock_unseen", *words)
    assert code == 2 and said in err and err.count("\n") == 1


@needs_node
def test_unlike_boats_end_in_the_page_where_python_ends_them(tmp_path):
    page = page_of(family="strength", spread=0.5)
    data = page.data([], has_server=False)
    rng = random.Random(3)
    given = []
    for each in data["sessions"]:
        (boat,) = each["boats"]
        for layout in 3 * each["trips"]:
            given.append({"boat": boat, **layout, "events": random_events(rng, rng.randint(1, 12))})
    script = """
        const physics = makePhysics(given.rules);
        return given.trips.map((trip) => physics.sail(trip, trip.boat, physics.settle(trip.events), Infinity));
    """
    outcomes = set()
    for trip, found in zip(given, in_node(script, {"rules": data["rules"], "trips": given}, tmp_path), strict=True):
        unlike = {name: trip["boat"][name] for name in ("strength", "glide")}
        limits = {"shortest": page.rules.shortest_press, "longest": physics.MAX_DURATION}
        made = sailed(trip["start"], trip["goal"], trip["boat"]["directions"], trip["events"], **unlike, **limits)
        assert made["outcome"] == found["outcome"] and made["end"] == pytest.approx([found["x"], found["y"]], abs=1e-6)
        assert made["fuel"] == pytest.approx(found["fuel"] / physics.TANK, abs=1e-9)
        assert [press["duration"] for press in made["presses"]] == pytest.approx(
            [press["duration"] for press in found["presses"]], abs=1e-9
        )
        outcomes.add(found["outcome"])
    assert {"sailing", "success", "too_fast", "out_of_bounds"} <= outcomes
