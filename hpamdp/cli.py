"""Run the command line: Hydra composes the config, `hpamdp.run.train` runs it, and a mistake ends in one line."""

from __future__ import annotations

import argparse
import gc
import importlib
import os
import sys
import uuid
import warnings
from contextlib import suppress
from multiprocessing import resource_tracker
from pathlib import Path
from typing import NoReturn

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from hpamdp.children import children_protected, unprotect_children
from hpamdp.config.command_line import CommandLine, completed, parse, saved_run
from hpamdp.config.compose import conf_dir, job_overrides
from hpamdp.config.errors import ConfigError, problems_explained
from hpamdp.config.hydra_errors import BEFORE_A_JOB, explained
from hpamdp.config.schema import RESUME_AUTO
from hpamdp.env.errors import EnvironmentFaultError
from hpamdp.imports import collector_paused
from hpamdp.messages import (
    FAILED,
    INTERRUPTED,
    MISTAKE,
    exit_code,
    one_line,
    reason_of,
    say,
    warn,
)
from hpamdp.run import compatibility, sweep
from hpamdp.run.folder import is_about_folder, locked
from hpamdp.search_path import is_command_line, put_working_directory_last
from hpamdp.shell import program

# Further commands, and the modules whose `main` gets the words that follow and a parser.
_COMMANDS = {
    "watch": "hpamdp.commands.watch",
    "play": "hpamdp.commands.play",
    "report": "hpamdp.analysis.seed_report",
    "judge": "hpamdp.commands.judge",
    "datasets": "hpamdp.commands.datasets",
    "tune": "hpamdp.api.tuning",
}


def main() -> None:
    """Run the command line.

    The exit code is 0, 1 (a bug, with its traceback), 2 (a user's mistake, in one line) or 130 (interrupted).
    """
    code = exit_code(_main)
    if code:
        sys.exit(code)


def _main() -> None:
    # The user's own classes may lie in the working directory, as with `python -m`.
    put_working_directory_last()
    # Then Hydra raises its errors. Otherwise it would print them in several lines.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    # TorchRL logs every replay buffer that it fills.
    os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")
    # Hydra warns about a missing folder, but `read` refuses it anyway.
    warnings.filterwarnings("ignore", message="provider=hydra.searchpath")
    try:
        if sys.argv[1:2] and sys.argv[1] in _COMMANDS:
            sys.exit(_run_command(sys.argv[1], sys.argv[2:]))
        conf = conf_dir()
        line = parse(sys.argv[1:], conf)
        if line.flags["help"]:
            from hpamdp.config.help import help_page

            say(help_page(line, conf))
            return
        _run_hydra(line, conf)
    except ConfigError as error:
        _exit_with(str(error))
    except EnvironmentFaultError as error:  # of the user's own code: its lines of the traceback help, ours do not
        warn(error.line)
        sys.stderr.write(error.frames)
        sys.exit(FAILED)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


def _run_command(name: str, words: list[str]) -> int:
    """Run a command that has options of its own, and return its exit code."""
    with collector_paused():
        command = importlib.import_module(_COMMANDS[name])
    from hpamdp.run.stopping import ProgramExitError, exits_explained

    parser = _Parser(prog=f"{program()} {name}", formatter_class=argparse.RawDescriptionHelpFormatter)
    try:
        with exits_explained(), problems_explained():
            return command.main(words, parser)
    except ProgramExitError as error:
        _exit_with(str(error), FAILED)


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        raise ConfigError(f"{message}; see {self.prog} --help")


@children_protected()
def _run_hydra(line: CommandLine, conf: Path) -> None:
    """Let Hydra run the job or the sweep, and report mistakes in the command line in one line."""
    has_started = False
    start = uuid.uuid4().hex

    def job(cfg: DictConfig) -> float | None:
        nonlocal has_started
        has_started = True
        return _run_job(cfg, start)

    try:
        line = completed(_with_saved_choices(line), conf)
        sys.argv[1:] = line.argv()  # which Hydra parses
        hydra.main(version_base="1.3", config_path=str(conf), config_name="config")(job)()
    except (Exception, KeyboardInterrupt, SystemExit) as error:
        if sweep.has_begun(start):
            sys.exit(sweep.report(start, error))
        if isinstance(error, RuntimeError) and "srun" in str(error):  # which submitit looks for
            raise ConfigError(f"hydra/launcher=submitit_slurm: {error}") from error
        # Once a job has started, such errors are not about the command line.
        if not has_started and isinstance(error, BEFORE_A_JOB) and not isinstance(error, ConfigError):
            _exit_with(explained(error, line, conf))
        raise
    if sweep.has_begun(start):
        sys.exit(sweep.report(start))
    if line.is_multirun and not line.only_shows:
        raise ConfigError(f"{' '.join(line.words)}: no job to run; give every swept setting a value")


def _with_saved_choices(line: CommandLine) -> CommandLine:
    """Return the command line with the choices of the saved run that it names, if there is one."""
    saved = saved_run(line)
    if saved is None:
        return line
    from hpamdp.run.resume import saved_words  # takes seconds, which other commands need not wait for

    return line.with_words(saved_words(*saved, line.words))


def _run_job(cfg: DictConfig, start: str) -> float | None:
    """Run one job, and return its score if the job belongs to a sweep."""
    put_working_directory_last()  # in a worker of a launcher, too
    with suppress(OSError):  # its first user reports the error
        resource_tracker.ensure_running()  # a helper process of Python, started while children are protected
    unprotect_children()
    job = HydraConfig.get()
    if job.mode == RunMode.MULTIRUN:
        return sweep.run_job(cfg, start)

    output_dir = Path(job.runtime.output_dir)
    try:
        with locked(output_dir):
            is_new = cfg.resume is None and cfg.mode != "eval"  # a saved run completes other configs
            config = compatibility.checked(cfg, job_overrides()) if is_new else None  # before torch is imported
            with collector_paused():
                from hpamdp.run import train  # takes seconds, which a wrong setting need not wait for
            if is_command_line():  # whose process is its own
                gc.freeze()  # the collector then never searches the modules

            if cfg.resume == RESUME_AUTO:
                cfg.resume = None
                score, _, code = train.go_on(cfg, output_dir, job_overrides(), f"resume=auto: {output_dir}")
                if score is not None:
                    say(f"{output_dir}: this run is finished, with score {score:.3f}")
            else:
                code = train.run(cfg, output_dir, job_overrides(), config=config)
    except ConfigError as error:
        # If the error were raised further, Hydra would print another line about it.
        with suppress(OSError):
            output_dir.rmdir()  # Hydra made it; it stays if it is not empty
        _exit_with(str(error))
    except OSError as error:
        if not is_about_folder(error, output_dir):
            raise
        _exit_with(f"{output_dir}: {reason_of(error)}; the run was stopped", FAILED)
    if code:
        sys.exit(code)
    return None


def _exit_with(mistake: str, code: int = MISTAKE) -> NoReturn:
    warn(one_line(mistake))
    sys.exit(code)


if __name__ == "__main__":
    main()
