"""Send a run's numbers and figures to TensorBoard, Weights & Biases or a logger of the user."""

from __future__ import annotations

import glob
import netrc
import os
import re
import shutil
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, cast, get_args
from urllib.parse import urlsplit

from pydantic import ValidationError

from hpamdp.messages import first_line, warn
from hpamdp.metrics_file import FRAMES, WALL_SECONDS
from hpamdp.run.options import CARDS, WandbOptions
from hpamdp.run_files import TENSORBOARD_NAME, WANDB_NAME
from hpamdp.settings import SettingError


class EarlierRun(NamedTuple):
    """The folder of the continued run, and its rows of metrics up to the checkpoint."""

    folder: Path
    rows: Sequence[Mapping[str, float]]


# Seconds that an online wandb run may keep the training waiting, at its start and at its end.
_WANDB_START, _WANDB_FINISH = 20.0, 60.0

WandbMode = Literal["online", "offline", "disabled"]


class Logger(Protocol):
    """Sends a run's numbers and figures to another place than `metrics.csv`.

    The program supplies the arguments `output_dir`, `config` and `earlier` of a constructor that has them. `earlier` is
    an `EarlierRun` if a run is continued, else None.
    """

    def log(self, row: dict[str, float], step: int) -> None:
        """Take one row of metrics after `step` frames. `step` never decreases."""

    def images(self, paths: Iterable[Path]) -> None:
        """Take figures, under their file names."""

    def film(self, path: Path) -> None:
        """Take a GIF of episodes, under its file name."""

    def summary(self, figures: dict[str, Any]) -> None:
        """Take the figures of the run's summary; entries may be mappings."""

    def close(self) -> None:
        """Finish; nothing is logged afterwards."""


class LenientLogger:
    """A logger that may fail: after its first error, warn once and drop all later calls.

    Args:
        name: the logger's name, for the warning.
        start: a function that builds the logger. Its `ValueError` is a user's mistake and is raised.
    """

    def __init__(self, name: str, start: Callable[[], Logger]) -> None:
        self._name = name
        self._logger: Logger | None = None
        try:
            self._logger = start()
        except ValueError:
            raise
        except Exception as error:
            self._give_up(error)

    def call(self, act: Callable[[Logger], None]) -> None:
        """Act on the logger, unless it has failed before."""
        if self._logger is None:
            return
        try:
            act(self._logger)
        except Exception as error:
            self._give_up(error)

    def _give_up(self, error: Exception) -> None:
        warn(
            f"logger={self._name}: {type(error).__name__}: {first_line(error)}; the run continues without this logger, "
            "and metrics.csv has all numbers"
        )
        self._logger = None


class CSVLogger(Logger):
    """Log nothing beyond the files that every run writes."""

    card = CARDS["CSVLogger"]


class TensorboardLogger:
    """Log to a TensorBoard event file.

    The file is complete after each row, and holds the times of training. A resumed run deletes the old events, since
    they may go past its checkpoint, and writes its earlier rows again.

    Args:
        output_dir: the run's folder; the events go to `tensorboard` in it.
        earlier: the run that is continued, if any.
    """

    card = CARDS["TensorboardLogger"]

    def __init__(self, output_dir: Path, earlier: EarlierRun | None = None) -> None:
        from torch.utils.tensorboard import SummaryWriter

        folder = output_dir / TENSORBOARD_NAME
        rows = [] if earlier is None else earlier.rows
        if rows:
            for events in folder.glob("events.out.tfevents.*"):
                events.unlink()
        self._started = time.time() - (rows[-1].get(WALL_SECONDS, 0.0) if rows else 0.0)
        self._step, self._time = 0, self._started
        self._writer = SummaryWriter(str(folder))
        for row in rows:
            self.log(dict(row), int(row[FRAMES]))

    def log(self, row: dict[str, float], step: int) -> None:
        """Write each metric as a scalar after `step` frames."""
        self._step = step
        if WALL_SECONDS in row:
            self._time = self._started + row[WALL_SECONDS]
        for name, value in row.items():
            self._writer.add_scalar(name, value, step, self._time)
        self._writer.flush()

    def images(self, paths: Iterable[Path]) -> None:
        """Write figures under their file names."""
        import numpy as np
        from PIL import Image

        for path in paths:
            with Image.open(path) as picture:
                pixels = np.asarray(picture.convert("RGB"))
            self._writer.add_image(path.stem, pixels, self._step, self._time, dataformats="HWC")

    def film(self, path: Path) -> None:
        """Write the GIF unchanged; TensorBoard plays it."""
        from PIL import Image
        from tensorboard.compat.proto.summary_pb2 import Summary

        with Image.open(path) as image:
            width, height = image.size
        # `add_video` would encode the pictures again, and needs moviepy.
        encoded = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=path.read_bytes())
        events: Any = self._writer.file_writer
        events.add_summary(Summary(value=[Summary.Value(tag=path.stem, image=encoded)]), self._step, self._time)

    def summary(self, figures: dict[str, Any]) -> None:
        """Write the summary as a table in text."""
        lines = [f"| {name} | {value} |" for name, value in figures.items()]
        self._writer.add_text("summary", "\n".join(["| | |", "|---|---|", *lines]), self._step, self._time)

    def close(self) -> None:
        """Write what waits, and close the file."""
        self._writer.close()


class WandbLogger:
    """Log to Weights & Biases, without asking for input or keeping a run from starting.

    With the mode `online`, it warns and goes offline if there is no API key (`WANDB_API_KEY` or netrc) or no answer.
    Offline runs lie in `wandb` in the run's folder, ready for `wandb sync`.

    Args:
        output_dir: the run's folder.
        config: the run's settings, to show beside its numbers.
        earlier: the run that is continued, if any; the new run keeps its id.
    """

    Options = WandbOptions
    card = CARDS["WandbLogger"]

    def __init__(
        self,
        output_dir: Path,
        config: dict[str, Any] | None = None,
        earlier: EarlierRun | None = None,
        options: WandbOptions | None = None,
        **settings: Any,
    ) -> None:
        import wandb

        self.options: WandbOptions = WandbOptions.of(options, settings)
        project = self.options.project
        run_id = None if earlier is None else _wandb_id(earlier.folder)
        output_dir.mkdir(parents=True, exist_ok=True)  # if it is missing, wandb goes to a temporary folder
        try:
            wandb_settings = wandb.Settings(
                project=project,
                silent=True,
                console="off",
                init_timeout=_WANDB_START,
                login_timeout=_WANDB_START,
                finish_timeout=_WANDB_FINISH,
            )
            server = wandb.setup(wandb_settings).settings.base_url
        except wandb.errors.UsageError as error:
            raise SettingError(f"project={project}: {first_line(error)}") from error
        except ValidationError as error:  # of what wandb reads from the environment and from its own files
            wrong = error.errors()[0]
            raise SettingError(f"wandb: {'.'.join(map(str, wrong['loc']))}={wrong['input']}: {wrong['msg']}") from error

        def start(chosen: WandbMode) -> wandb.Run:
            # `setup` needs the mode, too: it silences the login, and keeps an offline run from reporting its use.
            wandb_settings.mode = chosen
            wandb.setup(wandb_settings)
            return wandb.init(
                project=project,
                entity=self.options.entity,
                group=self.options.group,
                name=self.options.name,
                id=run_id,
                resume="allow" if run_id is not None and chosen == "online" else None,
                dir=str(output_dir),
                config=config,
                # If an earlier job of a sweep failed before it finished its run, `init` would return that run.
                reinit="finish_previous",
                settings=wandb_settings,
            )

        chosen = _wandb_mode(self.options.mode, server)
        try:
            self._run = start(chosen)
        except wandb.errors.Error as error:
            if chosen != "online":
                raise
            warn(f"wandb could not start online, so the run is logged offline: {first_line(error)}")
            self._run = start("offline")
        self._image, self._video = wandb.Image, wandb.Video
        self._step = 0
        if earlier is not None:
            self._take_over(earlier.rows, output_dir)

    def _take_over(self, rows: Sequence[Mapping[str, float]], output_dir: Path) -> None:
        """Log the rows of the continued run, so that one offline run holds the whole curve.

        If the run is online, wandb drops the rows that the server already has.
        """
        for row in rows:
            self.log(dict(row), int(row[FRAMES]))
        if rows and self._run.offline:
            for folder in (output_dir / WANDB_NAME).glob(f"offline-run-*-{glob.escape(self._run.id)}"):
                if folder != Path(self._run.dir).parent:
                    shutil.rmtree(folder)

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

    def film(self, path: Path) -> None:
        """Send the GIF under its file name."""
        self._run.log({path.stem: self._video(str(path), format="gif")}, step=self._step)

    def summary(self, figures: dict[str, Any]) -> None:
        """Send the figures of the run's summary."""
        self._run.summary.update(figures)

    def close(self) -> None:
        """Wait until everything is sent, for a minute at most."""
        self._run.finish()


def _wandb_id(folder: Path) -> str | None:
    """Return the id of the wandb run in a run's folder, or None if the folder has no wandb run."""
    names = sorted(path.name for path in (folder / WANDB_NAME).glob("*run-*"))
    found = [re.fullmatch(r"(?:offline-)?run-\d{8}_\d{6}-(.+)", name) for name in names]
    ids = [match.group(1) for match in found if match]
    return ids[-1] if ids else None


def _wandb_mode(mode: str, server: str) -> WandbMode:
    if mode == "auto":
        mode = os.environ.get("WANDB_MODE") or ("online" if _has_wandb_key(server) else "offline")
    if mode not in get_args(WandbMode):
        raise SettingError(f"WANDB_MODE={mode}: must be one of {', '.join(get_args(WandbMode))}")
    if mode == "online" and not _has_wandb_key(server):
        warn("wandb has no API key (WANDB_API_KEY or netrc), so the run is logged offline")
        return "offline"
    return cast("WandbMode", mode)


def _has_wandb_key(server: str) -> bool:
    if os.environ.get("WANDB_API_KEY"):
        return True
    host = urlsplit(server).netloc
    # Keys of wandb's own cloud may still be stored under its older name, and wandb finds them there.
    hosts = [host, "api.wandb.ai"] if host == "api.forge.coreweave.com" else [host]
    with suppress(OSError, netrc.NetrcParseError):
        logins = netrc.netrc(os.environ.get("NETRC", str(Path.home() / ".netrc")))
        return any(logins.authenticators(name) for name in hosts)
    return False
