"""Save a run on disk, with everything needed to continue it or to score its agent, and load it.

A checkpoint is a zip archive. Its member `manifest.json` holds the run's progress and the checksums of the other
members, which `torch.save` writes, one for each component. Opening somebody else's file runs none of its code (see
`tensor_archive`). Loading changes an agent only if the whole file fits (see `state_checks`).

TorchRL's `Checkpoint` is not used. It reads a replay buffer's prefetch queue with pickle, and stores replay buffers at
full capacity. It also moves the old file away before the new one is in place.
"""

from __future__ import annotations

import copy
import hashlib
import io
import json
import math
import os
import random
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from io import BufferedReader
from pathlib import Path
from typing import IO, Annotated, Any, Literal

import torch
from pydantic import Field, FiniteFloat
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.checkpoint import GlobalRNGState
from torchrl.data import ReplayBuffer

from hpamdp.config.compose import package_dir
from hpamdp.config.errors import ConfigError
from hpamdp.env.base import PAMDPEnv
from hpamdp.files import regular_size, replacing
from hpamdp.messages import first_line, reason_of, warn
from hpamdp.policies.agent import FOR_TRAINING, HierarchicalAgent
from hpamdp.policies.base import Learner, Level, added_later
from hpamdp.policies.practice import Practice
from hpamdp.policies.shared.on_policy import WAITING
from hpamdp.run.state_checks import (
    Progress,
    SavedPart,
    buffers_sized_by_data,
    check_form,
    check_generator,
    check_like,
    check_moments,
    check_names,
    check_num_rows,
    check_optimizer,
    check_replay,
    check_values,
    checked,
    checked_as,
    scheduled,
    state_after_a_step,
)
from hpamdp.run.tensor_archive import MemberFile, SavedTensor, TensorArchive, stored_members
from hpamdp.run_files import CHECKPOINT_NAME as FILE_NAME
from hpamdp.run_files import MANIFEST_NAME, POLICY_NAME

_FORMAT = 2
_MAX_JSON = 2**24
_BLOCK = 2**20
_CUDA_STATE_BYTES = 16
# Parts of a run that a checkpoint holds beside the agent.
STATES = ("collection", "recorder")
# The same, missing in checkpoints of earlier versions.
_NEWER_STATES = ("callbacks",)
_NOT_RESUMED = "networks alone, which cannot be resumed"
# Errors that damaged bytes of a file can raise.
_DAMAGE = (
    zipfile.BadZipFile,
    EOFError,
    OSError,
    KeyError,
    TypeError,
    AttributeError,
    IndexError,
    OverflowError,
    ValueError,
    RuntimeError,
)


def find(path: str | Path, where: str) -> Path:
    """Return the file of a checkpoint.

    A folder without a checkpoint may hold only the networks, which suffice for everything except resuming the run.

    Args:
        path: the file itself, the output folder of its run, or the name of an agent that comes with the package.
        where: the setting that gives the path, for the error.

    Raises:
        ConfigError: there is no checkpoint, or it cannot be opened.
    """
    path = Path(os.path.expanduser(path))  # before `Path` drops "./", after which "./~" would mean the home directory
    if not os.path.exists(path) and str(path) in agent_names():
        path = agents_dir() / path
    is_folder = os.path.isdir(path)  # `Path.is_dir` would fail for some texts
    file = path / FILE_NAME if is_folder else path
    if where != "resume" and is_folder and not os.path.isfile(file) and os.path.isfile(path / POLICY_NAME):
        file = path / POLICY_NAME
    try:
        regular_size(file)
        with file.open("rb") as opened:
            is_archive = zipfile.is_zipfile(opened)
    except (FileNotFoundError, NotADirectoryError):
        has_policy = os.path.isfile(path / POLICY_NAME)
        why = _NOT_RESUMED if has_policy else "no checkpoint there"
        names = f", or one of {', '.join(agent_names())}" if os.sep not in str(path) and where != "resume" else ""
        raise ConfigError(f"{where}={path}: {why}; give a run's output folder or its {FILE_NAME}{names}") from None
    except OSError as error:
        raise ConfigError(f"{where}={file}: {reason_of(error)}") from error
    if not is_archive:
        raise ConfigError(f"{where}={file}: not a checkpoint of this program")
    return file


def agents_dir() -> Path:
    """Return the folder of the agents that come with the package; it need not exist."""
    return package_dir("agents") or Path("agents")


def agent_names() -> list[str]:
    """Return the names of the agents that come with the package."""
    return sorted(file.parent.name for file in agents_dir().glob(f"*/{POLICY_NAME}"))


@dataclass(frozen=True)
class Saved:
    """The parts of a run that `load` returns. The agent itself is filled in place.

    Attributes:
        file: the checkpoint.
        progress: the JSON values of `save`.
        states: the states of the other parts of the run, by name, as for `save`.
        generators: the states of the random generators, for `set_generators`; None without training.
    """

    file: Path
    progress: dict[str, Any]
    states: dict[str, dict[str, Any]]
    generators: Generators | None

    def set_statistics(self, env: PAMDPEnv) -> None:
        """Make an environment scale its observations as in the saved run.

        A line warns if a file that describes the problem differs from that of the saved run.

        Raises:
            ConfigError: the file lacks statistics that the environment scales by, or they are of another environment.
        """
        with _explained(f"{self.file}: does not fit env"):
            columns = _by_name(self.states.get("collection", {}).get("env", {}))
            missing = sorted(env.statistics().keys() - columns.keys())
            if missing:
                raise ValueError(f"it lacks the running statistics {', '.join(missing)}, by which env scales")
            for name, checksum in env.file_checksums().items():
                if name not in columns:
                    continue
                if not torch.is_tensor(columns[name]) or columns[name].dtype != checksum.dtype:
                    raise ValueError(f"{name} is no checksum")
                if (columns[name].to(checksum.device) != checksum.item()).any():
                    setting = f"env.{name.removesuffix('_checksum')}"
                    warn(f"{self.file}: the agent was trained with another file of {setting}, or it was edited since")
            env.set_statistics(columns)


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
        states: states of the other parts of the run, by name: nested dictionaries of tensors and numbers.
        progress: JSON values to read back with `progress_of`, such as the config and the frames so far.
        with_replay: whether to store replay buffers. Without them, a resumed run starts with empty buffers.

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
        archive.writestr(MANIFEST_NAME, json.dumps(manifest))


def save_policy(path: Path, agent: HierarchicalAgent, env: PAMDPEnv, progress: Mapping[str, Any]) -> None:
    """Write the networks that act and the scale of the observations, without the parts for training.

    `mode=eval` can load the file.

    Args:
        path: the file.
        agent: the agent.
        env: the environment that the agent acts in.
        progress: see `save`.

    Raises:
        OSError: see `save`.
    """
    parts = {"agent": agent.acting_state(), "collection": {"env": env.statistics() | env.file_checksums()}}
    with replacing(path) as partial:
        torch.save({"format": _FORMAT, "progress": json.dumps(dict(progress)), **parts}, partial)


def progress_of(file: Path) -> dict[str, Any]:
    """Return the `progress` in a file.

    Raises:
        ConfigError: the file is damaged or not a checkpoint of this program.
    """
    with _Opened(file) as opened:
        return opened.progress


def num_numbers(file: Path) -> int:
    """Return the number of floating-point entries that the file declares for its agent.

    Raises:
        ConfigError: the file is damaged or not a checkpoint of this program.
    """
    with _Opened(file) as opened:
        state = opened.part("agent")
        parts = state.values() if isinstance(state, Mapping) else ()
        tensors = [part for part in parts if isinstance(part, SavedTensor)]
        return sum(math.prod(tensor.shape) for tensor in tensors if tensor.dtype.is_floating_point)


def load_learners(file: Path, agent: HierarchicalAgent, device: torch.device) -> None:
    """Fill the agent's learners from another run's checkpoint, without optimizers, replay and `progress`.

    If a learner does not fit, nothing is changed.

    Raises:
        ConfigError: the checkpoint is damaged or of other learners.
    """
    prefix = "learners."
    with _Opened(file) as opened, _explained(f"low.checkpoint={file}: of another class or size than low"):
        saved = _by_name(opened.part("agent"))
        own = {name.removeprefix(prefix): value for name, value in saved.items() if name.startswith(prefix)}
        saved_num, num = len({name.partition(".")[0] for name in own}), len(agent.learners)
        if own and saved_num != num:
            learners = "learner" if saved_num == 1 else "learners"
            raise ConfigError(f"low.checkpoint={file}: it holds {saved_num} {learners}, but this agent has {num}")
        states = []
        for i, learner in enumerate(agent.learners):
            start = f"{i}."
            state = {name.removeprefix(start): own[name] for name in own if name.startswith(start)}
            # Rows that wait are of the saved run, whose settings may be others.
            left_out = WAITING if isinstance(learner, Learner) and WAITING in learner.progress else ""
            state.pop(left_out, None)
            states.append(opened.state("agent", state, learner, device, may_lack=left_out))
    for learner, state in zip(agent.learners, states, strict=True):
        assert isinstance(learner, Learner)
        learner.load_networks(state)


def load(
    file: Path,
    agent: HierarchicalAgent,
    device: torch.device,
    *,
    with_training: bool,
    steps: TensorDictBase | None = None,
) -> Saved:
    """Fill the agent from a checkpoint, and its optimizers and replay if training continues.

    Nothing is changed before the whole file has been read and checked. `set_generators` restores the random generators.

    Args:
        file: the checkpoint.
        agent: the agent to fill.
        device: the agent's device.
        with_training: whether training continues.
        steps: see `HierarchicalAgent.replay_rows`; required with training.

    Raises:
        ConfigError: the checkpoint is damaged or of another agent.
    """
    misfit = f"{file}: does not fit this agent, whose sizes env sets"
    states: dict[str, dict[str, Any]] = {}
    replays: dict[str, _Replay] = {}
    with _Opened(file) as opened:
        if with_training and not opened.names - {"agent", "collection"}:
            raise ConfigError(f"{file}: {_NOT_RESUMED}; give a run's output folder or its {FILE_NAME}")
        stateful = agent.stateful() if with_training else {}
        buffers = {name: part for name, part in stateful.items() if isinstance(part, ReplayBuffer)}
        missing = ({"agent", "rng", *STATES, *stateful} if with_training else {"agent"}) - {*buffers} - opened.names
        if missing:
            raise ConfigError(f"{file}: does not fit this agent: it lacks {', '.join(sorted(missing))}")
        with _explained(misfit):
            may_lack = "" if with_training else FOR_TRAINING
            networks = opened.state("agent", opened.part("agent"), agent, device, may_lack=may_lack)
            others = {name: opened.other(name, stateful[name], device) for name in stateful.keys() - buffers.keys()}
            for name in opened.names & {*buffers}:
                replays[name] = opened.replay(name, buffers[name], agent, steps)
        with _explained(_damage_of(file)):
            for name in (*STATES, *_NEWER_STATES) if with_training else STATES[:1]:
                if name in opened.names:
                    states[name] = _by_name(opened.filled(name, device))
            generators = Generators.of(opened.filled("rng")) if with_training else None
        progress = opened.progress
    agent.load_state_dict({**agent.state_dict(), **networks})
    for name, state in others.items():
        stateful[name].load_state_dict(state)
    for name, buffer in buffers.items():
        if name in replays:
            replays[name].put_into(buffer)
        else:
            warn("the checkpoint holds no replay (checkpoint_replay=false); the learner begins with an empty one")
    return Saved(file, progress, states, generators)


@contextmanager
def _explained(what: str) -> Iterator[None]:
    """Turn errors about the bytes or the values of a file into one line that begins with `what`.

    Raises:
        ConfigError: the block raised such an error.
    """
    try:
        yield
    except MemoryError as error:
        raise ConfigError(f"{what}: there is not enough memory for it") from error
    except _DAMAGE as error:
        if isinstance(error, ConfigError):
            raise
        reason = first_line(error) if type(error) is ValueError else f"{type(error).__name__}: {first_line(error)}"
        raise ConfigError(f"{what} ({reason:.160})") from error


def _damage_of(file: Path) -> str:
    return f"{file}: damaged, or not a checkpoint of this program"


def _by_name(values: Any) -> dict[str, Any]:
    """Return a mapping whose keys are texts.

    Raises:
        ValueError: it is something else.
    """
    return checked_as(dict[str, Any], values)


@dataclass(frozen=True)
class _Replay:
    """The checked contents of a replay buffer."""

    rows: TensorDict | None
    writer: dict[str, int]

    def put_into(self, buffer: ReplayBuffer) -> None:
        """Fill an empty buffer."""
        if self.rows is not None:
            buffer.extend(self.rows)
        buffer._writer.load_state_dict(self.writer)


class _Manifest(SavedPart):
    format: int
    members: dict[str, str]
    progress: dict[str, Any]


class _Opened:
    """An open checkpoint or policy file, whose members are read only after their descriptions fit.

    Args:
        path: the file.

    Attributes:
        names: names of the members.
        progress: progress of the run.

    Raises:
        ConfigError: the file is damaged or not a checkpoint of this program.
    """

    names: set[str]
    progress: dict[str, Any]

    def __init__(self, path: Path) -> None:
        self.path = path
        self._damage = _damage_of(path)
        self._parts: dict[str, TensorArchive] = {}
        self._stack = ExitStack()

    def __enter__(self) -> _Opened:
        with _explained(self._damage):
            file = self._stack.enter_context(self.path.open("rb"))
            num_bytes = os.fstat(file.fileno()).st_size
            try:
                self._open(file, num_bytes)
            except BaseException:
                self._stack.close()
                raise
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _open(self, file: IO[bytes], num_bytes: int) -> None:
        archive = stored_members(file, num_bytes)
        self._file, self._infos = file, {info.filename: info for info in archive.infolist()}
        if MANIFEST_NAME in self._infos:
            text = archive.read(MANIFEST_NAME)
            manifest = checked(_Manifest, _json(text))
            _check_format(manifest.format)
            self._members = {name: (f"{name}.pt", checksum) for name, checksum in manifest.members.items()}
            self.names = {*self._members}
            progress = manifest.progress
        else:
            saved = TensorArchive(file, num_bytes)
            _check_format(saved.state["format"])
            progress = _json(saved.state["progress"])
            for name in ("agent", "collection"):
                if name == "agent" or name in saved.state:  # files of earlier versions hold the networks only
                    self._parts[name] = copy.copy(saved)
                    self._parts[name].state = saved.state[name]
            self.names = {*self._parts}
        self.progress = checked(Progress, progress).model_dump(exclude_unset=True)

    def part(self, name: str) -> Any:
        """Return the contents of a member, with a `SavedTensor` in place of each tensor."""
        if name not in self._parts:
            with _explained(self._damage):
                member, checksum = self._members[name]
                info = self._infos[member]
                if _checksum(MemberFile(self._file, info)) != checksum:
                    raise ValueError(f"the checksum of {name} is wrong")
                self._parts[name] = TensorArchive(BufferedReader(MemberFile(self._file, info)), info.file_size)
        return self._parts[name].state

    def filled(self, name: str, device: torch.device | None = None) -> Any:
        """Return the contents of a member, with its tensors."""
        state = self.part(name)
        return self._parts[name].filled(state, device)

    def state(
        self, name: str, saved: Any, module: nn.Module, device: torch.device, *, may_lack: str = ""
    ) -> dict[str, Any]:
        """Return a state dict that a module can load.

        Args:
            name: the member.
            saved: the state dict, not yet read.
            module: the module that will load the state.
            device: the device of the returned tensors.
            may_lack: entries whose names begin so, and those of `added_later`, may be missing. The returned state then
                lacks them, too.

        Raises:
            ValueError: the state is of another module, or holds invalid numbers.
            ConfigError: the state holds NaN or inf.
        """
        archive = self._parts[name]
        own = module.state_dict(keep_vars=True)
        any_size = buffers_sized_by_data(module)
        if isinstance(saved, Mapping):
            # A selector of 0.3 has `is_uniform` in the place of `practice`.
            dropped = {key.removesuffix("practice") + "is_uniform" for key in own if key.endswith(".practice")}
            saved = {key: value for key, value in saved.items() if key not in dropped}
            later = added_later(module)
            lacks = {key for key in own if key in later or (may_lack and key.startswith(may_lack))} - saved.keys()
            own = {key: value for key, value in own.items() if key not in lacks}
        check_names(saved, own)
        for key, value in own.items():
            if isinstance(value, Tensor):
                check_form(key, saved[key], value, any_size=id(value) in any_size)
        read: dict[int, Tensor] = {}  # shared weights occur several times
        state: dict[str, Any] = {}
        for key, value in own.items():
            if not isinstance(value, Tensor):
                state[key] = archive.filled(saved[key], device)
                continue
            tensor = archive.tensor(saved[key], device).to(value.dtype)
            first = read.setdefault(id(value), tensor)
            try:
                check_values(key, tensor, value)
            except ValueError as error:
                raise ConfigError(f"{self.path}: {error}; take an earlier checkpoint") from error
            if not torch.equal(first, tensor):
                raise ValueError(f"{key} differs from another name of the same weights")
            state[key] = first
        for prefix, part in module.named_modules():
            if isinstance(part, Level | Practice):
                start = f"{prefix}." if prefix else ""
                part.check_state({key.removeprefix(start): state[key] for key in state if key.startswith(start)})
        return state

    def other(self, name: str, part: Any, device: torch.device) -> dict[str, Any]:
        """Return a state dict for a part of `stateful` other than a replay buffer.

        Raises:
            ValueError: the state is of another part, or holds invalid numbers.
        """
        if isinstance(part, torch.optim.Optimizer):
            return self.optimizer(name, part, device)
        saved = self.part(name)
        check_like(name, saved, part.state_dict())
        return _by_name(self._parts[name].filled(saved, device))

    def optimizer(self, name: str, optimizer: torch.optim.Optimizer, device: torch.device) -> dict[str, Any]:
        """Return a state dict that an optimizer can load.

        Raises:
            ValueError: the state is of another optimizer, or holds invalid numbers.
        """
        own = state_after_a_step(optimizer)
        saved = self.part(name)
        check_optimizer(name, saved, own)
        moments = self._parts[name].filled(saved["state"], device)
        check_moments(name, moments)
        groups = zip(own["param_groups"], saved["param_groups"], strict=True)
        return {"state": moments, "param_groups": [scheduled(*pair) for pair in groups]}

    def replay(
        self, name: str, buffer: ReplayBuffer, agent: HierarchicalAgent, steps: TensorDictBase | None
    ) -> _Replay:
        """Return the contents of a replay buffer.

        Raises:
            ValueError: the contents are of another buffer, or hold invalid numbers.
        """
        saved = check_replay(name, self.part(name), buffer)
        writer = saved.writer.model_dump(by_alias=True)
        if not saved.num_rows:
            return _Replay(None, writer)
        assert steps is not None
        example = agent.replay_rows(name, steps)
        if example is None:  # its owner does not override `replay_rows`
            return _Replay(TensorDict(self.filled(name, steps.device)["rows"], [saved.num_rows]), writer)
        check_num_rows(f"{name}.rows", saved.rows, example.to_dict(), saved.num_rows)
        rows = TensorDict(self._parts[name].filled(saved.rows, example.device), batch_size=[saved.num_rows])
        agent.check_rows(name, rows, example)
        return _Replay(rows, writer)


def _json(text: Any) -> Any:
    def refuse(name: str) -> None:
        raise ValueError(f"it holds the number {name}")

    if not isinstance(text, str | bytes) or len(text) > _MAX_JSON:
        raise ValueError(f"its progress is no text of at most {_MAX_JSON:,} bytes")
    return json.loads(text, parse_constant=refuse)


def _checksum(member: MemberFile) -> str:
    digest = hashlib.sha256()
    while block := member.read(_BLOCK):
        digest.update(block)
    return digest.hexdigest()


def _packed(state: object) -> bytes:
    stream = io.BytesIO()
    torch.save(state, stream)
    return stream.getvalue()


def _check_format(number: int) -> None:
    if number != _FORMAT:
        raise ValueError(f"format {number}, but this version reads {_FORMAT}")


def _replay_state(buffer: ReplayBuffer) -> dict[str, Any]:
    """Return the filled rows of a buffer and the place of the next one."""
    rows = buffer[:].clone().to_dict() if len(buffer) else {}
    return {"rows": rows, "num_rows": len(buffer), "writer": dict(buffer._writer.state_dict())}


class _PythonState(SavedPart):
    version: Literal[3]
    words: Annotated[tuple[Annotated[int, Field(ge=0, lt=2**32)], ...], Field(min_length=625, max_length=625)]
    gauss: FiniteFloat | None


class _NumpyState(SavedPart):
    kind: Literal["MT19937"]
    words: Tensor
    place: Annotated[int, Field(ge=0, le=624)]
    has_gauss: Literal[0, 1]
    gauss: FiniteFloat


class Generators(SavedPart):
    """The states of the random generators of a process."""

    python: tuple[Any, ...]
    numpy: tuple[Any, ...]
    torch_cpu: Tensor
    torch_cuda: list[Tensor] | None = None
    torch_xpu: list[Tensor] | None = None
    torch_mps: Tensor | None = None

    @classmethod
    def of(cls, saved: Any) -> Generators:
        """Return the states, after a trial on generators that are used for nothing else.

        Raises:
            ValueError: a value is no state of a generator.
        """
        states = checked(cls, saved)
        for model, values in ((_PythonState, states.python), (_NumpyState, states.numpy)):
            checked(model, dict(zip(model.model_fields, values, strict=True)))
        words = states.numpy[1]
        if words.dtype != torch.int64 or list(words.shape) != [624] or (words < 0).any() or (words >= 2**32).any():
            raise ValueError("numpy: must hold 624 numbers of 32 bits")
        random.Random().setstate(states.python)
        check_generator(states.torch_cpu)
        for state in states.torch_cuda or []:
            if state.dtype != torch.uint8 or list(state.shape) != [_CUDA_STATE_BYTES]:
                raise ValueError(f"torch_cuda: must hold {_CUDA_STATE_BYTES} bytes for each device")
        return states


def set_generators(generators: Generators) -> None:
    """Restore the random generators. Warn about missing devices and modules, and leave out their generators."""
    states = {name: state for name, state in generators if state is not None}
    if "torch_cuda" in states:
        num = torch.cuda.device_count() if torch.cuda.is_available() else 0
        if num < len(states["torch_cuda"]):
            warn("the checkpoint was made with CUDA devices that are not here: their random generators are left out")
            states["torch_cuda"] = states["torch_cuda"][:num]
        if not num:
            del states["torch_cuda"]
    for name, module in (("torch_xpu", "xpu"), ("torch_mps", "mps")):
        if name in states and not getattr(torch, module).is_available():
            del states[name]
            warn(f"the checkpoint was made with {module}, which is not here: its random generators are left out")
    GlobalRNGState().load_state_dict(states)
