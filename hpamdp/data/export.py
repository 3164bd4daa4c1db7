"""Tables and transitions written for other programs. A file or folder appears whole or not at all."""

from __future__ import annotations

import csv
import os
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from tensordict import TensorDict
from torch import Tensor

from hpamdp.data import DataError
from hpamdp.messages import first_line, reason_of


def write_csv(tables: Mapping[str, TensorDict], folder: Path, *, axes: Sequence[str] | None = None) -> None:
    """Write each table to `<name>.csv` in a new folder.

    Floats have as many digits as a reader needs to restore them exactly. NaN is an empty field, booleans are 0 and 1.

    Args:
        tables: by name, each `[N]` with columns `[N]` or `[N, K]`.
        folder: must not exist yet.
        axes: the names of the K parts of a column `[N, K]`, which becomes the columns `<column>_<axis>`. If None,
            numbers from 0.

    Raises:
        DataError: the folder exists or cannot be written.
    """

    def write(unfinished: Path) -> None:
        unfinished.mkdir()
        for name, table in tables.items():
            columns = _csv_columns(table, axes)
            with (unfinished / f"{name}.csv").open("w", newline="") as file:
                writer = csv.writer(file, lineterminator="\n")
                writer.writerow(columns)
                writer.writerows(zip(*columns.values(), strict=True))

    write_new(folder, write)


def _csv_columns(table: TensorDict, axes: Sequence[str] | None) -> dict[str, list[object]]:
    columns: dict[str, list[object]] = {}
    for name, values in table.items():
        if values.ndim == 1:
            columns[name] = _csv_fields(values)
            continue
        names = range(values.shape[1]) if axes is None else axes
        for axis, part in zip(names, values.unbind(1), strict=True):
            columns[f"{name}_{axis}"] = _csv_fields(part)
    return columns


def _csv_fields(values: Tensor) -> list[object]:
    array = values.numpy()
    if values.is_floating_point():
        return ["" if np.isnan(value) else str(value) for value in array]
    return array.astype(int).tolist()


def write_npz(tables: Mapping[str, TensorDict], file: Path) -> None:
    """Write every table's columns as arrays `<table>/<column>` of one compressed npz file.

    Raises:
        DataError: the file exists or cannot be written.
    """
    arrays = {f"{name}/{column}": values.numpy() for name, table in tables.items() for column, values in table.items()}

    def write(unfinished: Path) -> None:
        with unfinished.open("wb") as stream:
            np.savez_compressed(stream, **arrays)

    write_new(file, write)


def write_memmap(batch: TensorDict, folder: Path) -> None:
    """Write a tensordict as memory-mapped files, which `TensorDict.load_memmap` reads.

    Raises:
        DataError: the folder exists or cannot be written.
    """

    def write(unfinished: Path) -> None:
        try:
            batch.memmap_like(unfinished)
        except RuntimeError as error:  # torch's, if the files may not have this size
            raise OSError(first_line(error)) from error
        # Without the map, because a full disk would then crash the interpreter.
        for name, values in batch.items(True, True):
            *folders, own = (name,) if isinstance(name, str) else name
            with unfinished.joinpath(*folders, f"{own}.memmap").open("r+b") as file:
                file.write(values.contiguous().numpy().tobytes())

    write_new(folder, write)


def check_room(folder: Path, num_bytes: int) -> None:
    """Check that the disk has room for `num_bytes` in a folder, which is made if it is missing.

    Raises:
        OSError: the disk has too little room, or the folder cannot be written to.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=folder) as file:
        os.posix_fallocate(file.fileno(), 0, num_bytes)


def write_new(target: Path, write: Callable[[Path], object]) -> None:
    """Let `write` make a file or folder in a temporary place beside the target, then move it there.

    Raises:
        DataError: the target exists or cannot be written. Nothing is left behind.
    """
    try:
        if target.exists():
            raise DataError(f"{target}: exists; choose another place, or remove it")
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
        try:
            unfinished = temporary / target.name
            write(unfinished)
            unfinished.rename(target)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
    except OSError as error:
        raise DataError(f"{target}: cannot be written ({reason_of(error)})") from error
