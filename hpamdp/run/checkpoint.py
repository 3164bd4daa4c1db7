"""Save a run on disk, with everything needed to continue it or to score its agent, and load it.

A checkpoint is a safetensors file (see `state_file`). It holds the run's progress, the agent, and a state for each
other part of the run. Opening somebody else's file runs none of its code. Loading changes an agent only if the whole
file fits: names, types and shapes are compared first. Checksums say that the values are as a run wrote them; NaN and
infinite weights are refused.

TorchRL's `Checkpoint` is not used. It reads a replay buffer's prefetch queue with pickle, and stores replay buffers at
full capacity. It also moves the old file away before the new one is in place.
"""

from __future__ import annotations

import copy
import os
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.checkpoint import GlobalRNGState
from torchrl.data import ReplayBuffer

from hpamdp.config.compose import package_dir
from hpamdp.config.errors import ConfigError
from hpamdp.env.base import PAMDPEnv
from hpamdp.messages import first_line, reason_of, warn
from hpamdp.policies.agent import FOR_TRAINING, HierarchicalAgent
from hpamdp.policies.base import Learner, added_later
from hpamdp.policies.shared.on_policy import WAITING
from hpamdp.policies.shared.sized_by_data import SizedByData
from hpamdp.run import state_file
from hpamdp.run_files import CHECKPOINT_NAME as FILE_NAME
from hpamdp.run_files import OLD_NAMES, POLICY_NAME, is_saved_agent

FORMAT = 3
# Parts of a run that a checkpoint holds beside the agent.
STATES = ("collection", "recorder", "callbacks")
_OLD = "a zip archive; if it is a checkpoint of version 0.3, experiments/convert_checkpoints.py converts it"
_FOREIGN = "not a checkpoint of this program"
_NOT_RESUMED = "networks alone, which cannot be resumed"
_SCHEDULED = ("lr", "weight_decay")  # settings of an optimizer that training changes


def find(path: str | Path, where: str) -> Path:
    """Return the file of a checkpoint.

    A folder holds the networks alone, too. They suffice for acting, and may be those of the run's best agent.

    Args:
        path: the file itself, the output folder of its run, or the name of an agent that comes with the package.
        where: the setting that gives the path, for the error.

    Raises:
        ConfigError: there is no checkpoint, or it cannot be opened.
    """
    path = Path(os.path.expanduser(path))  # before `Path` drops "./", after which "./~" would mean the home directory
    if not os.path.exists(path) and str(path) in agent_names():
        path = agents_dir() / path
    if os.path.isdir(path):  # `Path.is_dir` would fail for some texts
        own = {"resume": (FILE_NAME,), "low.checkpoint": (FILE_NAME, POLICY_NAME)}
        names = (*own.get(where, (POLICY_NAME, FILE_NAME)), *OLD_NAMES)
        file = next((path / name for name in names if os.path.isfile(path / name)), path / FILE_NAME)
    else:
        file = path
    try:
        if not is_saved_agent(file):
            raise ConfigError(f"{where}={file}: {_OLD if zipfile.is_zipfile(file) else _FOREIGN}")
    except (FileNotFoundError, NotADirectoryError):
        has_policy = os.path.isfile(path / POLICY_NAME)
        why = _NOT_RESUMED if has_policy else "no checkpoint there"
        ours = f", or one of {', '.join(agent_names())}" if os.sep not in str(path) and where != "resume" else ""
        raise ConfigError(f"{where}={path}: {why}; give a run's output folder or its {FILE_NAME}{ours}") from None
    except OSError as error:
        raise ConfigError(f"{where}={file}: {reason_of(error)}") from error
    return file.absolute()  # since an environment may change the working directory


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
        generators: the states of the random generators, for `set_generators`; empty without training.
    """

    file: Path
    progress: dict[str, Any]
    states: dict[str, dict[str, Any]]
    generators: dict[str, Any]

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
                saved = columns.get(name, checksum)
                if not isinstance(saved, Tensor) or saved.dtype != checksum.dtype:
                    raise ValueError(f"{name} is no checksum")
                if (saved.cpu() != checksum.item()).any():
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
    parts = {}
    for name, part in agent.stateful().items():
        if not isinstance(part, ReplayBuffer):
            parts[name] = part.state_dict()
        elif with_replay:
            parts[name] = _replay_state(part)
    run = {"agent": agent.state_dict(), "rng": GlobalRNGState().state_dict(), **states}
    state_file.write(path, {"format": FORMAT, "progress": progress, **run, **parts})


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
    state_file.write(path, {"format": FORMAT, "progress": progress, **parts})


def progress_of(file: Path) -> dict[str, Any]:
    """Return the `progress` in a file.

    Raises:
        ConfigError: the file is damaged or not a checkpoint of this program.
    """
    return _opened(file)[1]


def load_learners(file: Path, agent: HierarchicalAgent, device: torch.device) -> None:
    """Fill the agent's learners from another run's checkpoint, without optimizers, replay and `progress`.

    If a learner does not fit, nothing is changed.

    Raises:
        ConfigError: the checkpoint is damaged or of other learners.
    """
    opened, _ = _opened(file)
    states = []
    with _explained(f"low.checkpoint={file}: of another class or size than low"):
        saved = _by_name(_read(opened, file, "agent", device))
        saved_num = len({name.split(".")[1] for name in saved if name.startswith("learners.")})
        if saved_num not in (0, len(agent.learners)):
            held = "1 learner" if saved_num == 1 else f"{saved_num} learners"
            raise ConfigError(f"low.checkpoint={file}: it holds {held}, but this agent has {len(agent.learners)}")
        for i, learner in enumerate(agent.learners):
            start = f"learners.{i}."
            state = {name.removeprefix(start): saved[name] for name in saved if name.startswith(start)}
            # Rows that wait are of the saved run, whose settings may be others.
            left_out = WAITING if isinstance(learner, Learner) and WAITING in learner.progress else ""
            state.pop(left_out, None)
            states.append(_state_for(learner, state, file, may_lack=left_out))
    for learner, state in zip(agent.learners, states, strict=True):
        assert isinstance(learner, Learner)
        learner.load_networks(state)


def load(
    file: Path,
    agent: HierarchicalAgent,
    device: torch.device,
    *,
    with_training: bool,
) -> Saved:
    """Fill the agent from a checkpoint, and its optimizers and replay if training continues.

    Nothing is changed before the whole file has been read. `set_generators` restores the random generators.

    Args:
        file: the checkpoint.
        agent: the agent to fill.
        device: the agent's device.
        with_training: whether training continues.

    Raises:
        ConfigError: the checkpoint is damaged or of another agent.
    """
    opened, progress = _opened(file)
    if with_training and {*opened.names} <= {"format", "progress", "agent", "collection"}:
        raise ConfigError(f"{file}: {_NOT_RESUMED}; give a run's output folder or its {FILE_NAME}")
    stateful = agent.stateful() if with_training else {}
    buffers = {name for name, part in stateful.items() if isinstance(part, ReplayBuffer)}
    missing = ({"agent", "rng", *STATES, *stateful} if with_training else {"agent"}) - buffers - {*opened.names}
    if missing:
        raise ConfigError(f"{file}: does not fit this agent: it lacks {', '.join(sorted(missing))}")
    loaded = {}
    with _explained(f"{file}: does not fit this agent, whose sizes env sets"):
        may_lack = "" if with_training else FOR_TRAINING
        networks = _state_for(agent, _read(opened, file, "agent", device), file, may_lack=may_lack)
        for name in stateful.keys() & {*opened.names}:
            saved = _read(opened, file, name, device)
            if name in buffers:
                num = min(saved["write_count"], stateful[name]._storage.max_size)
                loaded[name] = {"rows": TensorDict(saved["rows"], [num]), "write_count": saved["write_count"]}
            else:
                loaded[name] = _state_for_other(name, stateful[name], saved)
    names = STATES if with_training else STATES[:1]
    with _explained(_damage_of(file)):
        states = {name: _by_name(opened.read(name, device)) for name in names if name in opened.names}
        generators = _by_name(opened.read("rng")) if with_training else {}
    agent.load_state_dict({**agent.state_dict(), **networks})
    for name, part in stateful.items():
        if name not in loaded:
            warn("the checkpoint holds no replay (checkpoint_replay=false); the learner begins with an empty one")
        elif name in buffers:
            _fill(part, **loaded[name])
        else:
            part.load_state_dict(loaded[name])
    return Saved(file, progress, states, generators)


@contextmanager
def _explained(what: str) -> Iterator[None]:
    """Turn errors about the bytes or the values of a file into one line that begins with `what`.

    Raises:
        ConfigError: the block raised such an error.
    """
    try:
        yield
    except ConfigError:
        raise
    except Exception as error:  # damaged bytes raise errors of any kind
        reason = first_line(error) if type(error) is ValueError else f"{type(error).__name__}: {first_line(error)}"
        raise ConfigError(f"{what} ({reason:.160})") from error


def _damage_of(file: Path) -> str:
    return f"{file}: damaged, or {_FOREIGN}"


def _by_name(values: Any) -> dict[str, Any]:
    """Return a mapping whose keys are texts.

    Raises:
        ValueError: it is something else.
    """
    if not isinstance(values, dict) or not all(isinstance(name, str) for name in values):
        raise ValueError(f"{values!r:.40} is no mapping of names")
    return values


def _opened(file: Path) -> tuple[state_file.StateFile, dict[str, Any]]:
    """Open a checkpoint or policy file, and return it with the progress of its run.

    Raises:
        ConfigError: the file is damaged or not a checkpoint of this program.
    """
    with _explained(_damage_of(file)):
        opened = state_file.StateFile(file)
        number = opened.read("format")
        if number != FORMAT:
            raise ValueError(f"format {number}, but this version reads {FORMAT}")
        return opened, _by_name(opened.read("progress"))


def _read(opened: state_file.StateFile, file: Path, name: str, device: torch.device) -> Any:
    """Return a value of an open file.

    Raises:
        ConfigError: the value is damaged.
    """
    with _explained(_damage_of(file)):
        return opened.read(name, device)


def _state_for(module: nn.Module, saved: Any, file: Path, *, may_lack: str = "") -> dict[str, Any]:
    """Return a state dict that a module can load.

    Args:
        module: the module that will load the state.
        saved: the saved state dict.
        file: its file, for errors.
        may_lack: entries whose names begin so, and those of `added_later`, may be missing. The returned state then
            lacks them, too.

    Raises:
        ValueError: the state is of another module.
        ConfigError: the state holds NaN or inf, as that of a run that diverged.
    """
    saved, later, any_size = _by_name(saved), added_later(module), _buffers_sized_by_data(module)
    own = {
        key: value
        for key, value in module.state_dict(keep_vars=True).items()
        if key in saved or not (key in later or (may_lack and key.startswith(may_lack)))
    }
    state = dict(_check_names(saved, own))
    for key, value in own.items():
        if not isinstance(value, Tensor):
            continue
        _check_form(key, state[key], value, any_size=id(value) in any_size)
        tensor = state[key] = state[key].to(value.dtype)
        for what, is_wrong in (("NaN", torch.isnan), ("inf", torch.isinf)):
            if is_wrong(tensor).any() and not is_wrong(value).any():
                raise ConfigError(f"{file}: {key} holds {what}; take an earlier checkpoint")
    return state


def _state_for_other(name: str, part: Any, saved: Any) -> dict[str, Any]:
    """Return a state dict for a part of `stateful` other than a replay buffer.

    Raises:
        ValueError: the state is of another part.
    """
    if isinstance(part, torch.optim.Optimizer):
        return _checked_optimizer_state(name, saved, part)
    check_like(name, saved, part.state_dict())
    return _by_name(saved)


def _replay_state(buffer: ReplayBuffer) -> dict[str, Any]:
    """Return the filled rows of a buffer, and how many rows have been written to it."""
    rows = buffer[:].to_dict() if len(buffer) else {}
    return {"rows": rows, "write_count": buffer._writer.state_dict()["_write_count"]}


def _fill(buffer: ReplayBuffer, rows: TensorDict, write_count: int) -> None:
    """Put saved rows into an empty buffer, which then overwrites them in the same order as the saved one."""
    if len(rows):
        buffer.extend(rows)
    cursor = write_count % buffer._storage.max_size
    buffer._writer.load_state_dict({"_cursor": cursor, "_write_count": write_count})


def set_generators(generators: Mapping[str, Any]) -> None:
    """Restore the random generators. Warn about missing devices and modules, and leave out their generators."""
    states = dict(generators)
    for name in ("torch_cuda", "torch_xpu", "torch_mps"):
        module = name.removeprefix("torch_")
        if name in states and not getattr(torch, module).is_available():
            del states[name]
            warn(f"the checkpoint was made with {module}, which is not here: its random generators are left out")
    num = torch.cuda.device_count()
    if len(states.get("torch_cuda", [])) > num:
        warn("the checkpoint was made with CUDA devices that are not here: their random generators are left out")
        states["torch_cuda"] = states["torch_cuda"][:num]
    GlobalRNGState().load_state_dict(states)


def _check_form(where: str, saved: object, own: Tensor, *, any_size: bool = False) -> None:
    """Refuse a value unless it is a tensor with the dtype and shape of `own`; float16 may stand for float32.

    Args:
        where: name of the value in the error.
        saved: the value.
        own: the tensor of the run.
        any_size: whether only the number of dimensions must be the same.

    Raises:
        ValueError: the value is refused.
    """
    if not isinstance(saved, Tensor):
        raise ValueError(f"{where} is {type(saved).__name__}, but must be a tensor")
    fits = saved.ndim == own.ndim and (any_size or saved.shape == own.shape)
    if not fits or (saved.dtype != own.dtype and (saved.dtype, own.dtype) != (torch.float16, torch.float32)):
        raise ValueError(f"{where} is {_form(saved)}, but must be {_form(own)}")


def _form(tensor: Tensor) -> str:
    return f"{str(tensor.dtype).removeprefix('torch.')} {list(tensor.shape)}"


def check_like(where: str, saved: Any, own: Any) -> None:
    """Refuse nested values whose names, types, dtypes or shapes differ from `own`.

    Args:
        where: name of the values in the error.
        saved: the values.
        own: the values of the run.

    Raises:
        ValueError: the values differ; the message names the first difference.
    """
    if isinstance(own, Tensor):
        _check_form(where, saved, own)
    elif isinstance(own, Mapping):
        for name, value in _check_names(saved, own, where).items():
            check_like(f"{where}.{name}", value, own[name])
    elif type(saved) is not type(own):
        raise ValueError(f"{where} is {type(saved).__name__}, but must be {type(own).__name__}")


def _check_names(saved: object, own: Mapping[str, Any], where: str = "a state dict") -> Mapping[str, Any]:
    """Return nested values if their names are the names of `own`.

    Raises:
        ValueError: the names differ, or `saved` is no mapping.
    """
    if not isinstance(saved, Mapping):
        raise ValueError(f"{where} is {type(saved).__name__}, but must be a mapping")
    for word, names in (("without", own.keys() - saved.keys()), ("with", saved.keys() - own.keys())):
        if names:
            raise ValueError(f"{where} {word} {', '.join(sorted(map(str, names))[:3])}")
    return saved


def _buffers_sized_by_data(module: nn.Module) -> set[int]:
    """Return the ids of a module's buffers whose sizes depend on data."""
    sized = [part for part in module.modules() if isinstance(part, SizedByData)]
    return {id(buffer) for part in sized for buffer in part.buffers(recurse=False)}


def _state_after_a_step(optimizer: torch.optim.Optimizer) -> dict[str, Any]:
    """Return the state of a copy of an optimizer after a step. Only dtypes and shapes of its tensors matter."""
    another = copy.deepcopy(optimizer)
    for group in another.param_groups:
        for parameter in group["params"]:
            parameter.grad = torch.zeros_like(parameter)
    another.step()
    return another.state_dict()


def _checked_optimizer_state(where: str, saved: Mapping[str, Any], optimizer: torch.optim.Optimizer) -> dict[str, Any]:
    """Return a saved state that an optimizer can load. Torch's fused optimizers compare no shapes themselves.

    Args:
        where: name of the state in the error.
        saved: the saved state.
        optimizer: the optimizer.

    Raises:
        ValueError: the state is of another optimizer.
    """
    own = _state_after_a_step(optimizer)
    for group, theirs in zip(own["param_groups"], saved["param_groups"], strict=True):
        group |= {name: theirs[name] for name in _SCHEDULED}
    for number, moments in saved["state"].items():
        check_like(f"{where}.{number}", moments, own["state"].get(number, {}))
    return {**own, "state": saved["state"]}
