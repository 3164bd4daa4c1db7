"""Where a run's numbers go: `metrics.csv` always, one logger beside it, and the table that closes a run."""

from __future__ import annotations

import csv
import math
import netrc
import os
import shutil
import sys
from collections.abc import Iterable, Mapping
from itertools import takewhile
from pathlib import Path
from typing import Any, Literal, Protocol
from urllib.parse import urlsplit

from hpamdp.env.boatdock.reference import CHOICE_FIGURES, has_choice, references

FRAMES, WALL_SECONDS = "frames", "wall_s"
EVALUATION = "eval/"

# Seconds that an online wandb run may keep the training waiting, at its start and at its end.
_WANDB_START, _WANDB_FINISH = 20.0, 60.0


def warn(message: str) -> None:
    """Write one line to the terminal; the run's logging, which Hydra sets up, may be off."""
    print(message, file=sys.stderr)


def read_rows(path: Path) -> list[dict[str, float]]:
    """Read the rows of a `metrics.csv`, each with the columns it has a number for.

    A last line without its end was cut off while it was written, and is left out; cells that hold no number too.
    A missing file has no rows.
    """
    text = path.read_text() if path.exists() else ""
    lines = text[: text.rfind("\n") + 1].splitlines()
    return [dict(_numbers(cells)) for cells in csv.DictReader(lines)]


def _numbers(cells: Mapping[str | None, Any]) -> Iterable[tuple[str, float]]:
    for column, cell in cells.items():
        try:
            # A row longer than the header has its rest, a list, under None.
            yield str(column), float(cell)
        except (TypeError, ValueError):
            continue


class MetricsFile:
    """A csv file with one row a log, complete on disk after every row, whose columns may grow.

    Args:
        path: the file. It stays as it is until the first row; what an earlier run left there is then kept as
            `<name>.previous`.
        resume_from: the metrics file of the run that is resumed, which may be `path` itself; its rows come first.
        up_to_frames: leave out the resumed rows from the first one past this many frames on.
    """

    def __init__(self, path: Path, resume_from: Path | None = None, up_to_frames: float = math.inf) -> None:
        self.path = path
        self._columns: list[str] = []
        resumed = read_rows(resume_from) if resume_from is not None else []
        # Rows that wait for the first one of this run; None once they are in the file.
        self._resumed: list[dict[str, float]] | None = list(
            takewhile(lambda row: row.get(FRAMES, 0.0) <= up_to_frames, resumed)
        )

    def append(self, row: Mapping[str, float]) -> None:
        """Add one row; it is on disk when this returns. Columns not seen before join the header."""
        row = {column: float(value) for column, value in row.items()}
        if self._resumed is not None:
            self._keep_previous()
            self._rewrite([*self._resumed, row])
            self._resumed = None
        elif not row.keys() <= set(self._columns):
            self._rewrite([*self.rows(), row])
        else:
            with self.path.open("a", newline="") as file:
                self._writer(file).writerow(row)

    def rows(self) -> list[dict[str, float]]:
        """Return all rows so far, each with the columns it has a number for."""
        return read_rows(self.path) if self._resumed is None else list(self._resumed)

    def _keep_previous(self) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if self.path.exists():
            shutil.copyfile(self.path, self.path.with_name(self.path.name + ".previous"))

    def _rewrite(self, rows: list[dict[str, float]]) -> None:
        self._columns = list(dict.fromkeys(column for column in [*self._columns, *(c for row in rows for c in row)]))
        # Written beside and put in place in one step, so that a kill leaves either the old file or the new one.
        draft = self.path.with_name(self.path.name + ".draft")
        with draft.open("w", newline="") as file:
            writer = self._writer(file)
            writer.writeheader()
            writer.writerows(rows)
        draft.replace(self.path)

    def _writer(self, file: Any) -> csv.DictWriter[str]:
        return csv.DictWriter(file, self._columns, restval="", lineterminator="\n")


class Logger(Protocol):
    """Takes a run's numbers and figures somewhere besides `metrics.csv`."""

    def log(self, row: dict[str, float], step: int) -> None:
        """Take one row of metrics after `step` frames; steps never go down."""

    def images(self, paths: Iterable[Path]) -> None:
        """Take figures, under their file names."""

    def summary(self, figures: dict[str, Any]) -> None:
        """Take what closes the run; entries may be mappings."""

    def close(self) -> None:
        """Finish; nothing is logged afterwards."""


class CSVLogger:
    """Log nothing beyond the files that every run writes.

    Args:
        output_dir: the run's folder, where they are.
    """

    def __init__(self, output_dir: Path) -> None:
        self.output_dir = output_dir

    def log(self, row: dict[str, float], step: int) -> None:
        """Do nothing: the row is in `metrics.csv`."""

    def images(self, paths: Iterable[Path]) -> None:
        """Do nothing: the figures are in the folder."""

    def summary(self, figures: dict[str, Any]) -> None:
        """Do nothing: the summary is in `summary.json`."""

    def close(self) -> None:
        """Do nothing."""


class TensorboardLogger:
    """Log to TensorBoard event files.

    Args:
        output_dir: the run's folder; the events go to `tensorboard` in it.
    """

    def __init__(self, output_dir: Path) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self._writer = SummaryWriter(str(output_dir / "tensorboard"))
        self._step = 0

    def log(self, row: dict[str, float], step: int) -> None:
        """Write each metric as a scalar after `step` frames."""
        self._step = step
        for name, value in row.items():
            self._writer.add_scalar(name, value, step)

    def images(self, paths: Iterable[Path]) -> None:
        """Write figures under their file names."""
        import numpy as np
        from PIL import Image

        for path in paths:
            with Image.open(path) as image:
                self._writer.add_image(path.stem, np.asarray(image.convert("RGB")), self._step, dataformats="HWC")

    def summary(self, figures: dict[str, Any]) -> None:
        """Write the summary as a table in text."""
        lines = [f"| {name} | {value} |" for name, value in figures.items()]
        self._writer.add_text("summary", "\n".join(["| | |", "|---|---|", *lines]), self._step)

    def close(self) -> None:
        """Write what is left and close the file."""
        self._writer.close()


class WandbLogger:
    """Log to Weights & Biases without ever asking for anything or keeping a run from starting.

    Args:
        project, entity, group, name: as in `wandb.init`; None leaves the choice to wandb.
        mode: "auto" is what `WANDB_MODE` says, and without it online where an API key is configured (`WANDB_API_KEY`
            or netrc), offline elsewhere. "online" goes offline with a warning where there is no key or no answer.
        output_dir: the run's folder; offline runs lie in `wandb` in it, ready for `wandb sync`.
        config: the run's settings, to be shown beside its numbers.
    """

    def __init__(
        self,
        project: str,
        entity: str | None,
        group: str | None,
        name: str | None,
        mode: Literal["auto", "offline", "online", "disabled"],
        *,
        output_dir: Path,
        config: dict[str, Any] | None = None,
    ) -> None:
        import wandb

        output_dir.mkdir(parents=True, exist_ok=True)  # wandb goes to a temporary folder where this one is missing
        settings = wandb.Settings(
            silent=True,
            console="off",
            init_timeout=_WANDB_START,
            login_timeout=_WANDB_START,
            finish_timeout=_WANDB_FINISH,
        )
        where = {"project": project, "entity": entity, "group": group, "name": name, "dir": str(output_dir)}
        # Told to `setup` too: that silences the login and keeps an offline run from reporting its use over the network.
        settings.mode = _wandb_mode(mode, wandb.setup(settings).settings.base_url)
        wandb.setup(settings)
        try:
            self._run = wandb.init(**where, config=config, settings=settings)
        except wandb.errors.Error as error:
            if settings.mode != "online":
                raise
            reason, _, _ = str(error).partition("\n")
            warn(f"wandb could not start online, the run is logged offline: {reason}")
            settings.mode = "offline"
            wandb.setup(settings)
            self._run = wandb.init(**where, config=config, settings=settings)
        self._image = wandb.Image
        self._step = 0

    @property
    def is_offline(self) -> bool:
        """Whether the run stays on this machine."""
        return self._run.offline

    def log(self, row: dict[str, float], step: int) -> None:
        """Send one row of metrics after `step` frames."""
        self._step = step
        self._run.log(row, step=step)

    def images(self, paths: Iterable[Path]) -> None:
        """Send figures under their file names."""
        self._run.log({path.stem: self._image(str(path)) for path in paths}, step=self._step)

    def summary(self, figures: dict[str, Any]) -> None:
        """Send what closes the run."""
        self._run.summary.update(figures)

    def close(self) -> None:
        """Wait, for a minute at most, until everything is sent."""
        self._run.finish()


def _wandb_mode(mode: str, server: str) -> str:
    if mode == "auto":
        mode = os.environ.get("WANDB_MODE") or ("online" if _has_wandb_key(server) else "offline")
    if mode == "online" and not _has_wandb_key(server):
        warn("wandb has no API key (WANDB_API_KEY or netrc), the run is logged offline")
        return "offline"
    return mode


def _has_wandb_key(server: str) -> bool:
    if os.environ.get("WANDB_API_KEY"):
        return True
    host = urlsplit(server).netloc
    # Keys of wandb's own cloud may still be kept under its older name, where wandb finds them as well.
    hosts = [host, "api.wandb.ai"] if host == "api.forge.coreweave.com" else [host]
    files = [os.environ["NETRC"]] if "NETRC" in os.environ else [Path.home() / ".netrc", Path.home() / "_netrc"]
    for file in files:
        try:
            logins = netrc.netrc(str(file))
        except (OSError, netrc.NetrcParseError):
            continue
        if any(logins.authenticators(name) for name in hosts):
            return True
    return False


def _number(value: float) -> str:
    return f"{round(value, 3) + 0.0:.3f}"  # adding 0 turns -0.0 into 0.0


_PERCENT, _PRESSES = "{:.1%}".format, "{:.2f}".format
_TABLE = (
    ("score", "score", _number),
    ("human_normalised", "random 0, people 1", _number),
    ("success", "success", _PERCENT),
    ("too_fast", "too fast", _PERCENT),
    ("out_of_bounds", "out of bounds", _PERCENT),
    ("out_of_fuel", "out of fuel", _PERCENT),
    ("time_limit", "time limit", _PERCENT),
    ("presses", "presses an episode", _PRESSES),
    ("option_congruent", "congruent boat", _PERCENT),
    ("oracle_agreement", "oracle's choice", _PERCENT),
    ("optimality_gap", "gap to the ceiling", _number),
)
_REFERENCE_TITLES = {"random": "random", "human": "people", "best_person": "best person", "ceiling": "ceiling"}


def closing_table(summary: Mapping[str, Any]) -> str:
    """Return a plain aligned table of this agent beside random, people and the ceiling.

    Args:
        summary: the agent's figures under the names of `hpamdp.env.boatdock.reference`, `frames`, `wall_s`, and what
            `reference.references` reads. Rows that the agent has no figure for, and columns without any, are left out.
    """
    own = {name: summary.get(name) for name, _, _ in _TABLE}
    columns = {"this agent": own, **{_REFERENCE_TITLES[name]: row for name, row in references(summary).items()}}
    rows = [entry for entry in _TABLE if _is_known(own[entry[0]])]
    rows = [entry for entry in rows if has_choice(summary) or entry[0] not in CHOICE_FIGURES]
    columns = {t: f for t, f in columns.items() if any(_is_known(f.get(name)) for name, _, _ in rows)}
    cells = [["", *columns]] if rows else []
    for name, label, write in rows:
        known = [figures.get(name) for figures in columns.values()]
        cells.append([label, *(write(value) if _is_known(value) else "" for value in known)])
    widths = [max(len(cell) for cell in column) for column in zip(*cells, strict=True)]
    lines = ["   ".join([r[0].ljust(widths[0]), *map(str.rjust, r[1:], widths[1:])]).rstrip() for r in cells]
    return "\n".join([*lines, *_effort(summary)])


def _is_known(value: Any) -> bool:
    return value is not None and not math.isnan(value)


def _effort(summary: Mapping[str, Any]) -> list[str]:
    parts = []
    if _is_known(summary.get(FRAMES)):
        parts.append(f"{summary[FRAMES]:,.0f} frames")
    if _is_known(summary.get(WALL_SECONDS)):
        parts.append(duration(summary[WALL_SECONDS]))
    return [" in ".join(parts)] if parts else []


def duration(seconds: float) -> str:
    """Return a time in words, as precise as its length calls for."""
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02} min" if hours else f"{minutes} min {rest:02} s"
