"""The boats' rules are written in several places, which must agree: `task.py` lists them."""

import re

from hpamdp.env.boatdock import kernel, physics, planner, task
from hpamdp.env.boatdock.play.boat_page import BoatPage


def script(name):
    return BoatPage.files[name].read_text(encoding="utf-8")


def test_the_page_names_all_outcomes():
    assert set(re.findall(r'"([a-z]+(?:_[a-z]+)*)"', script("physics.js"))) >= set(task.OUTCOMES)


def test_the_page_gets_its_constants_from_the_task_and_its_own_are_equal(monkeypatch):
    monkeypatch.setattr(BoatPage, "_layouts", lambda self: {})
    rules = BoatPage(seed=0).data([], has_server=False)["rules"]
    assert rules["docking_speed"] == task.DOCKING_SPEED and rules["dock_radius"] == task.DOCK_RADIUS
    assert rules["harbour_radius"] == task.HARBOUR_RADIUS and rules["glide"] == task.GLIDE
    assert [*rules["outcomes"]] == [*task.OUTCOMES]
    assert rules["tank"] == task.TANK and rules["max_presses"] == task.MAX_PRESSES
    text = script("physics.js")
    assert f"const DRY = {task.DRY:g};".replace("e-06", "e-6") in text
    assert f"({task.SUCCESS_REWARD:g} * fuel) / rules.tank : {task.FAILURE_REWARD:g}" in text
    assert "strength * speed(virtual) <= rules.docking_speed ? OUTCOMES.success : OUTCOMES.tooFast" in text
    assert re.search(r"const speed = \(t\) => t \* t \* \(100 - \(20 / 3\) \* t\);", text)


def test_the_kernel_and_the_planner_have_the_tasks_constants():
    assert kernel._DOCKING_SPEED == task.DOCKING_SPEED and kernel._DOCK == task.DOCK_RADIUS
    assert planner.DOCK_RADIUS == physics.DOCK_RADIUS == task.DOCK_RADIUS
    assert planner.TANK == physics.TANK == task.TANK and planner.HARBOUR_RADIUS == task.HARBOUR_RADIUS
