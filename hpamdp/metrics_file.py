"""Keep a run's metrics, on disk in `metrics.csv` or in memory."""

from __future__ import annotations

import csv
import shutil
from collections.abc import Iterable, Mapping
from itertools import takewhile
from pathlib import Path
from typing import Any

from hpamdp.files import replacing
from hpamdp.messages import warn

FRAMES, WALL_SECONDS, CPU_SECONDS = "frames", "wall_s", "cpu_s"
EVALUATION = "eval/"


def read_rows(path: Path) -> list[dict[str, float]]:
    """Read the rows of a `metrics.csv`, each with the columns that have a number.

    An incomplete last line, cut off during writing, is left out. A missing file has no rows. A file of another kind
    has none either, and a warning names the file.
    """
    try:
        text = path.read_text(encoding="utf-8", errors="replace") if path.is_file() else ""
        lines = text[: text.rfind("\n") + 1].splitlines()
        return [dict(_numbers(cells)) for cells in csv.DictReader(lines)]
    except (OSError, csv.Error) as error:
        warn(f"{path} cannot be read; its rows are left out: {error}")
        return []


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
