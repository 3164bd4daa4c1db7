"""Keep a run's metrics, on disk in `metrics.csv` or in memory."""

from __future__ import annotations

import csv
import math
import os
import shutil
from collections.abc import Iterable, Mapping
from contextlib import suppress
from itertools import takewhile
from pathlib import Path
from typing import Any

from hpamdp.files import read_regular, replacing
from hpamdp.messages import warn

FRAMES, WALL_SECONDS, CPU_SECONDS = "frames", "wall_s", "cpu_s"
EVALUATION = "eval/"


def read_rows(path: Path) -> list[dict[str, float]]:
    """Read the rows of a `metrics.csv`, each with the columns that have a number.

    An incomplete last line, cut off during writing, is left out. A missing file has no rows. A file of another kind
    has none either, and a warning names the file.
    """
    text = path.read_text(encoding="utf-8", errors="replace") if path.is_file() else ""
    lines = text[: text.rfind("\n") + 1].splitlines()
    try:
        return [dict(_numbers(cells)) for cells in csv.DictReader(lines)]
    except csv.Error as error:
        warn(f"{path} cannot be read; its rows are left out: {error}")
        return []


def read_curve(path: Path, column: str, max_bytes: int) -> tuple[list[str], list[tuple[float, float]]]:
    """Return the names of the columns, and the points (frames, value) of one column.

    The value is NaN in rows without a number in the column. Rows without a number of frames are left out, and so is an
    incomplete last line. The time is linear in the size of the file, whoever wrote it.

    Raises:
        OSError: the file is missing, not regular, unreadable or larger than `max_bytes`.
        csv.Error: the file is of another kind.
    """
    text = read_regular(path, max_bytes).decode(errors="replace")
    rows = csv.reader(text[: text.rfind("\n") + 1].splitlines())
    columns = next(rows, [])
    if FRAMES not in columns or column not in columns:
        return columns, []
    x, y = columns.index(FRAMES), columns.index(column)
    points = []
    for row in rows:
        with suppress(ValueError, IndexError):
            points.append((float(row[x]), _number(row[y]) if y < len(row) else math.nan))
    return columns, points


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return math.nan


def _numbers(cells: Mapping[str | None, Any]) -> Iterable[tuple[str, float]]:
    for column, cell in cells.items():
        try:
            # If a row is longer than the header, its other cells are a list under None.
            yield str(column), float(cell)
        except (TypeError, ValueError):
            continue


def rows_up_to(frames: float, path: Path) -> list[dict[str, float]]:
    """Return the rows of a `metrics.csv` for a run that resumes from this many frames.

    Later rows are left out, and so are rows without a number of frames.
    """
    rows = [row for row in read_rows(path) if FRAMES in row]
    return list(takewhile(lambda row: row[FRAMES] <= frames, rows))


def what_is_lost(
    rows: Iterable[Mapping[str, float]], path: Path, frames: int, log_every: int, batch: int
) -> str | None:
    """Return which rows of a `metrics.csv` are lost, as part of a sentence; None if no row is lost.

    Args:
        rows: what could be read of it.
        path: the file, which may be missing.
        frames: those of the saved agent, up to which it must have rows.
        log_every: largest distance of two rows, beside the length of a batch; 0 if unknown.
        batch: frames of a batch.
    """
    last = max((int(row[FRAMES]) for row in rows if FRAMES in row), default=None)
    # A run that failed in the middle of a batch may have saved its agent, but not the last row.
    before = max(0, frames - max(1, batch))
    if last is None and frames > 0:
        why = "damaged" if os.path.lexists(path) else "missing"
        return f"{path}: is {why}; the rows up to {FRAMES}={frames} are lost"
    if last is not None and log_every > 0 and last < before // log_every * log_every:
        return f"{path}: is cut; the rows after {FRAMES}={last} are lost"
    return None


class Metrics:
    """The rows of a run's metrics, one for each log. Later rows may add columns.

    If there is a file, it is complete on disk after every row.

    Args:
        path: the csv file; None if the run writes no files. It does not change before the first row. Then a file of an
            earlier run is kept as `<name>.previous`.
        resumed: the rows of the resumed run, which come first.
    """

    def __init__(self, path: Path | None = None, resumed: Iterable[Mapping[str, float]] = ()) -> None:
        self.path = path
        self._rows = [dict(row) for row in resumed]
        self._columns: list[str] = []  # of the file, once this run has written it

    def append(self, row: Mapping[str, float]) -> None:
        """Add one row; it is on disk when this returns. Columns not seen before join the header."""
        row = {column: float(value) for column, value in row.items()}
        self._rows.append(row)
        if self.path is None:
            return
        if not self._columns:
            self._keep_previous(self.path)
        if row.keys() <= set(self._columns):
            with self.path.open("a", newline="") as file:
                self._writer(file).writerow(row)
        else:
            self._rewrite(self.path)

    def keep_resumed(self) -> None:
        """Write the rows of the resumed run into a new folder, where nothing else has them."""
        if self.path is not None and self._rows:
            self._rewrite(self.path)

    def rows(self) -> list[dict[str, float]]:
        """Return a copy of all rows so far, each with the columns that have a number."""
        return [dict(row) for row in self._rows]

    def _keep_previous(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_file():
            with replacing(path.with_name(path.name + ".previous")) as partial:
                shutil.copyfile(path, partial)

    def _rewrite(self, path: Path) -> None:
        self._columns = list(dict.fromkeys(column for row in self._rows for column in row))
        with replacing(path) as partial, partial.open("w", newline="") as file:
            writer = self._writer(file)
            writer.writeheader()
            writer.writerows(self._rows)

    def _writer(self, file: Any) -> csv.DictWriter[str]:
        return csv.DictWriter(file, self._columns, restval="", lineterminator="\n")
