"""Guard the folder of a run: one process and one run at a time, and no overwriting unless the user allows it."""

from __future__ import annotations

import errno
import json
import os
import shutil
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from hpamdp.config.errors import ConfigError
from hpamdp.files import read_regular, remove_link, replacing
from hpamdp.run_files import (
    CHECKPOINT_NAME,
    ERROR_NAME,
    MAX_TEXT_BYTES,
    METRICS_NAME,
    OTHERS,
    RESULTS,
    SUMMARY_NAME,
    TENSORBOARD_NAME,
    WANDB_NAME,
    is_config_of_run,
    is_saved_agent,
    listed_figures,
    saved_config,
    saved_summary,
)
from hpamdp.shell import path_setting

# Folders of loggers, named after these.
_OF_LOGGERS = (TENSORBOARD_NAME, WANDB_NAME)
# In the first line of each `error.txt` that is written here.
_TRACEBACK = b"Traceback (most recent call last):"
# Folder of an earlier run while a new one starts in its place.
_ASIDE_NAME = ".hpamdp-replaced"
_LOCK_NAME = ".hpamdp-lock"


@contextmanager
def locked(folder: Path, patience_s: float = 0.0) -> Iterator[None]:
    """Keep other processes out of a folder.

    Args:
        folder: the folder, created if it is missing.
        patience_s: seconds to wait for a process that is about to stop.

    Raises:
        ConfigError: another process works in the folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / _LOCK_NAME
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


def check_unused(folder: Path, *, may_overwrite: bool = False) -> None:
    """Refuse a folder with files that no run has written, or with a run unless it may be overwritten.

    Raises:
        ConfigError: the folder is refused.
    """
    if not _is_of_a_run(folder):
        foreign = [path.name for path in written_by_a_run(folder) if path.name != ERROR_NAME]
        if has_foreign_error(folder):
            foreign.append(ERROR_NAME)
        if foreign:
            raise ConfigError(
                f"{folder}: holds {', '.join(foreign)}, which no run has written and a run would replace; take another "
                "hydra.run.dir"
            )
    elif not may_overwrite and any((folder / name).exists() for name in RESULTS):
        raise ConfigError(
            f"{folder}: holds the results of a run; continue it with {path_setting('resume', folder)}, "
            "take another folder (hydra.run.dir), or set overwrite=true"
        )


def _is_of_a_run(folder: Path) -> bool:
    """Return whether a file says by its contents that a run has written it, since others use the same names."""
    if is_config_of_run(saved_config(folder)) or _aside(folder).exists():
        return True
    if {"finished", "frames"} <= saved_summary(folder).keys():
        return True
    try:
        return is_saved_agent(folder / CHECKPOINT_NAME)
    except OSError:  # missing, or no file
        return False


def check_no_training(folder: Path) -> None:
    """Refuse to write an evaluation into a folder that holds a training run.

    Raises:
        ConfigError: the folder holds a training run.
    """
    names = {*RESULTS, METRICS_NAME} - {SUMMARY_NAME}
    if any((folder / name).exists() for name in names) or saved_config(folder).get("mode", "eval") != "eval":
        raise ConfigError(
            f"{folder}: holds the record of a training, which an evaluation never changes; take another hydra.run.dir"
        )


def mark_unfinished(folder: Path) -> None:
    """Set `finished` to false in the summary of a run that is continued in its own folder."""
    summary = saved_summary(folder)
    if summary.get("finished"):
        with replacing(folder / SUMMARY_NAME) as partial:
            partial.write_text(json.dumps({**summary, "finished": False}, indent=2) + "\n")


@contextmanager
def moved_aside(folder: Path) -> Iterator[None]:
    """Move an earlier run aside, and delete it after the block or bring it back if the block fails.

    Files that no run writes stay in the folder.

    Raises:
        OSError: the folder cannot be written to; the earlier run stays.
    """
    aside = _aside(folder)
    _delete(aside)
    earlier = written_by_a_run(folder)
    if earlier:
        aside.mkdir()
    others = {*folder.iterdir()} - {*earlier}
    try:
        for path in earlier:
            path.rename(aside / path.name)
    except BaseException:
        _bring_back(folder)
        raise
    try:
        yield
    except BaseException:
        for path in {*written_by_a_run(folder)} - others:
            _delete(path)
        _bring_back(folder)
        raise
    _delete(aside)


def _bring_back(folder: Path) -> None:
    aside = _aside(folder)
    for path in aside.iterdir() if aside.is_dir() else ():
        path.rename(folder / path.name)
    _delete(aside)


def is_about_folder(error: OSError, folder: Path) -> bool:
    """Return whether an error says that the run's folder is gone or cannot be created or written to.

    An error of a write to an open file names no file, so its number decides. Collections report errors of shared memory
    themselves.
    """
    if error.filename is not None:
        return Path(str(error.filename)).is_relative_to(folder)
    return error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)


def write_error(folder: Path, error: BaseException) -> bool:
    """Write an error's traceback into the folder of a run or a sweep, and return whether that was possible.

    A file of that name that somebody else has written stays.
    """
    if has_foreign_error(folder):
        return False
    with suppress(OSError), replacing(folder / ERROR_NAME) as partial:
        partial.write_text("".join(traceback.format_exception(error)))
        return True
    return False


def remove_error(folder: Path) -> None:
    """Remove the file that `write_error` wrote, if there is one."""
    if not has_foreign_error(folder):
        (folder / ERROR_NAME).unlink(missing_ok=True)


def has_foreign_error(folder: Path) -> bool:
    """Return whether the folder has an `error.txt` that `write_error` has not written."""
    file = folder / ERROR_NAME
    if not os.path.lexists(file):
        return False
    try:
        beginning, _, _ = read_regular(file, MAX_TEXT_BYTES, follow_links=False).partition(b"\n")
    except OSError:
        return True
    return _TRACEBACK not in beginning


def written_by_a_run(folder: Path) -> list[Path]:
    """Return the paths that a run has written into its folder, first the files that mark a run.

    If the folder has the config of a run, the folder of a logger counts only if the run had this logger.
    """
    choices = saved_config(folder).get("choices")
    logger = choices.get("logger") if isinstance(choices, dict) else None
    of_logger = [name for name in _OF_LOGGERS if logger in (None, name)]
    paths = [folder / name for name in (*RESULTS, *of_logger, *listed_figures(folder), *OTHERS)]
    found = [path for path in dict.fromkeys(paths) if path.exists() or path.is_symlink()]
    return [path for path in found if path.name != ERROR_NAME or not has_foreign_error(folder)]


def _aside(folder: Path) -> Path:
    return folder / _ASIDE_NAME


def _delete(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
