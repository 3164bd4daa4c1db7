"""The page on which people dock boats that they do not know, in sessions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from hpamdp.env import counter_rng
from hpamdp.env.boatdock import harbour, task
from hpamdp.env.boatdock.harbour import Layout
from hpamdp.env.boatdock.play import boat_page
from hpamdp.env.boatdock.play.boat_page import BoatPage
from hpamdp.env.boatdock_unseen import fleet, planner
from hpamdp.env.boatdock_unseen.options import UnseenBoatsOptions
from hpamdp.env.boatdock_unseen.play import sessions
from hpamdp.env.play_page import EpisodeError

NUM_SESSIONS = 60
# What people see and do is exact, and their boats are new.
_OF_PEOPLE = {"motor_noise": 0.0, "sensor_noise": 0.0, "frame": "screen", "scored_boats": "new"}
_FOLDER = Path(__file__).resolve().parent / "page"


class SessionPage:
    """The page, with boats and layouts of its own.

    Args:
        seed: seed of the boats and of the layouts.
        options: settings of the environment.

    Raises:
        ValueError: the settings differ from those of the page.
    """

    files: Mapping[str, Path] = {
        **{name: BoatPage.files[name] for name in ("style.css", "physics.js", "game.js")},
        **{name: _FOLDER / name for name in ("index.html", "sessions.js")},
    }
    shows_agents = False

    def __init__(self, seed: int, options: UnseenBoatsOptions | None = None) -> None:
        self.options = UnseenBoatsOptions() if options is None else options
        other = boat_page.other_setting(self.options.model_dump(), _OF_PEOPLE)
        if other is not None:
            raise ValueError(f"UnseenBoatsEnv: {other}")
        self.rules = sessions.rules_of(self.options)
        self.seed = seed
        self._sessions = self._draw_sessions()

    def data(self, agents: Sequence[Mapping[str, Any]], *, has_server: bool) -> dict[str, Any]:
        """Return the rules, and the sessions with their boats, their layouts and the scores of the best plans."""
        if agents:
            raise EpisodeError(f"{agents[0]['name']}: people play sessions alone")
        return {
            **boat_page.shared_data(
                has_server, shortest_press=self.rules.shortest_press, longest_press=task.MAX_DURATION
            ),
            "session_rules": self.rules.model_dump(mode="json"),
            "sessions": self._sessions,
        }

    def check(self, episode: object) -> dict[str, Any]:
        """Check a session, as `sessions.check` does, and return it in the form of the file."""
        return sessions.check(episode).model_dump(mode="json")

    def told(self, episodes: Sequence[Mapping[str, Any]]) -> str:
        """Return the mean score by number of the trip, of those sessions that have the page's rules."""
        own = [each for each in episodes if each["rules"] == self.rules.model_dump(mode="json")]
        if not own:
            return ""
        trips = [trip for session in own for trip in session["trips"]]
        ends = torch.tensor([[*trip["start"], *trip["goal"]] for trip in trips], dtype=torch.float32)
        numbers = torch.tensor([[boat["number"] for boat in session["boats"]] for session in own], dtype=torch.int32)
        best = self._best_scores(Layout(*ends.unbind(-1)), numbers)
        score = torch.tensor([trip["score"] for trip in trips])
        you, knowing = (
            ", ".join(f"{mean:.2f}" for mean in each.reshape(len(own), -1).mean(0).tolist()) for each in (score, best)
        )
        num = f"{len(own)} session{'' if len(own) == 1 else 's'}"
        return f"mean score by number of the trip, {num}: {you}; the best plans, which know the boat: {knowing}"

    def _draw_sessions(self) -> list[dict[str, Any]]:
        num_trips, num_boats = self.rules.trips, self.rules.boats
        # Evaluations use small seeds, so their boats and layouts differ from these.
        seed = 2**31 + self.seed
        layout = harbour.fixed_layouts(NUM_SESSIONS * num_trips, seed)
        row = torch.arange(NUM_SESSIONS, dtype=torch.int32)
        # Number 0 of each row has a layout. The bits of boats for training are even.
        bits = [
            counter_rng.rng_key(
                counter_rng.seed_tensor(seed), counter_rng.EVALUATION, row, torch.full_like(row, 1 + boat)
            ).bits
            | 1
            for boat in range(num_boats)
        ]
        numbers = torch.stack(bits, -1)
        best = self._best_scores(layout, numbers)
        does = [fleet.boats(each, self.options.fleet) for each in bits]
        boats = [
            [
                {"number": int(numbers[i, j]), **{name: column[i].tolist() for name, column in each._asdict().items()}}
                for j, each in enumerate(does)
            ]
            for i in range(NUM_SESSIONS)
        ]
        trips = [{**place, "best": each} for place, each in zip(boat_page.places(layout), best.tolist(), strict=True)]
        return [{"boats": boats[i], "trips": trips[i * num_trips : (i + 1) * num_trips]} for i in range(NUM_SESSIONS)]

    def _best_scores(self, layout: Layout, numbers: Tensor) -> Tensor:
        """Return the best score of each trip, with the better boat, of somebody who knows what the keys do.

        Args:
            layout: layouts of the trips, session by session, `[sessions * trips]`.
            numbers: bits of the boats of each session, int32 `[sessions, boats]`.
        """
        of_trips = numbers.repeat_interleave(self.rules.trips, 0)
        boats = [fleet.boats(bits, self.options.fleet) for bits in of_trips.unbind(-1)]
        return planner.best_scores(layout, boats, self.rules.shortest_press)
