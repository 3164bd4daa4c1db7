"""The page on which people dock boats, beside agents and the best plans."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from hpamdp import __version__
from hpamdp.env.boatdock import harbour, physics, planner
from hpamdp.env.boatdock.options import BoatDockOptions
from hpamdp.env.boatdock.play import episodes
from hpamdp.env.boatdock.reference import (
    BEST_PERSON,
    HUMAN,
    HUMAN_CONGRUENT_BY_OFFSET,
    HUMAN_SUCCESS_BY_BLOCK,
    OFFSET_EDGES,
)
from hpamdp.env.boatdock.task import MAX_PRESSES, Outcome
from hpamdp.env.play_page import EpisodeError

BLOCK, NUM_BLOCKS = 60, 6  # as in the recording of people
_PRACTICE, _FREE = 10, 120
# The page's own boats, as settings of an environment.
_PLAIN = {"boats": None, "switch_cost": None, "motor_noise": 0.0, "sensor_noise": 0.0, "slip": 0.0}
_OF_PEOPLE = {**_PLAIN, "controller": "choose", "keymap": 1}  # the player chooses both on the page
_OF_AGENTS = {**_PLAIN, "observation": "scaled"}
# Settings of agents for which the page has several values. Nothing is drawn at random there.
_CHOICES_OF_AGENTS = {"controller": ("choose", "congruent", "incongruent"), "keymap": (1, 2)}
MOST_AGENTS = 8  # the colours of agents in `game.js`
_FOLDER = Path(__file__).resolve().parent / "page"


def shared_data(has_server: bool, **rules: float) -> dict[str, Any]:
    """Return what every page of boats needs; its rules are those of motion and episode, and the page's own ones."""
    shared = {
        "harbour_radius": physics.HARBOUR_RADIUS,
        "dock_radius": physics.DOCK_RADIUS,
        "glide": physics.GLIDE,
        "docking_speed": physics.DOCKING_SPEED,
        "tank": physics.TANK,
        "max_duration": physics.MAX_DURATION,
        "max_presses": MAX_PRESSES,
        "outcomes": {outcome.name.lower(): outcome.words for outcome in Outcome},
    }
    rules_of_page = {**shared, **rules}
    return {"format": episodes.FORMAT, "software": __version__, "has_server": has_server, "rules": rules_of_page}


def places(layout: harbour.Layout) -> list[dict[str, list[float]]]:
    """Return `start` and `goal` of each layout; numbers are not rounded."""
    columns = zip(*(column.tolist() for column in layout), strict=True)
    return [{"start": [x, y], "goal": [goal_x, goal_y]} for x, y, goal_x, goal_y in columns]


class BoatPage:
    """The page, with its own layouts, which neither training nor evaluation uses.

    Args:
        seed: seed of the layouts.
        rules: rules of the environment.

    Raises:
        ValueError: the rules differ from those of the page.
    """

    files: Mapping[str, Path] = {
        name: _FOLDER / name for name in ("index.html", "style.css", "physics.js", "network.js", "game.js", "boats.js")
    }
    shows_agents = True

    def __init__(self, seed: int, rules: BoatDockOptions | None = None) -> None:
        other = other_setting({} if rules is None else dict(rules), _OF_PEOPLE)
        if other is not None:
            raise ValueError(f"BoatDockEnv: {other}")
        self.seed = seed

    def data(self, agents: Sequence[Mapping[str, Any]], *, has_server: bool) -> dict[str, Any]:
        """Return the rules, the layouts with their best plans, the agents, and people's results."""
        for number, agent in enumerate(agents, 1):
            _check_agent(agent)
            if number > MOST_AGENTS:
                told_apart = f"the page tells at most {MOST_AGENTS} agents apart"
                raise EpisodeError(f"{agent['name']}: {told_apart}, and this is number {number}")
        return {
            **shared_data(has_server, block=BLOCK, num_blocks=NUM_BLOCKS),
            "directions": {
                "incongruent_1": harbour.DIRECTIONS[0],
                "incongruent_2": harbour.DIRECTIONS[1],
                "congruent": harbour.DIRECTIONS[2],
            },
            "layouts": self._layouts(),
            "people": {
                "mean": HUMAN["chosen"]["score"],
                "best": BEST_PERSON["score"],
                "success": HUMAN["chosen"]["success"],
                "best_success": BEST_PERSON["success"],
                "success_by_block": HUMAN_SUCCESS_BY_BLOCK,
            },
            "agents": [
                {
                    "name": agent["name"],
                    "title": agent["title"],
                    "score": agent["score"],
                    "controller": agent["env"].get("controller", "choose"),
                    "keymap": agent["env"].get("keymap", 1),
                    "agent": agent["agent"],
                }
                for agent in agents
            ],
        }

    def check(self, episode: object) -> dict[str, Any]:
        """Check an episode, as `episodes.check` does, and return it in the form of the file."""
        return episodes.check(episode).model_dump(mode="json")

    def told(self, episodes: Sequence[Mapping[str, Any]]) -> str:
        """Tell nothing: the page has the means, and `python -m hpamdp.data.human summary` those of a file."""
        return ""

    def _layouts(self) -> dict[str, list[dict[str, Any]]]:
        """Return the layouts of each mode: start, goal, people's choice, and each boat's best score and plan.

        The keys of the plans belong to key map 1. Numbers are not rounded, because some plans barely touch the dock.
        """
        sizes = {"practice": _PRACTICE, "round": BLOCK * NUM_BLOCKS, "free": _FREE}
        num = sum(sizes.values())
        # Evaluations use small seeds, so their layouts differ from these.
        layout = harbour.fixed_layouts(num, 2**31 + self.seed)
        plans = planner.best_plans(layout, torch.ones(num, dtype=torch.int32))
        bins = torch.bucketize(harbour.bearing_offset(layout), torch.tensor(OFFSET_EDGES[1:-1], dtype=torch.float32))
        rows = [
            {
                **place,
                "people": HUMAN_CONGRUENT_BY_OFFSET[int(bins[i])],
                "best": {
                    name: {
                        "score": plans.score[i, option].item(),
                        "presses": [
                            {
                                "key": int(plans.keys[i, option, j]),
                                "duration": plans.durations[i, option, j].item(),
                            }
                            for j in range(int(plans.num_presses[i, option]))
                        ],
                    }
                    for option, name in enumerate(harbour.CONTROLLERS)
                },
            }
            for i, place in enumerate(places(layout))
        ]
        modes, first = {}, 0
        for mode, size in sizes.items():
            modes[mode] = rows[first : first + size]
            first += size
        return modes


def _check_agent(agent: Mapping[str, Any]) -> None:
    """Check that an agent was trained with the boats of the page.

    Raises:
        EpisodeError: a setting differs. The message names it.
    """
    other = other_setting(agent["env"], _OF_AGENTS)
    if other is not None:
        raise EpisodeError(f"{agent['name']}: was trained with env.{other}")
    for name, allowed in _CHOICES_OF_AGENTS.items():
        given = agent["env"].get(name, allowed[0])
        if given not in allowed:
            named = f"{', '.join(map(str, allowed[:-1]))} or {allowed[-1]}"
            raise EpisodeError(f"{agent['name']}: was trained with env.{name}={given}, but the page has {named}")


def other_setting(settings: Mapping[str, Any], of_page: Mapping[str, Any]) -> str | None:
    """Return a text about the first setting that differs from the page's, or None. Missing settings do not differ."""
    for name, value in of_page.items():
        given = settings.get(name, value)
        if given != value and given != [value, value] and given != (value, value):
            named = list(given) if isinstance(given, tuple) else given
            return f"{name}={named}, but the page has {'none' if value is None else value}"
    return None
