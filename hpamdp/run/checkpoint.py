"""A run on disk: everything that is needed to go on with it or to score its agent."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchrl.checkpoint import Checkpoint, CheckpointError, GlobalRNGState, StateDictCheckpointAdapter
from torchrl.data import ReplayBuffer

from hpamdp.config import ConfigError
from hpamdp.policies.agent import HierarchicalAgent

FILE_NAME = "checkpoint.zip"


def find(path: str | Path, where: str) -> Path:
    """Return the checkpoint's file, given itself or the run's output folder; `where` names the setting in an error."""
    path = Path(path).expanduser()
    file = path / FILE_NAME if path.is_dir() else path
    if not file.is_file():
        raise ConfigError(f"{where}={path}: no checkpoint there; give a run's output folder or its {FILE_NAME}")
    if not Checkpoint.is_checkpoint(file):
        raise ConfigError(f"{where}={file}: not a checkpoint of this program")
    return file


class _Columns:
    """What is saved or loaded, as a component with a state dict."""

    def __init__(self, columns: Mapping[str, Tensor]) -> None:
        self.columns = dict(columns)

    def state_dict(self) -> dict[str, Tensor]:
        return self.columns

    def load_state_dict(self, columns: Mapping[str, Tensor]) -> None:
        self.columns = dict(columns)


def _components(agent: HierarchicalAgent, columns: _Columns) -> Checkpoint:
    checkpoint = Checkpoint()
    for name, part in {"agent": agent, "rng": GlobalRNGState(), "env": columns, **agent.stateful()}.items():
        # One file a component; replay buffers have a format of their own.
        adapter = None if isinstance(part, ReplayBuffer) else StateDictCheckpointAdapter("torch")
        checkpoint.register(name, part, adapter=adapter)
    return checkpoint


def _filled(agent: HierarchicalAgent) -> set[str]:
    """Return the components that can be saved: TorchRL refuses a replay buffer that never held anything."""
    parts = agent.stateful().items()
    empty = {name for name, part in parts if isinstance(part, ReplayBuffer) and len(part) == 0}
    return {"agent", "rng", "env", *agent.stateful()} - empty


def save(path: Path, agent: HierarchicalAgent, env_state: Mapping[str, Tensor], progress: Mapping[str, Any]) -> None:
    """Write the agent, its optimisers and replay, the environment's state and the random generators.

    Args:
        path: the file; an older one stays in place until the new one is complete.
        agent: the agent.
        env_state: the environment's columns.
        progress: JSON values to read back with `progress_of`: the resolved config, the frames so far.
    """
    _components(agent, _Columns(env_state)).save(path, components=_filled(agent), format="archive", metadata=progress)


def progress_of(file: Path) -> dict[str, Any]:
    """Return what `save` was given as `progress`."""
    return Checkpoint.manifest(file)["metadata"]


def load_learners(file: Path, agent: HierarchicalAgent, device: torch.device) -> None:
    """Fill the agent's learners, but neither their optimisers nor their replay, from another run's checkpoint.

    Raises:
        ConfigError: the checkpoint is damaged or of other learners.
    """
    saved = _Columns({})
    checkpoint = Checkpoint()
    checkpoint.register("agent", saved, adapter=StateDictCheckpointAdapter("torch"))
    try:
        checkpoint.load(file, components={"agent"}, map_location=device)
        prefix = "learners."
        own = {name.removeprefix(prefix): value for name, value in saved.columns.items() if name.startswith(prefix)}
        saved_num, num = len({name.partition(".")[0] for name in own}), len(agent.learners)
        if own and saved_num != num:
            raise ConfigError(f"low.checkpoint={file}: it holds {saved_num} learners, but this agent has {num}")
        agent.learners.load_state_dict(own)
    except (CheckpointError, RuntimeError, OSError) as error:
        reason = " ".join(str(error).split())
        raise ConfigError(f"low.checkpoint={file}: of another class or size than low: {reason:.160}") from error


def load(file: Path, agent: HierarchicalAgent, device: torch.device, with_training: bool) -> dict[str, Tensor]:
    """Fill the agent from a checkpoint, with training also its optimisers and replay and the random generators.

    Returns:
        The environment's columns.

    Raises:
        ConfigError: the checkpoint is damaged or of another agent.
    """
    columns = _Columns({})
    checkpoint = _components(agent, columns)
    # What was empty when it was saved stays empty; anything else that is missing is an error.
    saved = set(Checkpoint.manifest(file)["components"])
    wanted = (saved | _filled(agent)) if with_training else {"agent", "env"}
    try:
        checkpoint.load(file, components=wanted, map_location=device)
    except (CheckpointError, RuntimeError, OSError) as error:
        raise ConfigError(f"{file}: does not fit this agent: {str(error).splitlines()[0]}") from error
    return columns.columns
