"""A run on disk: everything that is needed to continue it or to score its agent.

A checkpoint is a zip archive: `manifest.json` with the run's progress and the checksums of the other members, and one
member for each component, written by `torch.save` and read with `weights_only`, so that opening somebody else's file
runs none of its code. TorchRL's `Checkpoint` is not used: it reads a replay buffer's prefetch queue with pickle, stores
replay buffers at full capacity, and moves the old file away before the new one is in place.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import pickle
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.checkpoint import GlobalRNGState
from torchrl.data import ReplayBuffer

from hpamdp.config import ConfigError
from hpamdp.files import replacing
from hpamdp.messages import first_line, one_line, warn
from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.policies.base import Learner
from hpamdp.run.folder import CHECKPOINT_NAME as FILE_NAME
from hpamdp.run.folder import POLICY_NAME

_FORMAT = 2
_MANIFEST = "manifest.json"
# Parts of a run that are saved beside the agent.
STATES = ("collection", "recorder")
# What can be wrong with the bytes of a file.
_DAMAGE = (
    zipfile.BadZipFile,
    zlib.error,
    pickle.UnpicklingError,
    json.JSONDecodeError,
    UnicodeDecodeError,
    EOFError,
    OSError,
    KeyError,
    TypeError,
    AttributeError,
    NotImplementedError,
    ValueError,
    RuntimeError,
)


def find(path: str | Path, where: str) -> Path:
    """Return the file of a checkpoint.

    A folder without a checkpoint may hold the networks alone, which suffice for everything but to resume the run.

    Args:
        path: the file itself or the output folder of its run.
        where: the setting that gave the path, to name in an error.

    Raises:
        ConfigError: there is no checkpoint.
    """
    path = Path(os.path.expanduser(path))  # `Path` takes "./" away, with which ~ is a name
    is_folder = os.path.isdir(path)  # unlike `Path.is_dir` for any text
    file = path / FILE_NAME if is_folder else path
    if where != "resume" and is_folder and not file.is_file() and (path / POLICY_NAME).is_file():
        file = path / POLICY_NAME
    if not os.path.isfile(file):
        has_policy = os.path.isfile(path / POLICY_NAME)
        why = "networks alone, which cannot be resumed" if has_policy else "no checkpoint there"
        raise ConfigError(f"{where}={path}: {why}; give a run's output folder or its {FILE_NAME}")
    if not zipfile.is_zipfile(file):
        raise ConfigError(f"{where}={file}: not a checkpoint of this program")
    return file


@dataclass(frozen=True)
class Saved:
    """What `load` returns; the agent itself is filled in place.

    Attributes:
        progress: JSON values that `save` was given.
        states: of the other parts of the run, by name, as `save` was given them.
        generators: the states of the random generators, for `set_generators`.
    """

    progress: dict[str, Any]
    states: dict[str, dict[str, Any]]
    generators: dict[str, Any]


def save(
    path: Path,
    agent: HierarchicalAgent,
    states: Mapping[str, Mapping[str, Any]],
    progress: Mapping[str, Any],
    *,
    with_replay: bool = True,
) -> None:
    """Write the agent, its optimizers and replay, the states of other parts and the random generators.

    Args:
        path: the file.
        agent: the agent.
        states: of the other parts of the run, by name: nested dictionaries of tensors and numbers.
        progress: JSON values to read back with `progress_of`: the config, the frames so far.
        with_replay: whether replay buffers are stored; without them a resumed run begins with empty ones.

    Raises:
        OSError: the disk is full, or the folder is gone or cannot be written to; the old file stays as it is.
    """
    members: dict[str, Any] = {"agent": agent.state_dict(), "rng": GlobalRNGState().state_dict(), **states}
    for name, part in agent.stateful().items():
        if isinstance(part, ReplayBuffer):
            if with_replay:
                members[name] = _replay_state(part)
        else:
            members[name] = part.state_dict()
    checksums = {}
    with replacing(path) as partial, zipfile.ZipFile(partial, "w", zipfile.ZIP_STORED) as archive:
        for name, state in members.items():
            data = _packed(state)
            checksums[name] = hashlib.sha256(data).hexdigest()
            archive.writestr(f"{name}.pt", data)
        manifest = {"format": _FORMAT, "members": checksums, "progress": dict(progress)}
        archive.writestr(_MANIFEST, json.dumps(manifest))


def save_policy(path: Path, agent: HierarchicalAgent, progress: Mapping[str, Any]) -> None:
    """Write the networks alone, without what only training needs; `mode=eval` can load it.

    Raises:
        OSError: as `save`.
    """
    with replacing(path) as partial:
        torch.save({"format": _FORMAT, "progress": json.dumps(dict(progress)), "agent": agent.state_dict()}, partial)


def progress_of(file: Path) -> dict[str, Any]:
    """Return what `save` was given as `progress`.

    Raises:
        ConfigError: the file is damaged or not a checkpoint of this program.
    """
    return _read(file, set())[0]


def load_learners(file: Path, agent: HierarchicalAgent, device: torch.device) -> None:
    """Fill the agent's learners from another run's checkpoint, but neither their optimizers, replay nor `progress`.

    Raises:
        ConfigError: the checkpoint is damaged or of other learners.
    """
    _, members = _read(file, {"agent"}, device)
    prefix = "learners."
    own = {name.removeprefix(prefix): value for name, value in members["agent"].items() if name.startswith(prefix)}
    saved_num, num = len({name.partition(".")[0] for name in own}), len(agent.learners)
    if own and saved_num != num:
        learners = "learner" if saved_num == 1 else "learners"
        raise ConfigError(f"low.checkpoint={file}: it holds {saved_num} {learners}, but this agent has {num}")
    try:
        for i, learner in enumerate(agent.learners):
            assert isinstance(learner, Learner)
            start = f"{i}."
            learner.load_networks({name.removeprefix(start): own[name] for name in own if name.startswith(start)})
    except (RuntimeError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise ConfigError(f"low.checkpoint={file}: of another class or size than low: {_misfit(error)}") from error


def load(file: Path, agent: HierarchicalAgent, device: torch.device, *, with_training: bool) -> Saved:
    """Fill the agent from a checkpoint, with training also its optimizers and replay.

    Nothing is changed before the whole file was read and checked. The random generators are left to `set_generators`.

    Raises:
        ConfigError: the checkpoint is damaged or of another agent.
    """
    stateful = agent.stateful()
    progress, members = _read(file, None if with_training else {"agent", *STATES}, device)
    replays = {name for name, part in stateful.items() if isinstance(part, ReplayBuffer)}
    missing = {"agent", "rng", *STATES, *stateful} - replays - set(members) if with_training else set()
    if missing:
        raise ConfigError(f"{file}: does not fit this agent: it lacks {', '.join(sorted(missing))}")
    try:
        agent.load_state_dict(members["agent"])
        if with_training:
            for name, part in stateful.items():
                if name in replays:
                    _fill_replay(part, members.get(name))
                else:
                    part.load_state_dict(members[name])
    except (RuntimeError, KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise ConfigError(f"{file}: does not fit this agent, whose sizes env sets: {_misfit(error)}") from error
    return Saved(progress, {name: members.get(name, {}) for name in STATES}, members.get("rng", {}))


def _misfit(error: Exception) -> str:
    """Return the beginning of what torch says when weights do not fit, without its heading."""
    return f"{one_line(error).partition('state_dict for ')[2].partition(': ')[2] or one_line(error):.160}"


def _packed(state: object) -> bytes:
    stream = io.BytesIO()
    torch.save(state, stream)
    return stream.getvalue()


def _read(
    file: Path, wanted: set[str] | None, device: torch.device | None = None
) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """Return the progress and the wanted members that are there, None: all; check every byte that is used."""
    try:
        with zipfile.ZipFile(file) as archive:
            if _MANIFEST not in archive.namelist():
                return _read_policy(file, device)
            manifest = json.loads(archive.read(_MANIFEST))
            _check_format(manifest["format"])
            members = {}
            names = set(manifest["members"])
            for name in sorted(names if wanted is None else wanted & names):
                data = archive.read(f"{name}.pt")
                if hashlib.sha256(data).hexdigest() != manifest["members"][name]:
                    raise ValueError(f"the checksum of {name} is wrong")
                members[name] = torch.load(io.BytesIO(data), map_location=device, weights_only=True)
            progress = dict(manifest["progress"])
            _check_progress(progress)
    except _DAMAGE as error:
        raise ConfigError(
            f"{file}: damaged, or not a checkpoint of this program ({type(error).__name__}: {first_line(error):.120})"
        ) from error
    _check_weights(file, members.get("agent", {}))
    return progress, members


def _read_policy(file: Path, device: torch.device | None) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """Read what `save_policy` wrote."""
    saved = torch.load(file, map_location=device, weights_only=True)
    _check_format(saved["format"])
    progress = json.loads(saved["progress"])
    _check_progress(progress)
    _check_weights(file, saved["agent"])
    return progress, {"agent": saved["agent"]}


def _check_format(number: int) -> None:
    if number != _FORMAT:
        raise ValueError(f"format {number}, but this version reads {_FORMAT}")


def _check_progress(progress: Mapping[str, Any]) -> None:
    if not isinstance(progress["config"], Mapping):
        raise TypeError("the config is no mapping")


def _check_weights(file: Path, state: Mapping[str, Any]) -> None:
    for name, value in state.items():
        if isinstance(value, Tensor) and value.is_floating_point() and value.isnan().any():
            raise ConfigError(f"{file}: {name} holds NaN; take an earlier checkpoint")


def _replay_state(buffer: ReplayBuffer) -> dict[str, Any]:
    """Return the filled rows of a buffer and the place of the next one."""
    rows = buffer[:].clone().to_dict() if len(buffer) else {}
    return {"rows": rows, "num_rows": len(buffer), "writer": dict(buffer._writer.state_dict())}


def _fill_replay(buffer: ReplayBuffer, state: Mapping[str, Any] | None) -> None:
    if state is None:
        warn("the checkpoint holds no replay (checkpoint_replay=false); the learner begins with an empty one")
        return
    if state["num_rows"]:
        buffer.extend(TensorDict(state["rows"], batch_size=[state["num_rows"]]))
    buffer._writer.load_state_dict(state["writer"])


def set_generators(state: Mapping[str, Any]) -> None:
    """Restore the random generators; those of devices that this machine lacks are left out, with a warning."""
    here = dict(state)
    if "torch_cuda" in here and not torch.cuda.is_available():
        del here["torch_cuda"]
        warn("the checkpoint was made with CUDA, which is not here: its random generators are left out")
    here["torch_cpu"] = here["torch_cpu"].cpu()
    GlobalRNGState().load_state_dict(here)
