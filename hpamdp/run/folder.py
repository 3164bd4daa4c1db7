"""The folder of a run: one process at a time, and no results are overwritten unasked."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from hpamdp.config import ConfigError
from hpamdp.files import remove_link

# Files of a run that others read.
CHECKPOINT_NAME = "checkpoint.zip"
POLICY_NAME = "policy.pt"
SUMMARY_NAME = "summary.json"
# Folders that a run's logger writes to.
TENSORBOARD_NAME, WANDB_NAME = "tensorboard", "wandb"


@contextmanager
def locked(folder: Path, patience_s: float = 0.0) -> Iterator[None]:
    """Keep other processes out of a folder.

    Args:
        folder: made if need be.
        patience_s: how long to wait for a process that is about to stop.

    Raises:
        ConfigError: another process works in it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / ".lock"
    remove_link(file)
    lock = FileLock(file, timeout=patience_s)
    try:
        lock.acquire()
    except Timeout as error:
        raise ConfigError(f"{folder}: another process is at work in this folder") from error
    try:
        yield
    finally:
        file.unlink(missing_ok=True)
        lock.release()


def check_no_link(folder: Path) -> None:
    """Refuse to write to a folder inside a run's folder if it is a link to another place.

    Raises:
        ConfigError: it is a link.
    """
    if folder.is_symlink():
        raise ConfigError(f"{folder}: a link to {os.readlink(folder)}; a run writes to no linked folder, so remove it")


def check_unused(folder: Path) -> None:
    """Refuse a folder that holds a run.

    Raises:
        ConfigError: it does.
    """
    if (folder / SUMMARY_NAME).exists() or (folder / CHECKPOINT_NAME).exists():
        raise ConfigError(
            f"{folder}: holds the results of a run; continue it with resume={folder}, take another hydra.run.dir, or "
            "set overwrite=true"
        )
