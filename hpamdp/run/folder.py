"""The folder of a run: one process at a time, and no results are overwritten unasked."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from hpamdp.config import ConfigError

# Files of a run that others read.
CHECKPOINT_NAME = "checkpoint.zip"
POLICY_NAME = "policy.pt"
SUMMARY_NAME = "summary.json"


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
