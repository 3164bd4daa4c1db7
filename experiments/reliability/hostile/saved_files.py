"""Make hostile checkpoints and policies: wrong contents with right checksums, code, and links."""

from __future__ import annotations

import copy
import os
import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import command_line
import torch

from hpamdp.config.outside_jobs import composed
from hpamdp.run import train
from hpamdp.run.state_file import StateFile, write

from .case import ACCEPTED, HARM, SILENT, TRACEBACK, Case

SMALL = ["num_envs=8", "steps_per_batch=4", "eval.layouts=4", "eval.every=0", "film=false", "log_every=64"]
AGENTS = {
    "linucb_hppo": ["high=linucb", "low=hppo", "low.minibatch_size=16"],
    "ucb_pdqn": ["high=ucb", "low=pdqn", "low.warmup_steps=64", "low.batch_size=16", "low.hidden_dims=[16]"],
    "actor_hyar": [
        *("high=actor", "low=hyar", "low.warmup_steps=64", "low.codec_pretrain_updates=2", "low.batch_size=16"),
        *("low.updates_per_step=0.05", "high.minibatch_size=32"),
    ],
    "meta_critic_qpamdp": [
        *("high=meta_critic", "low=qpamdp", "low.warmup_steps=32", "low.initial_episodes=8"),
        *("low.relearning_episodes=8", "low.rollouts=8", "high.warmup_decisions=16", "high.batch_size=16"),
    ],
}
SECRET = "hpamdp-hostile-secret"
# Files that a run writes; in somebody else's folder, each could be a link to another place.
WRITTEN = (
    *("summary.json", "config.yaml", "metrics.csv", "metrics.csv.previous", "metrics.csv.draft", "evaluation.npz"),
    *("checkpoint.safetensors", "policy.safetensors", "checkpoint.diverged.safetensors"),
    *("episodes.gif", "trajectories.png", "learning.png"),
    *(".lock", "error.txt", "run.log", ".hydra/config.yaml", ".hydra/hydra.yaml", ".hydra/overrides.yaml"),
)
Members = dict[str, Any]


def train_agents(folder: Path) -> dict[str, Path]:
    """Train a small agent of each kind, and return the folders."""
    folders = {}
    for name, words in AGENTS.items():
        folders[name] = folder / name
        with composed([*SMALL, *words, "total_frames=256"]) as cfg:
            assert train.run(cfg, folders[name], [*SMALL, *words]) == 0
    return folders


def cases(agents: dict[str, Path], number: int, seed: int) -> Iterator[Case]:
    """Yield `number` cases of changed contents, and all other cases."""
    chance = random.Random(seed)
    members = {name: _members(folder / "checkpoint.safetensors") for name, folder in agents.items()}
    yield from _changed_contents(agents, members, number, chance)
    yield from _code(agents)
    yield from _links(agents)


def _members(file: Path) -> Members:
    opened = StateFile(file)
    return {name: opened.read(name) for name in opened.names}


# Each function returns the new value, or raises LookupError if the change does not apply to the value.
def _shaped(value: Any, change: Callable[[torch.Tensor], Any]) -> Any:
    if not isinstance(value, torch.Tensor):
        raise LookupError
    return change(value)


def _spoiled(value: torch.Tensor, number: float) -> torch.Tensor:
    if not value.is_floating_point() or value.numel() == 0:
        raise LookupError
    spoiled = value.clone()
    spoiled.view(-1)[0] = number
    return spoiled


def _of_another_dtype(value: torch.Tensor) -> torch.Tensor:
    return value.to(torch.int32 if value.dtype == torch.float64 else torch.float64)


def _of_number(value: Any, new: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise LookupError
    return new


def _other(value: Any, new: Any) -> Any:
    if type(value) is type(new) or (isinstance(value, torch.Tensor) and isinstance(new, torch.Tensor)):
        raise LookupError
    return new


# Name, change, and whether a program that accepts the change computes with wrong values.
CHANGES: list[tuple[str, Callable[[Any], Any], bool]] = [
    ("a tensor holds NaN", lambda v: _shaped(v, lambda t: _spoiled(t, float("nan"))), True),
    ("a tensor holds infinity", lambda v: _shaped(v, lambda t: _spoiled(t, float("inf"))), True),
    ("a tensor has another dimension", lambda v: _shaped(v, lambda t: t.unsqueeze(0)), True),
    ("a tensor is longer", lambda v: _shaped(v, lambda t: torch.cat([t.reshape(-1), t.new_zeros(3)])), True),
    ("a tensor is empty", lambda v: _shaped(v, lambda t: t.reshape(-1)[:0].clone()), True),
    ("a tensor has another dtype", lambda v: _shaped(v, _of_another_dtype), True),
    ("a tensor is complex", lambda v: _shaped(v, lambda t: t.to(torch.complex64)), True),
    ("a tensor is a list", lambda v: _shaped(v, lambda t: t.reshape(-1)[:5].tolist()), True),
    ("a tensor is None", lambda v: _shaped(v, lambda t: None), True),
    ("a tensor is a word", lambda v: _shaped(v, lambda t: "weights"), True),
    ("a number is NaN", lambda v: _of_number(v, float("nan")), True),
    ("a number is minus infinity", lambda v: _of_number(v, float("-inf")), True),
    ("a number is a word", lambda v: _of_number(v, "seven"), True),
    ("a number is a list", lambda v: _of_number(v, [1, 2]), True),
    ("a number is negative", lambda v: _of_number(v, -7), False),
    ("a number is huge", lambda v: _of_number(v, 10**30), False),
    ("an entry is None", lambda v: _other(v, None), True),
    ("an entry is a list", lambda v: _other(v, [[]]), True),
    ("an entry is a mapping", lambda v: _other(v, {"a": {"b": 1}}), True),
    ("an entry is a tensor", lambda v: _other(v, torch.zeros(2, 3)), True),
    ("an entry is nested deeply", lambda v: _nested(400), True),
]  # fmt: skip


def _nested(depth: int) -> Any:
    value: Any = 1
    for _ in range(depth):
        value = [value]
    return value


def _places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    if path:
        yield path
    items: Any = ()
    if isinstance(value, dict):
        items = value.items()
    elif isinstance(value, list | tuple):
        items = enumerate(value)
    for name, child in items:
        yield from _places(child, (*path, name))


def _changed(value: Any, path: tuple[Any, ...], change: Callable[[Any], Any]) -> Any:
    """Return a copy in which `change` is applied to the value at a path."""
    if not path:
        return change(value)
    if isinstance(value, tuple):
        return tuple(_changed(list(value), path, change))
    new = copy.copy(value)
    new[path[0]] = _changed(value[path[0]], path[1:], change)
    return new


def _changed_contents(
    agents: dict[str, Path], members: dict[str, Members], number: int, chance: random.Random
) -> Iterator[Case]:
    """Yield resumptions and evaluations of checkpoints with one changed or missing entry."""
    made = 0
    while made < number:
        agent = chance.choice([*agents])
        member = chance.choice([*members[agent], "progress", "recorder", "rng", "collection"])
        if member == "format":
            continue
        path = chance.choice([*_places(members[agent][member])])
        if member == "progress" and path[:1] == ("config",):
            continue  # the config has separate cases
        name, change, is_wrong = chance.choice([*CHANGES, ("an entry is missing", _delete, False)])
        try:
            if change is _delete:
                state = _without(members[agent][member], path)
            else:
                state = _changed(members[agent][member], path, change)
        except LookupError:
            continue
        made += 1
        # An evaluation may ignore entries that only training needs.
        way = chance.choice(["resume", "resume", "resume", "checkpoint"])
        is_wrong = is_wrong and (way == "resume" or member == "agent")
        where = ".".join(map(str, (member, *path)))
        yield Case(
            "contents of a checkpoint",
            f"{agent}, {way}: {name}: {where}",
            _Resume(agents[agent], way, {**members[agent], member: state}),
            must_be_refused=is_wrong,
        )


def _delete(value: Any) -> Any:
    raise AssertionError("stands for a missing entry")


def _without(value: Any, path: tuple[Any, ...]) -> Any:
    new = list(value) if isinstance(value, tuple) else copy.copy(value)
    if len(path) == 1:
        del new[path[0]]
    else:
        new[path[0]] = _without(value[path[0]], path[1:])
    return new


@dataclass(frozen=True)
class _Resume:
    """Resume or evaluate changed contents."""

    agent: Path
    way: str
    members: Members

    def __call__(self, folder: Path) -> str:
        write(folder / "checkpoint.safetensors", self.members)
        words = [f"{self.way}={folder / 'checkpoint.safetensors'}", "eval.layouts=2", "total_frames=320"]
        if self.way == "checkpoint":
            words = ["mode=eval", *words[:2]]
        with composed(words) as cfg:
            code = train.run(cfg, folder / "out", words)
        if code:
            return f"{SILENT}: exit code {code}"
        summary = (folder / "out" / "summary.json").read_text()
        return f"{SILENT}: the summary has NaN" if "NaN" in summary or "Infinity" in summary else ACCEPTED


CODE = {
    "entry_point": "canary:build",
    "id": "canary:Canary-v0",
    "_target_": "canary.Canary",
    "kwargs": {"_target_": "canary.Canary"},
}


def _code(agents: dict[str, Path]) -> Iterator[Case]:
    """Yield files whose config names code, secrets or other files, for every way to open them."""
    changes = [*_strange_groups(), *_strange_settings()]
    ways = [
        (way, name)
        for way in ("eval", "watch", "low.checkpoint")
        for name in ("checkpoint.safetensors", "policy.safetensors")
    ]
    for what, change in changes:
        for way, name in [*ways, ("resume", "checkpoint.safetensors")]:
            yield Case(
                "code and secrets in a config",
                f"{way} {name}: {what}",
                _OpenConfig(agents["linucb_hppo"], way, name, change),
                must_be_refused=False,
            )


Change = tuple[str, Callable[[dict], None]]
NAMES: list[Any] = [
    "../../canary", "/tmp/canary", "canary", "", 7, None, ["hppo"], "hppo ", "hppo/../hppo", "x" * 300,
]  # fmt: skip
TEXTS = ("${oc.env:SECRET}", "${oc.env:NOTHING}", "${env}", "???", "${", "${oc.decode:1}", "$SECRET")


def _strange_groups() -> Iterator[Change]:
    """Yield changes of each group of the config."""
    for group in ("env", "high", "low", "logger", "collector", "data"):
        for setting, value in CODE.items():
            yield f"{group}.{setting}={value}", _setting(group, setting, value)
        yield f"{group} is a word", lambda config, group=group: config.update({group: "canary:build"})
        yield f"{group} is nothing", lambda config, group=group: config.pop(group)
        for name in NAMES:
            yield f"{group} chooses {name!r}", _choice(group, name)
        for text in TEXTS:
            yield f"{group} holds {text}", _setting(group, "note", text)


def _strange_settings() -> Iterator[Change]:
    """Yield changes of single settings."""
    yield "gymnasium by entry point", _gymnasium(entry_point="canary:build")
    yield "gymnasium by id", _gymnasium(id="canary:Canary-v0")
    yield "gymnasium by id and kwargs", _gymnasium(id="CartPole-v1", kwargs={"render_mode": "human"})
    for text in ("${oc.env:SECRET}", "${seed}", "${oc.env:SECRET,x}"):
        for key in ("seed", "device", "checkpoint", "update_precision"):
            yield f"{key}={text}", lambda config, key=key, text=text: config.update({key: text})
    named = {"congruent": {"name": "hppo", **CODE}}
    yield "low.per_option names code", _setting("low", "per_option", named)
    yield "low.per_option names a path", _setting("low", "per_option", {"congruent": "../../canary"})
    yield "low.checkpoint names a file", _setting("low", "checkpoint", "/etc/passwd")


def _choice(group: str, name: Any) -> Callable[[dict], None]:
    return lambda config: config["choices"].update({group: name})


def _setting(group: str, setting: str, value: Any) -> Callable[[dict], None]:
    return lambda config: config[group].update({setting: value})


def _gymnasium(**settings: Any) -> Callable[[dict], None]:
    def change(config: dict) -> None:
        _choice("env", "gymnasium")(config)
        _choice("high", "none")(config)
        config["env"] = {"max_steps": 5, **settings}

    return change


CANARY = """\
from pathlib import Path
Path({file!r}).write_text("executed")
class Canary:
    def __init__(self, *args, **kwargs): pass
def build(*args, **kwargs): return Canary()
"""


@dataclass(frozen=True)
class _OpenConfig:
    """Open a file with a changed config. Nothing that it names may run, and no secret may be written."""

    agent: Path
    way: str
    name: str
    change: Callable[[dict], None]

    def __call__(self, folder: Path) -> str:
        (folder / "run").mkdir()
        (folder / "run" / "canary.py").write_text(CANARY.replace("{file!r}", repr(str(folder / "executed"))))
        os.environ["SECRET"] = SECRET
        file = folder / self.name
        members = _members(self.agent / self.name)
        self.change(members["progress"]["config"])
        write(file, members)
        words = {
            "eval": ["mode=eval", f"checkpoint={file}", "eval.layouts=2"],
            "resume": [f"resume={file}", "total_frames=320", "eval.layouts=2"],
            "watch": ["watch", str(file), "--episodes", "1", "--size", "40"],
            "low.checkpoint": [
                *("high=ucb", "low=hppo", "low.minibatch_size=16", f"low.checkpoint={file}", "total_frames=64"),
                *SMALL,
            ],
        }[self.way]
        ending = command_line.run(words, folder / "run")
        if (folder / "executed").exists():
            return f"{HARM}: code was executed"
        for written in folder.rglob("*"):
            if written.is_file() and written != file and SECRET.encode() in written.read_bytes():
                return f"{HARM}: the secret is in {written.relative_to(folder)}"
        if any("Traceback" in line for line in ending.errors):
            return f"{TRACEBACK}: {ending.errors[-1][:150]}"
        if ending.code not in (0, 2):
            return f"{SILENT}: exit code {ending.code}: {ending.errors[-1:]}"
        return ACCEPTED


def _links(agents: dict[str, Path]) -> Iterator[Case]:
    """Yield runs in folders in which a file is a symbolic or hard link to another place."""
    for name in WRITTEN:
        for way in ("resume", "overwrite"):
            for link in ("symbolic", "hard"):
                yield Case(
                    "links in a folder",
                    f"{way}: {link} link {name}",
                    _Linked(agents["linucb_hppo"], name, way, link),
                    must_be_refused=False,
                )


@dataclass(frozen=True)
class _Linked:
    """Run in a folder with a link to a file in another place, which must not change."""

    agent: Path
    name: str
    way: str
    link: str

    def __call__(self, folder: Path) -> str:
        here = folder / "theirs"
        here.mkdir()
        outside = folder / "outside"
        original = self.agent / self.name
        content = original.read_bytes() if original.is_file() else b"precious"
        outside.write_bytes(content)
        for file in self.agent.iterdir():
            if file.is_file() and file.name != self.name:
                (here / file.name).write_bytes(file.read_bytes())
        linked = here / self.name
        linked.parent.mkdir(exist_ok=True)
        (linked.symlink_to if self.link == "symbolic" else linked.hardlink_to)(outside)
        if self.way == "resume":
            words = [f"resume={here}", "total_frames=320"]
        else:
            words = [*SMALL, *AGENTS["linucb_hppo"], "total_frames=64", "overwrite=true"]
        ending = command_line.run([*words, "eval.layouts=2", f"hydra.run.dir={here}"], folder / "run")
        if outside.read_bytes() != content:
            return f"{HARM}: a file outside of the folder was overwritten"
        if any("Traceback" in line for line in ending.errors):
            return f"{TRACEBACK}: {ending.errors[-1][:150]}"
        return ACCEPTED
