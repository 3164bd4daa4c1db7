"""The episodes that people played on the page: their schema, their check, and the file that keeps them.

A file has one JSON object a line, in the order in which the episodes arrived. `docs/play.md` explains the fields; the
models below are the schema. There is no personal data in it: a player is a random number that a page draws anew.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import from_json  # refuses deep nesting by itself, where json runs into Python's recursion limit
from torch import Tensor

from hpamdp.env.boatdock import harbour, physics
from hpamdp.env.boatdock.episode import MAX_PRESSES
from hpamdp.env.boatdock.play.replay import HELD, Press, Replay, replay, settle
from hpamdp.env.page import EpisodeError

FORMAT = 1
PRACTICE = "practice"
# How far what the page says may lie from what its presses come to: px, s, fractions of the fuel.
_TOLERANCE = 1e-6
_LONGEST = 3600.0  # s; nobody sails for an hour
_MAX_EVENTS = 2000
_MAX_BYTES = 256 * 2**20

Seconds = Annotated[float, Field(ge=0.0, le=_LONGEST)]
Key = Annotated[int, Field(ge=0, lt=harbour.NUM_KEYS)]
Point = tuple[float, float]

_STRICT = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)


class RawEvent(BaseModel):
    """A key event as the browser had it."""

    model_config = _STRICT

    t: Seconds
    type: Literal["down", "up", "blur"]
    key: Annotated[int, Field(ge=-1, lt=harbour.NUM_KEYS)]
    code: Annotated[str, Field(max_length=24, pattern="^[A-Za-z0-9]*$")]


class SettledPress(BaseModel):
    """A press as the game had it."""

    model_config = _STRICT

    key: Key
    start: Seconds
    duration: Annotated[float, Field(gt=0.0, le=physics.TANK)]


class Episode(BaseModel):
    """One line of the file; lengths in px from the harbour's centre (y down), times in s since the boat was chosen."""

    model_config = _STRICT

    format: Literal[1]
    software: Annotated[str, Field(max_length=32, pattern=r"^[\w.+-]+$")]
    consent: Literal[True]
    player: Annotated[str, Field(pattern="^[0-9a-f]{16}$")]
    index: Annotated[int, Field(ge=0, lt=1_000_000)]
    mode: Literal["practice", "round", "free"]
    keymap: Literal[1, 2]
    controller: Literal["incongruent", "congruent"]
    start: Point
    goal: Point
    events: Annotated[list[RawEvent], Field(min_length=1, max_length=_MAX_EVENTS)]
    presses: Annotated[list[SettledPress], Field(min_length=1, max_length=MAX_PRESSES)]
    outcome: Literal["success", "too_fast", "out_of_bounds", "out_of_fuel", "time_limit"]
    fuel: Annotated[float, Field(ge=0.0, le=1.0)]
    score: Annotated[float, Field(ge=-1.0, le=5.0)]
    end: Point
    resolution: Annotated[float, Field(ge=0.0, le=1.0)]


class Sailed(NamedTuple):
    """Episodes with what their presses come to.

    Attributes:
        episodes: as they were read.
        replay: of their presses.
    """

    episodes: list[Episode]
    replay: Replay


def check(value: object) -> Episode:
    """Return an episode if it is one, and if its events come to its presses, and these to its end.

    Raises:
        EpisodeError: with what is wrong, in one line.
    """
    episode = _parse(value)
    _check_layout(episode)
    times = [event.t for event in episode.events]
    if times != sorted(times):
        raise EpisodeError("events: their times go back")
    settled = settle((event.t, event.type, event.key) for event in episode.events)
    played = sail([episode], [settled])
    _check_presses(episode, settled, played)
    _check_end(episode, played)
    return episode


def sail(episodes: Sequence[Episode], presses: Sequence[Sequence[Press | SettledPress]] | None = None) -> Replay:
    """Sail episodes from their presses, or from others."""
    rows = [episode.presses for episode in episodes] if presses is None else presses
    num, longest = len(episodes), max(map(len, rows), default=0)
    keys = torch.zeros(num, longest, dtype=torch.long)
    starts = torch.full((num, longest), HELD, dtype=torch.float64)
    durations = torch.zeros(num, longest, dtype=torch.float64)
    for i, row in enumerate(rows):
        for j, press in enumerate(row):
            keys[i, j], starts[i, j], durations[i, j] = press.key, press.start, press.duration
    start, goal = (_points([getattr(episode, name) for episode in episodes]) for name in ("start", "goal"))
    return replay(start, goal, direction_rows(episodes), keys, starts, durations)


def direction_rows(episodes: Sequence[Episode]) -> Tensor:
    """Return the rows of `harbour.DIRECTIONS` with the keys of the episodes' boats, int64 `[E]`."""
    return torch.tensor([2 if e.controller == "congruent" else e.keymap - 1 for e in episodes], dtype=torch.long)


def read(path: Path) -> list[Episode]:
    """Read a file of episodes and check its schema, line by line; a last line that was cut short is left out.

    Raises:
        EpisodeError: the file is missing, or a line is no episode.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise EpisodeError(f"{path}: larger than {_MAX_BYTES // 2**20} MB")
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise EpisodeError(f"{path}: there is no such file; `hpamdp play` writes one") from error
    except (OSError, UnicodeDecodeError) as error:
        raise EpisodeError(f"{path}: cannot be read ({type(error).__name__})") from error
    lines = text.split("\n")
    complete, rest = lines[:-1], lines[-1]
    episodes = []
    for number, line in enumerate([*complete, rest] if _is_json(rest) else complete, 1):
        if not line.strip():
            continue
        try:
            episodes.append(_parse(from_json(line)))
        except ValueError as error:
            what = error if isinstance(error, EpisodeError) else "no JSON"
            raise EpisodeError(f"{path}, line {number}: {what}") from error
    return episodes


def _is_json(text: str) -> bool:
    try:
        from_json(text)
    except ValueError:
        return False
    return True


def _parse(value: object) -> Episode:
    try:
        # As JSON, in which the strict mode takes a list for a tuple.
        return Episode.model_validate_json(json.dumps(value, allow_nan=False))
    except ValidationError as error:
        wrong = error.errors(include_url=False, include_input=False, include_context=False)[0]
        where = ".".join(map(str, wrong["loc"])) or "episode"
        raise EpisodeError(f"{where[:80]}: {wrong['msg']}") from error
    except (ValueError, TypeError) as error:
        raise EpisodeError("episode: no JSON object") from error


def _points(points: Sequence[Point]) -> Tensor:
    return torch.tensor(points, dtype=torch.float64).reshape(-1, 2)


def _check_layout(episode: Episode) -> None:
    for name in ("start", "goal"):
        if math.hypot(*getattr(episode, name)) > harbour.LAYOUT_RADIUS + 1e-3:
            raise EpisodeError(f"{name}: not within {harbour.LAYOUT_RADIUS:g} px of the harbour's centre")
    if math.dist(episode.start, episode.goal) < harbour.MIN_SEPARATION - 1e-3:
        raise EpisodeError(f"goal: not {harbour.MIN_SEPARATION:g} px from the start")


def _check_presses(episode: Episode, settled: Sequence[Press], played: Replay) -> None:
    num = int(played.num_presses)
    if len(episode.presses) != num:
        raise EpisodeError(f"presses: {len(episode.presses)}, but the events come to {num}")
    for i, (said, found) in enumerate(zip(episode.presses, settled[:num], strict=True)):
        errors = (said.start - found.start, said.duration - played.burnt[0, i].item())
        if said.key != found.key or max(map(abs, errors)) > _TOLERANCE:
            raise EpisodeError(f"presses.{i}: not what the events come to")


def _check_end(episode: Episode, played: Replay) -> None:
    outcome = physics.OUTCOMES[int(played.outcome)]
    if outcome == physics.OUTCOMES[physics.SAILING]:
        raise EpisodeError("outcome: the boat rests with fuel left, so the episode is not over")
    if outcome != episode.outcome:
        raise EpisodeError(f"outcome: {episode.outcome}, but the presses come to {outcome}")
    fuel = played.fuel[0] / physics.TANK
    score = harbour.score(played.outcome, fuel)
    end = math.dist(episode.end, (played.end_x.item(), played.end_y.item()))
    for name, error in (("fuel", episode.fuel - fuel.item()), ("score", episode.score - score.item()), ("end", end)):
        if abs(error) > _TOLERANCE:
            raise EpisodeError(f"{name}: not what the presses come to")


def figures(episodes: Sequence[Episode], controller: str | None = None) -> dict[str, float]:
    """Return the mean figures of episodes, without those of practice, by the names of `hpamdp.env.boatdock.reference`.

    Args:
        episodes: of one recording.
        controller: only episodes with this one; None: with either.

    Raises:
        EpisodeError: there is none.
    """
    counted = [e for e in episodes if e.mode != PRACTICE and controller in (None, e.controller)]
    if not counted:
        raise EpisodeError(
            f"recording: no episode{'' if controller is None else f' with the {controller} boat'}, practice aside"
        )
    num = len(counted)
    shares = {
        name: sum(episode.outcome == name for episode in counted) / num
        for code, name in enumerate(physics.OUTCOMES)
        if code != physics.SAILING
    }
    return {
        "score": sum(episode.score for episode in counted) / num,
        **shares,
        "steps": sum(len(episode.presses) for episode in counted) / num,
        "option_congruent": sum(episode.controller == "congruent" for episode in counted) / num,
    }
