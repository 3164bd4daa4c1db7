"""Sessions that people played on the page: their schema and their checks.

A file has one JSON object per line, a session with all its trips. The models below are the schema, and
`docs/play.md` explains the fields.
"""

from __future__ import annotations

from typing import Annotated

import torch
from pydantic import BaseModel, Field

from hpamdp.env.boatdock import physics
from hpamdp.env.boatdock.play.episodes import STRICT, Point, Record, Trip, parse, problems_of_trips
from hpamdp.env.boatdock_unseen import fleet
from hpamdp.env.boatdock_unseen.options import MOST_TRIPS, Family, UnseenBoatsOptions
from hpamdp.env.play_page import EpisodeError

# Largest difference between a boat and the one that its family has for the number. Sines differ between machines.
_TOLERANCE = 1e-5


class PlayedRules(BaseModel):
    """The rules of a session, as the settings of the same names in `UnseenBoatsOptions`."""

    model_config = STRICT

    family: Family
    separation: Annotated[float, Field(ge=0.0, le=110.0)]
    spread: Annotated[float, Field(ge=0.0, le=0.5)]
    boats: Annotated[int, Field(ge=1, le=2)]
    trips: Annotated[int, Field(ge=1, le=MOST_TRIPS)]
    shortest_press: Annotated[float, Field(ge=0.0, le=1.0)]


class PlayedBoat(BaseModel):
    """A boat of a session: its number in the family, and what it does as `fleet.Boats` has it."""

    model_config = STRICT

    number: Annotated[int, Field(ge=-(2**31), lt=2**31)]
    directions: tuple[Point, Point, Point]
    strength: float
    glide: float


class SessionTrip(Trip):
    """A trip: the boat, 0 or 1, and how it was sailed."""

    boat: Annotated[int, Field(ge=0, le=1)]


class Session(Record):
    """One line of the file."""

    rules: PlayedRules
    boats: Annotated[list[PlayedBoat], Field(max_length=2)]
    trips: Annotated[list[SessionTrip], Field(max_length=MOST_TRIPS)]


def rules_of(options: UnseenBoatsOptions) -> PlayedRules:
    """Return the rules of sessions that people play with these settings."""
    return PlayedRules.model_validate({name: getattr(options, name) for name in PlayedRules.model_fields})


def check(value: object) -> Session:
    """Return a valid session.

    Its boats must be those of the family. In each trip the presses must follow from the events, and the end from the
    presses.

    Raises:
        EpisodeError: the session is not valid. The message is one line.
    """
    session = parse(Session, value)
    rules = session.rules
    for name, entries, num in (("boats", session.boats, rules.boats), ("trips", session.trips, rules.trips)):
        if len(entries) != num:
            raise EpisodeError(f"{name}: {len(entries)}, but the session has {num}")
    _check_boats(session)
    boats = torch.tensor([trip.boat for trip in session.trips])
    if boats.max() >= rules.boats:
        raise EpisodeError(f"trips.{int(boats.argmax())}.boat: {int(boats.max())}, but the session has {rules.boats}")
    directions, strength, glide = (
        torch.tensor([getattr(boat, name) for boat in session.boats], dtype=torch.float64)[boats]
        for name in fleet.Boats._fields
    )
    problems = problems_of_trips(
        session.trips,
        directions,
        strength=strength,
        glide=glide,
        shortest=rules.shortest_press,
        longest=physics.MAX_DURATION,
    )
    for number, problem in enumerate(problems):
        if problem is not None:
            raise EpisodeError(f"trips.{number}.{problem}")
    return session


def _check_boats(session: Session) -> None:
    rules = session.rules
    options = UnseenBoatsOptions(family=rules.family, separation=rules.separation, spread=rules.spread)
    bits = torch.tensor([boat.number for boat in session.boats], dtype=torch.int32)
    family = fleet.boats(bits, options.fleet)
    for name, known in family._asdict().items():
        said = torch.tensor([getattr(boat, name) for boat in session.boats], dtype=torch.float64)
        for i in range(len(session.boats)):
            if (said[i] - known[i]).abs().max() > _TOLERANCE:
                raise EpisodeError(f"boats.{i}.{name}: not those of boat {session.boats[i].number} of its family")
