"""Episodes that people played on the page: their schema, their checks, and the file that stores them.

A file has one JSON object per line, in the order in which the episodes arrived. `docs/play.md` explains the fields. The
models below are the schema. The file has no personal data: a player is a random number, drawn again whenever the page
is loaded.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Literal, TypeVar

import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from torch import Tensor

from hpamdp.env.boatdock import harbour, physics
from hpamdp.env.boatdock.play.replay import HELD, Press, Replay, replay, settle
from hpamdp.env.boatdock.task import FAILURE_REWARD, MAX_PRESSES, SUCCESS_REWARD
from hpamdp.env.play_page import EpisodeError
from hpamdp.files import read_regular
from hpamdp.json_lines import left_out, lines_of, read_json
from hpamdp.messages import reason_of, warn

FORMAT = 1
PRACTICE = "practice"
# Largest difference between the page's figures and those computed from its presses: px, s, fractions of the fuel.
_TOLERANCE = 1e-6
_LONGEST = 3600.0  # s, longest episode
_MAX_EVENTS = 2000
_MAX_BYTES = 256 * 2**20

Seconds = Annotated[float, Field(ge=0.0, le=_LONGEST)]
Key = Annotated[int, Field(ge=0, lt=harbour.NUM_KEYS)]
Point = tuple[float, float]

STRICT = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)


class RawEvent(BaseModel):
    """A key event as the browser reported it."""

    model_config = STRICT

    t: Seconds
    type: Literal["down", "up", "blur"]
    key: Annotated[int, Field(ge=-1, lt=harbour.NUM_KEYS)]
    code: Annotated[str, Field(max_length=24, pattern="^[A-Za-z0-9]*$")]


class SettledPress(BaseModel):
    """A press as the game counted it."""

    model_config = STRICT

    key: Key
    start: Seconds
    duration: Annotated[float, Field(gt=0.0, le=physics.TANK)]


class Record(BaseModel):
    """What every line of a file has."""

    model_config = STRICT

    format: Literal[1]
    software: Annotated[str, Field(max_length=32, pattern=r"^[\w.+-]+$")]
    consent: Literal[True]
    player: Annotated[str, Field(pattern="^[0-9a-f]{16}$")]
    index: Annotated[int, Field(ge=0, lt=1_000_000)]
    resolution: Annotated[float, Field(ge=0.0, le=1.0)]


class Trip(BaseModel):
    """How somebody sailed a boat from its start to an outcome.

    Lengths are px from the harbour's centre (y down), times are s since the boat was chosen.
    """

    model_config = STRICT

    start: Point
    goal: Point
    events: Annotated[list[RawEvent], Field(min_length=1, max_length=_MAX_EVENTS)]
    presses: Annotated[list[SettledPress], Field(min_length=1, max_length=MAX_PRESSES)]
    outcome: Literal[physics.OUTCOMES[1:]]  # type: ignore[valid-type]
    fuel: Annotated[float, Field(ge=0.0, le=1.0)]
    score: Annotated[float, Field(ge=FAILURE_REWARD, le=SUCCESS_REWARD)]
    end: Point


class Episode(Record, Trip):
    """One line of the file."""

    mode: Literal["practice", "round", "free"]
    keymap: Literal[1, 2]
    controller: Literal["incongruent", "congruent"]


RecordT = TypeVar("RecordT", bound=Record)


def check(value: object) -> Episode:
    """Return a valid episode. Its presses must follow from its events, and its end from its presses.

    Raises:
        EpisodeError: the episode is not valid. The message is one line.
    """
    episode = _parse_episode(value)
    (problem,) = _problems([episode])
    if problem is not None:
        raise EpisodeError(problem)
    return episode


def sail(episodes: Sequence[Episode], presses: Sequence[Sequence[Press | SettledPress]] | None = None) -> Replay:
    """Replay episodes from the given presses. If None, from their own presses."""
    return sail_trips(episodes, _directions(episodes), presses)


def sail_trips(
    trips: Sequence[Trip],
    directions: Tensor,
    presses: Sequence[Sequence[Press | SettledPress]] | None = None,
    *,
    strength: Tensor | float = 1.0,
    glide: Tensor | float = 1.0,
) -> Replay:
    """Replay trips with any boats.

    Args:
        trips: E trips.
        directions: unit directions of the keys of each trip's boat, float64 `[E, 3, 2]`.
        presses: the presses to replay. If None, the trips' own presses.
        strength, glide: factors of each boat's speed and glide, see `physics`, float64 `[E]` or a number.
    """
    rows = [trip.presses for trip in trips] if presses is None else presses
    num, longest = len(trips), max(map(len, rows), default=0)
    keys = torch.zeros(num, longest, dtype=torch.long)
    starts = torch.full((num, longest), HELD, dtype=torch.float64)
    durations = torch.zeros(num, longest, dtype=torch.float64)
    for i, row in enumerate(rows):
        for j, press in enumerate(row):
            keys[i, j], starts[i, j], durations[i, j] = press.key, press.start, press.duration
    start, goal = (_points([getattr(trip, name) for trip in trips]) for name in ("start", "goal"))
    return replay(start, goal, directions, keys, starts, durations, strength=strength, glide=glide)


def _directions(episodes: Sequence[Episode]) -> Tensor:
    """Return the directions of the keys of each episode's boat, float64 `[E, 3, 2]`."""
    return torch.tensor(harbour.DIRECTIONS, dtype=torch.float64)[direction_rows(episodes)]


def direction_rows(episodes: Sequence[Episode]) -> Tensor:
    """Return each episode's row in `harbour.DIRECTIONS`, int64 `[E]`."""
    return torch.tensor([2 if e.controller == "congruent" else e.keymap - 1 for e in episodes], dtype=torch.long)


def read(path: Path) -> dict[int, Episode]:
    """Read a file and return its valid episodes by line number.

    Each episode is checked as by `check`. Lines without a valid episode, and lines that repeat an earlier episode, are
    left out. A warning names these lines.

    Raises:
        EpisodeError: the file cannot be read, or it has lines but no valid episode.
    """
    episodes, problems = read_with_problems(path)
    if problems:
        warn_once(f"{path}: {left_out(len(episodes) + len(problems), problems)}")
    return episodes


def read_with_problems(path: Path) -> tuple[dict[int, Episode], dict[int, str]]:
    """Return the episodes of a file, as `read` does, and the problem of each line that is left out.

    Raises:
        EpisodeError: as for `read`.
    """
    try:
        data = read_regular(path, _MAX_BYTES)
    except FileNotFoundError as error:
        raise EpisodeError(f"{path}: there is no such file; `hpamdp play` writes one") from error
    except OSError as error:
        raise EpisodeError(f"{path}: {reason_of(error)}") from error
    parsed: dict[int, Episode] = {}
    problems: dict[int, str] = {}
    for number, line in lines_of(data):
        try:
            parsed[number] = _parse_episode(read_json(line))
        except ValueError as error:
            problems[number] = str(error)
    episodes: dict[int, Episode] = {}
    line_of: dict[tuple[str, int], int] = {}
    for (number, episode), problem in zip(parsed.items(), _problems([*parsed.values()]), strict=True):
        name = (episode.player, episode.index)
        if problem is None and name in line_of:
            problem = f"the same episode as line {line_of[name]}"
        if problem is None:
            line_of[name] = number
            episodes[number] = episode
        else:
            problems[number] = problem
    if problems and not episodes:
        number, problem = min(problems.items())
        raise EpisodeError(f"{path}, line {number}: {problem}; no line is an episode")
    return episodes, problems


@cache
def warn_once(message: str) -> None:
    """Warn about the lines left out of a file, once even if many environments read it."""
    warn(message)


def parse(form: type[RecordT], value: object) -> RecordT:
    """Return what a line holds, with the fields of `form`. Whether anybody can have played it is not checked.

    Raises:
        EpisodeError: it does not have this form. The message is one line.
    """
    try:
        # Validate JSON text, for which the strict mode accepts lists as tuples.
        return form.model_validate_json(json.dumps(value, allow_nan=False))
    except ValidationError as error:
        wrong = error.errors(include_url=False, include_input=False, include_context=False)[0]
        where = ".".join(map(str, wrong["loc"])) or "episode"
        raise EpisodeError(f"{where[:80]}: {wrong['msg']}") from error
    except (ValueError, TypeError) as error:
        raise EpisodeError("episode: is not a JSON object") from error


def _parse_episode(value: object) -> Episode:
    if isinstance(value, dict) and "trips" in value:
        raise EpisodeError("trips: is a session with unknown boats, but must be an episode with one of people's two")
    return parse(Episode, value)


def _points(points: Sequence[Point]) -> Tensor:
    return torch.tensor(points, dtype=torch.float64).reshape(-1, 2)


def _problems(episodes: Sequence[Episode]) -> list[str | None]:
    return problems_of_trips(episodes, _directions(episodes))


def problems_of_trips(
    trips: Sequence[Trip],
    directions: Tensor,
    *,
    strength: Tensor | float = 1.0,
    glide: Tensor | float = 1.0,
    shortest: float = 0.0,
    longest: float = HELD,
) -> list[str | None]:
    """Return the problem of each trip, or None if its presses and its end follow from its key events.

    `sail_trips` explains the boats, and `replay.settle` the shortest and the longest press.
    """
    settled = [settle(((event.t, event.type, event.key) for event in trip.events), shortest, longest) for trip in trips]
    from_events, from_presses = (
        sail_trips(trips, directions, presses, strength=strength, glide=glide) for presses in (settled, None)
    )
    problems: list[str | None] = []
    for i, trip in enumerate(trips):
        try:
            _check_layout(trip)
            _check_presses(trip, settled[i], from_events, i)
            _check_end(trip, from_events, i)
            _check_outcome(trip, from_presses, i)
        except EpisodeError as error:
            problems.append(str(error))
        else:
            problems.append(None)
    return problems


def _check_layout(trip: Trip) -> None:
    for name in ("start", "goal"):
        if math.hypot(*getattr(trip, name)) > harbour.LAYOUT_RADIUS + 1e-3:
            raise EpisodeError(f"{name}: not within {harbour.LAYOUT_RADIUS:g} px of the harbour's centre")
    if math.dist(trip.start, trip.goal) < harbour.MIN_SEPARATION - 1e-3:
        raise EpisodeError(f"goal: not {harbour.MIN_SEPARATION:g} px from the start")


def _check_presses(trip: Trip, settled: Sequence[Press], played: Replay, row: int) -> None:
    times = [event.t for event in trip.events]
    if times != sorted(times):
        raise EpisodeError("events: times must not decrease")
    num = int(played.num_presses[row])
    if len(trip.presses) != num:
        raise EpisodeError(f"presses: {len(trip.presses)}, but the events give {num}")
    burnt = played.burnt[row].tolist()
    for i, (said, found) in enumerate(zip(trip.presses, settled[:num], strict=True)):
        errors = (said.start - found.start, said.duration - burnt[i])
        if said.key != found.key or max(map(abs, errors)) > _TOLERANCE:
            raise EpisodeError(f"presses.{i}: does not follow from the events")


def _check_outcome(trip: Trip, played: Replay, row: int) -> None:
    outcome = physics.OUTCOMES[int(played.outcome[row])]
    if outcome != trip.outcome:
        raise EpisodeError(f"outcome: {trip.outcome}, but the presses lead to {outcome}")


def _check_end(trip: Trip, played: Replay, row: int) -> None:
    if int(played.outcome[row]) == physics.SAILING:
        raise EpisodeError("outcome: the boat rests with fuel left, so the episode is not over")
    _check_outcome(trip, played, row)
    fuel = played.fuel[row] / physics.TANK
    score = harbour.score(played.outcome[row], fuel)
    end = math.dist(trip.end, (played.end_x[row].item(), played.end_y[row].item()))
    for name, error in (("fuel", trip.fuel - fuel.item()), ("score", trip.score - score.item()), ("end", end)):
        if abs(error) > _TOLERANCE:
            raise EpisodeError(f"{name}: does not follow from the presses")


def figures(episodes: Sequence[Episode], controller: str | None = None) -> dict[str, float]:
    """Return the mean figures of episodes, except practice, by the names of `hpamdp.env.boatdock.reference`.

    Args:
        episodes: episodes of one recording.
        controller: only count episodes with this controller. If None, with either.

    Raises:
        EpisodeError: no episode counts.
    """
    counted = [e for e in episodes if e.mode != PRACTICE and controller in (None, e.controller)]
    if not counted:
        raise EpisodeError(
            f"recording: has no episode{'' if controller is None else f' with the {controller} boat'} except practice"
        )
    num = len(counted)
    fractions = {
        name: sum(episode.outcome == name for episode in counted) / num
        for code, name in enumerate(physics.OUTCOMES)
        if code != physics.SAILING
    }
    return {
        "score": sum(episode.score for episode in counted) / num,
        **fractions,
        "steps": sum(len(episode.presses) for episode in counted) / num,
        "option_congruent": sum(episode.controller == "congruent" for episode in counted) / num,
    }
