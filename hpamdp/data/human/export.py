"""The recording written for other programs: all of it or nothing."""

from __future__ import annotations

import csv
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from tensordict import TensorDict

from hpamdp.data.human.errors import HumanDataError
from hpamdp.data.human.released_file import HumanData


def write_csv(data: HumanData, folder: Path) -> None:
    """Write the two tables as `episodes.csv` and `presses.csv`; points get a column an axis, NaN is left empty."""

    def write(unfinished: Path) -> None:
        unfinished.mkdir()
        for name, table in data._asdict().items():
            columns = _columns(table)
            with (unfinished / f"{name}.csv").open("w", newline="") as file:
                writer = csv.writer(file, lineterminator="\n")
                writer.writerow(columns)
                writer.writerows(zip(*columns.values(), strict=True))

    _at_once(folder, write)


def _columns(table: TensorDict) -> dict[str, list[object]]:
    """Return a table's columns as what csv shall hold; float32 in as few digits as give it back."""
    columns = {}
    for name, values in table.items():
        parts = {name: values} if values.ndim == 1 else {f"{name}_{a}": v for a, v in zip("xy", values.T, strict=True)}
        for part, column in parts.items():
            array = column.numpy()
            is_text = array.dtype == np.float32
            columns[part] = ["" if x != x else str(x) for x in array] if is_text else array.astype(int).tolist()
    return columns


def write_npz(data: HumanData, file: Path) -> None:
    """Write the two tables' columns as arrays `episodes/…` and `presses/…` of one compressed npz."""
    tables = data._asdict().items()
    arrays = {f"{name}/{column}": values.numpy() for name, table in tables for column, values in table.items()}

    def write(unfinished: Path) -> None:
        with unfinished.open("wb") as stream:
            np.savez_compressed(stream, **arrays)

    _at_once(file, write)


def write_memmap(batch: TensorDict, folder: Path) -> None:
    """Write transitions as a memory-mapped tensordict (`TensorDict.load_memmap` reads it)."""
    _at_once(folder, batch.memmap)


def _at_once(target: Path, write: Callable[[Path], object]) -> None:
    """Have `write` make a file or folder beside the target, and put it in place once it is whole."""
    if target.exists():
        raise HumanDataError(f"{target}: exists; choose another place, or remove it")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        workshop = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
        try:
            write(workshop / target.name)
            (workshop / target.name).rename(target)
        finally:
            shutil.rmtree(workshop, ignore_errors=True)
    except OSError as error:
        raise HumanDataError(f"{target}: cannot be written ({error.strerror or error})") from error
