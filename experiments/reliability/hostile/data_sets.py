"""Make files of played episodes and data sets with wrong lines, rows and values."""

from __future__ import annotations

import copy
import json
import os
import random
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import command_line
import torch

from hpamdp.data.demonstrations import Demonstrations
from hpamdp.data.human import played_file
from hpamdp.env.platform.environment import PlatformEnv

from .case import ACCEPTED, HARM, SILENT, Case

sys.path.insert(0, str(command_line.REPOSITORY / "tests"))
from play_players import docked  # episodes of a page's form

VALUES: list[Any] = [
    None, True, "3", "word", "", [], [1], {}, {"a": 1}, -1, 0, 1e308, -1e308, float("nan"), float("inf"), 10**30,
    [None], "x" * 10_000, [[[[[[]]]]]], "\u0000", "\ud800",
]  # fmt: skip
LINES = [
    b"", b"\n\n", b"{", b"}", b"[]", b"null", b"7", b'"episode"', b"\xff\xfe{\x00}\x00", b"\xef\xbb\xbf{}",
    b"\x00" * 100,
    b"[" * 5000 + b"]" * 5000, b'{"a":' * 5000 + b"1" + b"}" * 5000, b"NaN", b"{'a': 1}", b"not json", b"a" * 10**6,
    b'{"version": 1e400}', b"\r\n", b"// comment", b"<html>", b"\x1b[2J", b"1" * 5000,
]  # fmt: skip


def cases(number: int, seed: int) -> Iterator[Case]:
    """Yield `number` changed episodes, all wrong lines in all places, and `number` changed data sets."""
    chance = random.Random(seed)
    episodes = docked(6)
    for line in LINES:
        for place in ("first", "middle", "last", "last, without its end", "alone"):
            yield Case(
                "files of played episodes",
                f"{place}: {line[:30]!r}",
                _Lines(episodes, line, place),
                must_be_refused=False,
            )
    for _ in range(number):
        episode = copy.deepcopy(chance.choice(episodes))
        path = chance.choice([*_places(episode)])
        value = chance.choice([*VALUES, "missing"])
        _change(episode, path, value)
        text = json.dumps(episode).encode()
        name = f"{'.'.join(map(str, path))} is {str(value)[:40]!r}"
        yield Case("files of played episodes", name, _Lines(episodes, text, "middle"), must_be_refused=False)
    for cut in range(0, len(json.dumps(episodes[0])), 97):
        line = json.dumps(episodes[0]).encode()[:cut]
        yield Case("files of played episodes", f"cut after {cut} bytes", _Lines(episodes, line, "middle"), False)
    for path in ("/dev/null", "/dev/zero", "/dev/urandom", "fifo", "folder", "missing", "link to nothing", "no rights"):
        yield Case("paths of data", path, _Special(path))
    transitions = _transitions()
    leaves = [key for key in transitions.keys(True, True)]
    for _ in range(number):
        key = chance.choice(leaves)
        change = chance.choice(TENSOR_CHANGES)
        yield Case(
            "rows of data sets",
            f"{change}: {key}",
            _Rows(transitions, key, change),
            must_be_refused=change in WRONG and _matters(key, change),
        )


def _places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    if path:
        yield path
    for name, child in (
        value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    ):
        yield from _places(child, (*path, name))


def _change(value: Any, path: tuple[Any, ...], new: Any) -> None:
    for name in path[:-1]:
        value = value[name]
    if new == "missing":
        del value[path[-1]]
    else:
        value[path[-1]] = new


@dataclass(frozen=True)
class _Lines:
    """Read a file with one strange line; the right lines must be read, or the file refused."""

    episodes: list[dict]
    line: bytes
    place: str

    def __call__(self, folder: Path) -> str:
        right = [json.dumps(episode).encode() for episode in self.episodes]
        where = {"first": 0, "middle": 3}.get(self.place, len(right))
        lines = [self.line] if self.place == "alone" else [*right[:where], self.line, *right[where:]]
        file = folder / "played.jsonl"
        file.write_bytes(b"\n".join(lines) + (b"" if "without" in self.place else b"\n"))
        episodes, presses = played_file.read(file)
        if self.place != "alone" and not len(right) <= len(episodes) <= len(right) + 1:
            return f"{SILENT}: {len(episodes)} episodes of {len(right)}"
        numbers = presses["duration"]
        is_sane = bool(numbers.isfinite().all() and (numbers > 0).all() and (numbers < 60).all())
        return ACCEPTED if is_sane else f"{SILENT}: durations that nobody pressed"


@dataclass(frozen=True)
class _Special:
    """Read from a path that is not a file of episodes."""

    path: str

    def __call__(self, folder: Path) -> str:
        path = folder / self.path.replace(" ", "_")
        if self.path.startswith("/"):
            path = folder / "played.jsonl"
            path.symlink_to(self.path)
        elif self.path == "fifo":
            os.mkfifo(path)
        elif self.path == "folder":
            path.mkdir()
        elif self.path.startswith("link"):
            path.symlink_to(folder / "nowhere")
        elif self.path == "no rights":
            path.write_text("{}")
            path.chmod(0)
        played_file.read(path)
        return ACCEPTED


TENSOR_CHANGES = [
    "NaN",
    "infinity",
    "1e6",
    "-1e6",
    "too large a number",
    "negative",
    "another dtype",
    "one column more",
]
WRONG = {"NaN", "infinity", "too large a number", "negative"}


def _transitions() -> Any:
    env = PlatformEnv(num_envs=1, seed=0)
    played = env.rollout(40, break_when_any_done=False).squeeze(0)
    from hpamdp.env.decisions import with_decisions

    tracked = with_decisions(PlatformEnv(num_envs=1, seed=0))
    played = tracked.rollout(40, break_when_any_done=False).squeeze(0)
    played["collector", "traj_ids"] = played["next", "done"].squeeze(-1).long().cumsum(0)
    return played


def _matters(key: Any, change: str) -> bool:
    names = ("observation", "discrete", "parameters", "reward")
    is_read = (key if isinstance(key, str) else key[-1]) in names
    if change in ("too large a number", "negative"):
        return is_read and key == ("action", "discrete")
    return is_read


@dataclass(frozen=True)
class _Rows:
    """Make a data set of transitions with one changed value."""

    transitions: Any
    key: Any
    change: str

    def __call__(self, folder: Path) -> str:
        rows = self.transitions.clone()
        value = rows[self.key].clone()
        flat = value.view(-1)
        numbers = {
            "NaN": float("nan"), "infinity": float("inf"), "1e6": 1e6, "-1e6": -1e6, "too large a number": 99,
            "negative": -1,
        }  # fmt: skip
        if self.change in numbers:
            if not value.is_floating_point() and abs(numbers[self.change]) not in (99, 1, 1e6):
                return f"{ACCEPTED}: does not apply"
            flat[len(flat) // 2] = numbers[self.change]
        elif self.change == "another dtype":
            value = value.to(torch.float64 if value.dtype != torch.float64 else torch.int32)
        elif self.change == "one column more":
            value = torch.cat([value, value], -1) if value.ndim > 1 else torch.stack([value, value], -1)
        rows[self.key] = value
        data = Demonstrations(rows)
        if not data.batch["next", "reward"].isfinite().all():
            return f"{HARM}: rewards are not finite"
        return ACCEPTED
