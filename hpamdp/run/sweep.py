"""Run sweeps: skip finished jobs, resume stopped ones, continue after failed ones, and report at the end."""

from __future__ import annotations

import functools
import json
import os
import shutil
import signal
import sys
import threading
import time
import traceback
from collections import Counter, defaultdict
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean
from typing import Any, ClassVar

from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from hpamdp.config.compose import job_overrides, setting_of
from hpamdp.config.errors import ConfigError
from hpamdp.config.schema import RESUME_AUTO
from hpamdp.files import replacing
from hpamdp.messages import DIVERGED, FAILED, INTERRUPTED, MISTAKE, one_line, reason_of, say, warn
from hpamdp.run.folder import has_foreign_error, is_about_folder, locked, write_error
from hpamdp.run.stopping import exits_explained, pass_on_signal
from hpamdp.run_files import ERROR_NAME, saved_summary
from hpamdp.shell import path_setting

_PATIENCE_S = 30.0  # for the running batch, after the sweep's process was killed
_LOCK_PATIENCE_S = 2 * _PATIENCE_S  # for jobs of a killed sweep, which still save
# States of a job. The first one holds until the job ends.
_RUNNING, _FINISHED, _RESUMED, _SKIPPED = "running", "finished", "resumed and finished", "skipped, finished before"
_STOPPED, _REFUSED, _FAILED = "stopped", "refused", "failed"


class SweepFolderCallback(Callback):
    """Remember the sweep's folder, which Hydra gives only to callbacks."""

    path: ClassVar[Path | None] = None

    def on_run_start(self, config: DictConfig, **_: Any) -> None:
        """Refuse the working directory as the run's folder, and `resume=auto` without a fixed folder."""
        _own_folder(config, "hydra.run.dir")

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Remember the sweep's folder, and refuse the same."""
        SweepFolderCallback.path = _own_folder(config, "hydra.sweep.dir")


def _own_folder(config: DictConfig, name: str) -> Path:
    """Return the folder. Exit if it is the working directory, or if `resume=auto` would never find the run again.

    Without a fixed folder each start makes a folder of its own.
    """
    settings: Any = OmegaConf.to_container(OmegaConf.select(config, name.rpartition(".")[0]), resolve=False)
    if config.resume == RESUME_AUTO and "${now:" in str(settings["dir"]):
        warn(f"resume=auto: goes on with the run in a folder, so give {name}")
        sys.exit(MISTAKE)
    folder = Path(os.path.abspath(OmegaConf.select(config, name)))
    if folder.resolve() == Path.cwd():
        warn(f"{name}: the working directory; give a folder of its own, or leave {name} out")
        sys.exit(MISTAKE)
    return folder


@dataclass
class Job:
    """State of one job. `settings` are its overrides without the seed."""

    number: int
    overrides: str
    settings: str
    folder: str
    state: str = _RUNNING
    score: float | None = None
    reason: str = ""


def write_job(job: Job, records: Path) -> None:
    """Save the state of a job, in a file of its own, because jobs may run in other processes or on other machines."""
    records.mkdir(parents=True, exist_ok=True)
    with replacing(records / f"{job.number}.json") as partial:
        partial.write_text(json.dumps(asdict(job)))


def read_jobs(records: Path) -> list[Job]:
    """Return the started jobs in their order."""
    jobs = [Job(**json.loads(file.read_text())) for file in records.glob("[0-9]*.json")]
    return sorted(jobs, key=lambda job: job.number)


def _records(sweep_dir: Path, start: str) -> Path:
    """Return the folder of the jobs' states of one start of a sweep."""
    return sweep_dir / ".sweep" / start


def run_job(cfg: DictConfig, start: str) -> float | None:
    """Run the rest of Hydra's current job, and return its score, or None if it failed.

    Args:
        cfg: the job's config.
        start: name of this start of the sweep, for `report`.

    Raises:
        SystemExit: the user stopped it.
    """
    hydra = HydraConfig.get()
    folder, overrides = Path(hydra.runtime.output_dir), job_overrides()
    settings = " ".join(word for word in overrides if setting_of(word) != "seed")
    job = Job(hydra.job.num, " ".join(overrides), settings, str(folder))
    records = _records(Path(hydra.runtime.cwd, hydra.sweep.dir), start)
    if hydra.runtime.choices["hydra/launcher"] != "basic":
        os.environ.setdefault("TQDM_DISABLE", "1")  # the bars of jobs side by side overwrite each other
        _stop_with_parent()
    write_job(job, records)
    say(f"Job {job.number}: {job.overrides}")
    try:
        with locked(folder, _LOCK_PATIENCE_S), exits_explained():
            job.state, job.score, job.reason = _run_rest(cfg, overrides, folder)
    except ConfigError as error:
        job.state, job.reason = _REFUSED, one_line(str(error))
        with suppress(OSError):
            folder.rmdir()  # it stays if it is not empty
    except Exception as error:
        job.state, job.reason = _FAILED, one_line("".join(traceback.format_exception_only(error)))
        if isinstance(error, OSError) and is_about_folder(error, folder):
            job.reason = f"its folder cannot be made or written to: {reason_of(error)}"
        write_error(folder, error)
    write_job(job, records)
    if job.state != _FINISHED:
        say(f"Job {job.number}: {job.state}{f': {job.reason}' if job.reason else ''}")
    if job.state == _STOPPED:
        pass_on_signal()
        sys.exit(INTERRUPTED)
    return job.score


def _run_rest(cfg: DictConfig, overrides: Sequence[str], folder: Path) -> tuple[str, float | None, str]:
    """Run the rest of the job in a folder, and return the job's state, its score and the reason of a failure."""
    from hpamdp.run import train  # takes seconds, which --help need not wait for

    if cfg.resume == RESUME_AUTO:  # as every sweep does
        cfg.resume = None
    reasons: list[str] = []
    score, is_resumed, code = train.go_on(cfg, folder, overrides, tell=reasons.append)
    if score is not None:
        return _SKIPPED, score, ""
    if code in (DIVERGED, FAILED):
        return _FAILED, None, one_line(" ".join(reasons))
    if code:
        return _STOPPED, None, ""
    return (_RESUMED if is_resumed else _FINISHED), saved_summary(folder).get("score"), ""


@functools.cache  # once a process, which may run several jobs
def _stop_with_parent() -> None:
    """Save and stop this process if its parent is killed, which joblib does not do."""
    threading.Thread(target=_watch, args=(os.getppid(),), daemon=True).start()


def _watch(parent: int) -> None:
    """Send signals to this process once it has another parent.

    On the first signal, training saves after the running batch. Later ones stop it at once.
    """
    while os.getppid() == parent:
        time.sleep(1.0)
    while True:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(_PATIENCE_S)


def has_begun(start: str) -> bool:
    """Return whether any job has started."""
    return SweepFolderCallback.path is not None and bool(read_jobs(_records(SweepFolderCallback.path, start)))


def report(start: str, error: BaseException | None = None) -> int:
    """Report on the sweep and return the exit code.

    Prints and writes the means over seeds, prints a tally, and warns of each failed job.

    Args:
        start: name of this start of the sweep.
        error: the error that ended the sweep early, if any.
    """
    sweep_dir = SweepFolderCallback.path
    assert sweep_dir is not None
    records = _records(sweep_dir, start)
    jobs = read_jobs(records)
    shutil.rmtree(records, ignore_errors=True)
    with suppress(OSError):  # another start of the sweep may use it
        records.parent.rmdir()
    is_stopped = isinstance(error, KeyboardInterrupt | SystemExit)
    for job in jobs:
        if job.state == _RUNNING:
            job.state, job.reason = (
                (_STOPPED, "") if is_stopped else (_FAILED, "ended without reporting a state, or is still running")
            )
    failed = [job for job in jobs if job.state in (_REFUSED, _FAILED)]
    if not is_stopped:
        _report_seeds(sweep_dir, jobs)
    _print_tally(jobs)
    for job in failed:
        folder = Path(job.folder)
        is_told = os.path.exists(folder / ERROR_NAME) and not has_foreign_error(folder)
        warn(f"{job.overrides}: {job.reason} ({_shown(folder / ERROR_NAME if is_told else folder)})")
    if is_stopped or (error is not None and len(failed) < len(jobs)):
        if error is not None and not is_stopped:
            told = sweep_dir / ERROR_NAME if write_error(sweep_dir, error) else sweep_dir
            reason = one_line("".join(traceback.format_exception_only(error)))
            warn(f"The sweep broke off: {reason} ({_shown(told)})")
        say(f"To go on: the same command with {path_setting('hydra.sweep.dir', _shown(sweep_dir))}")
        return INTERRUPTED if is_stopped else FAILED
    if not failed:
        return 0
    return MISTAKE if all(job.state == _REFUSED for job in failed) else FAILED


def _report_seeds(sweep_dir: Path, jobs: Sequence[Job]) -> None:
    """Print the table of means over seeds, and write it with its figure into the sweep's folder.

    All runs in the sweep's folder count, also those of earlier starts. If the working directory lies in that folder,
    only the runs of these jobs count.
    """
    # These imports take a second, which --help need not wait for.
    from hpamdp.analysis.seed_report import report_on

    folders = [] if Path.cwd().is_relative_to(sweep_dir) else [sweep_dir]
    folders += [Path(job.folder) for job in jobs]
    try:
        report = report_on(_shown(folder) for folder in folders if os.path.isdir(folder))
    except ConfigError:  # no job has become a run
        return
    say(report.table())
    try:
        files = report.write(sweep_dir)
    except ConfigError as error:
        warn(str(error))
    except OSError as error:
        warn(f"{_shown(sweep_dir)}: the report cannot be written: {reason_of(error)}")
    else:
        say(f"Written: {', '.join(str(_shown(file)) for file in files)}")


def _print_tally(jobs: list[Job]) -> None:
    counts = Counter(job.state for job in jobs)
    tally = "; ".join(f"{count} {state}" for state, count in counts.items())
    say(f"{len(jobs)} job{'' if len(jobs) == 1 else 's'}: {tally}")
    scores = defaultdict[str, list[float]](list)
    for job in jobs:
        if job.score is not None:
            scores[job.settings].append(job.score)
    if len(scores) > 1:
        settings, of_seeds = max(scores.items(), key=lambda entry: fmean(entry[1]))
        what = f", the mean over {len(of_seeds)} seeds: {settings}"
        if len(of_seeds) == 1:
            best = next(job for job in jobs if job.settings == settings and job.score is not None)
            what = f": {best.overrides} ({_shown(Path(best.folder))})"
        say(f"Best score {fmean(of_seeds):.3f}{what}")


def _shown(path: Path) -> Path:
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path
