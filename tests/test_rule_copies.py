"""The boats' rules are written in several places, which must agree: `task.py` lists them."""

import re
from typing import get_args

from hpamdp.env.boatdock import figures, kernel, physics, planner, task
from hpamdp.env.boatdock.play.boat_page import BoatPage
from hpamdp.env.boatdock.play.episodes import Episode
from hpamdp.env.boatdock.reference import HUMAN

ENDED = task.OUTCOMES[1:]


def script(name):
    return BoatPage.files[name].read_text(encoding="utf-8")


def test_every_place_that_names_the_outcomes_names_all_of_them():
    assert get_args(Episode.model_fields["outcome"].annotation) == ENDED
    assert figures._OUTCOME_COLOURS.keys() == set(task.OUTCOMES)
    assert HUMAN["chosen"].keys() >= set(ENDED)
    words = re.search(r"const OUTCOMES = \{(.*?)\n  \};", script("game.js"), re.DOTALL)[1]
    assert re.findall(r"(\w+): [\"`]", words) == [*ENDED]
    assert set(re.findall(r'"([a-z]+(?:_[a-z]+)*)"', script("physics.js"))) >= set(task.OUTCOMES)


def test_the_page_gets_its_constants_from_the_task_and_its_own_are_equal(monkeypatch):
    monkeypatch.setattr(BoatPage, "_layouts", lambda self: {})
    rules = BoatPage(seed=0).data([], has_server=False)["rules"]
    assert rules["docking_speed"] == task.DOCKING_SPEED and rules["dock_radius"] == task.DOCK_RADIUS
    assert rules["harbour_radius"] == task.HARBOUR_RADIUS and rules["glide"] == task.GLIDE
    assert rules["tank"] == task.TANK and rules["max_presses"] == task.MAX_PRESSES
    text = script("physics.js")
    assert f"const DRY = {task.DRY:g};".replace("e-06", "e-6") in text
    assert f"({task.SUCCESS_REWARD:g} * fuel) / rules.tank : {task.FAILURE_REWARD:g}" in text
    assert "strength * speed(virtual) <= rules.docking_speed ? OUTCOMES.success : OUTCOMES.tooFast" in text
    assert re.search(r"const speed = \(t\) => t \* t \* \(100 - \(20 / 3\) \* t\);", text)


def test_a_played_episode_may_have_any_score_of_the_rules():
    limits = {name: getattr(each, name) for each in Episode.model_fields["score"].metadata for name in each.__slots__}
    assert limits == {"ge": task.FAILURE_REWARD, "le": task.SUCCESS_REWARD}


def test_the_kernel_and_the_planner_have_the_tasks_constants():
    assert kernel._DOCKING_SPEED == task.DOCKING_SPEED and kernel._DOCK == task.DOCK_RADIUS
    assert planner.DOCK_RADIUS == physics.DOCK_RADIUS == task.DOCK_RADIUS
    assert planner.TANK == physics.TANK == task.TANK and planner.HARBOUR_RADIUS == task.HARBOUR_RADIUS
