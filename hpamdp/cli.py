"""The command line: Hydra composes the config, `hpamdp.run.train` runs it, a user's mistake is told in one line."""

from __future__ import annotations

import argparse
import errno
import importlib
import itertools
import os
import re
import sys
import textwrap
import uuid
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, NoReturn

import hydra
import yaml
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, QuotedString
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from hpamdp.config import (
    GROUPS,
    NESTED,
    RUN_FILE,
    ConfigError,
    beginning_of,
    choosing,
    conf_dir,
    job_overrides,
    no_such,
    no_such_option,
)
from hpamdp.limits import limit_in
from hpamdp.messages import (
    file_and_reason,
    first_line,
    lenient_streams,
    lost_output,
    one_line,
    reason_of,
    reopen_standard_streams,
    say,
    warn,
)
from hpamdp.run import sweep
from hpamdp.run.folder import AUTO, is_about_folder, locked
from hpamdp.search_path import protect_children, put_working_directory_last, unprotect_children
from hpamdp.shell import program, setting
from hpamdp.yaml_files import check_before_hydra_reads

_MISTAKE, _INTERRUPTED = 2, 130
# Launchers and sweepers of packages of their own, and the extra of pyproject.toml that brings each.
_EXTRAS = {
    "hydra/launcher": {"joblib": "joblib", "submitit_local": "slurm", "submitit_slurm": "slurm", "ray": "ray-launcher"},
    "hydra/sweeper": {"optuna": "optuna"},
}
# Commands beside that of a run, by the modules whose `main` gets the words that follow, and a parser.
_COMMANDS = {"watch": "hpamdp.run.watch", "play": "hpamdp.run.play"}
# What Hydra raises for a wrong command line or yaml file.
_BEFORE_A_JOB = (HydraException, OmegaConfBaseException, yaml.YAMLError, OSError, ValueError, RecursionError)
_GRAMMAR = "not understood; write GROUP=CHOICE or KEY=VALUE"
# Errors that no other setting can avoid: a full disk, limits of the process, a medium that is read only.
_OF_THE_MACHINE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.EROFS)
_SAVED_RUNS = ("resume", "checkpoint", "low.checkpoint")

_HELP = """\
hpamdp trains and scores two-level agents on parameterised-action MDPs: a selector (high) chooses an option; a learner
(low) chooses a discrete action and its parameters at every step.

Usage: {program} [GROUP=CHOICE ...] [GROUP.OPTION=VALUE ...] [VALUE=... ...] [--multirun]

Groups and their choices
{groups}
  The options of a choice are explained in conf/GROUP/CHOICE.yaml in {folder}

Values of the run, with their defaults
{values}

Examples
  {program} high=ucb low=hyar
      trains; the results go to a folder of their own in outputs/
  {program} mode=eval checkpoint=outputs/2025-01-31/12-00-00 eval.layouts=5000
      scores the agent of an earlier run
  {program} --multirun high=ucb,uniform seed=0,1,2 eval.every=50000
      six runs one after another, in multirun/; with hydra.sweep.dir=FOLDER a second start does what is left
  {program} --multirun high=ucb,uniform seed=0,1,2 hydra/launcher=joblib hydra.launcher.n_jobs=2
      the same, two at a time; needs hpamdp[joblib]

  {program} play
      lets you play the problem yourself; see {program} play --help
  {program} watch FOLDER
      films the agent of a run; see {program} watch --help
  {program} low=hyar --cfg job
      shows every value and option without running
  {program} --hydra-help
      shows Hydra's own flags
"""


def main() -> None:
    """Run the command line.

    Exits with 0, 1 (a bug, with its traceback), 2 (a user's mistake, told in one line) or 130 (interrupted).
    """
    reopen_standard_streams()
    with lenient_streams():
        _main()


def _main() -> None:
    # Classes of one's own may lie in the working directory, as with `python -m`.
    put_working_directory_last()
    # Hydra then raises what it would print, in several lines, itself.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    # TorchRL logs every replay buffer that it fills.
    os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")
    # Hydra warns about a missing folder, but `read` refuses it anyway.
    warnings.filterwarnings("ignore", message="provider=hydra.searchpath")
    try:
        _check_surroundings()
        if sys.argv[1:2] and sys.argv[1] in _COMMANDS:
            with _limits_explained():
                sys.exit(_run_command(sys.argv[1], sys.argv[2:]))
        conf = conf_dir()
        arguments = _parse()
        if arguments.help:
            say(help_page(conf))
            _check_shown()
            return
        _run_hydra(conf, arguments)
    except OverrideParseException as error:
        _exit_with(_not_understood(error.override))
    except ConfigError as error:
        _exit_with(str(error))
    except _LostOutputError as error:
        if isinstance(error.__cause__, BrokenPipeError):  # the reader has seen enough
            sys.exit(1)
        _exit_with(f"stdout: {reason_of(error.__cause__)}", 1)
    except KeyboardInterrupt:
        sys.exit(_INTERRUPTED)


_NEEDS = {"files": "more open files, see ulimit -n", "memory": "more memory, see ulimit -v"}


@contextmanager
def _limits_explained() -> Iterator[None]:
    """Exit with 1 and one line if the process runs out of files or memory, whichever library raises the error."""
    try:
        yield
    except ConfigError:
        raise
    except Exception as error:
        cause: BaseException | None = error
        while cause is not None:
            limit = limit_in(cause)
            if limit in _NEEDS:
                _exit_with(f"{first_line(cause) or type(cause).__name__}: the program needs {_NEEDS[limit]}", 1)
            cause = cause.__cause__ or cause.__context__
        raise


def _check_surroundings() -> None:
    """Refuse a working directory that is gone and words that are no text."""
    try:
        os.getcwd()
    except OSError as error:
        raise ConfigError(f"the working directory is gone ({error.strerror}); cd to another one") from error
    for word in sys.argv[1:]:
        if "\0" in word or word != word.encode(errors="ignore").decode():
            raise ConfigError(f"{word!r}: not written in UTF-8")


def _completed(arguments: argparse.Namespace, conf: Path) -> argparse.Namespace:
    """Complete the command line: the choices of a saved run, the experiments of a folder, the folder of their sweep."""
    _check_groups(arguments.overrides, conf)
    saved = _saved_choices(arguments, conf)
    if saved:
        place = sys.argv.index(arguments.overrides[0])
        sys.argv[place:place] = saved
        arguments = _parse()
    written_out = _folder_written_out(arguments, conf)
    if written_out is not None:
        sys.argv[:] = written_out
        arguments = _parse()
    sweep_dir = _sweep_dir_of_experiments(arguments, conf)
    if sweep_dir is not None:
        sys.argv.insert(sys.argv.index(arguments.overrides[0]), f"hydra.sweep.dir='{sweep_dir}'")
        arguments = _parse()
    return arguments


def _run_command(name: str, words: list[str]) -> int:
    """Run a command that has options of its own, and return its exit code."""
    command = importlib.import_module(_COMMANDS[name])
    from hpamdp.env.base import ProblemError  # takes seconds, which the other commands need not wait for
    from hpamdp.run.stopping import ProgramExitError, exits_explained

    parser = _Parser(prog=f"{program()} {name}", formatter_class=argparse.RawDescriptionHelpFormatter)
    try:
        with exits_explained():
            return command.main(words, parser)
    except ProblemError as error:
        raise ConfigError(f"env: {first_line(error)}") from error
    except ProgramExitError as error:
        _exit_with(str(error), 1)


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        raise ConfigError(f"{message}; see {self.prog} --help")

    def print_help(self, file: Any = None) -> None:
        super().print_help(file)
        _check_shown()


class _LostOutputError(Exception):
    """Some text that the user asked for was not written; the cause is the stream's error."""


def _check_shown() -> None:
    """Check that the text which the user asked for has been written.

    Raises:
        _LostOutputError: some of it has not.
    """
    error = lost_output()
    if error is not None:
        raise _LostOutputError from error


def _run_hydra(conf: Path, arguments: argparse.Namespace) -> None:
    """Let Hydra run the job, or the jobs of a sweep, and tell mistakes in the command line in one line."""
    has_started = False
    start = uuid.uuid4().hex

    def job(cfg: DictConfig) -> float | None:
        nonlocal has_started
        has_started = True
        with _limits_explained():
            return _run_job(cfg, start)

    protect_children()
    try:
        check_before_hydra_reads()
        arguments = _completed(arguments, conf)
        hydra.main(version_base="1.3", config_path=str(conf), config_name="config")(job)()
    except (Exception, KeyboardInterrupt, SystemExit) as error:
        if _only_shows(arguments) and isinstance(error, SystemExit):
            _check_shown()
        if sweep.has_begun(start):
            sys.exit(sweep.report(start, error))
        if isinstance(error, RuntimeError) and "srun" in str(error):  # which submitit looks for
            raise ConfigError(f"hydra/launcher=submitit_slurm: {error}") from error
        # Once a job has started, such errors are not about the command line.
        if not has_started and isinstance(error, _BEFORE_A_JOB) and not isinstance(error, ConfigError):
            is_mistake = not isinstance(error, OSError) or error.errno not in _OF_THE_MACHINE
            _exit_with(_explain(error, conf, arguments), _MISTAKE if is_mistake else 1)
        raise
    finally:
        unprotect_children()
    if _only_shows(arguments):
        _check_shown()
        return
    if sweep.has_begun(start):
        sys.exit(sweep.report(start))
    if arguments.multirun:
        raise ConfigError(f"{' '.join(arguments.overrides)}: stands for no job; see that no sweep is empty")


def _only_shows(arguments: argparse.Namespace) -> bool:
    return bool(arguments.cfg or arguments.info or arguments.hydra_help or arguments.shell_completion)


def help_page(conf: Path) -> str:
    """Return the text of `--help`: the groups as the folders have them, the run's values as config.yaml has them."""
    groups = {folder.name: _choices(folder) for folder in sorted(conf.iterdir()) if folder.is_dir()}
    # From the comment above the first value to the part that is Hydra's.
    values = re.search(
        r"^(?:# [^\n]*\n)+mode:.*?(?=^hydra:)", (conf / "config.yaml").read_text(), re.DOTALL | re.MULTILINE
    )
    return _HELP.format(
        program=program(),
        groups="\n".join(f"  {group:<12}{', '.join(choices)}" for group, choices in groups.items()),
        folder=conf.parent,
        values=textwrap.indent(values.group().rstrip() if values else "", "  "),
    )


def _choices(folder: Path) -> list[str]:
    """Return the choices in a group's folder. Experiments may lie in folders there, which stand for all in them."""
    files = folder.rglob("*.yaml") if folder.name == "experiment" else folder.glob("*.yaml")
    names = [file.relative_to(folder).with_suffix("") for file in files]
    return sorted({str(choice) for name in names for choice in (name, *name.parents[:-1])})


def _parse() -> argparse.Namespace:
    """Read the flags as Hydra will, and refuse what it refuses with a traceback or a page of text."""

    def refuse(message: str) -> NoReturn:
        # argparse takes the settings on one side of a flag for all of them.
        split = re.fullmatch(r"unrecognized arguments: ([^-].*=.*)", message)
        if split:
            raise ConfigError(f"{split.group(1)}: settings on both sides of a flag; write all of them after the flags")
        dashed = re.fullmatch(r"unrecognized arguments: --([^ =-][^ =]*=[^ ]*)( .*)?", message)
        if dashed:
            word = dashed.group(1)
            raise ConfigError(f"--{word}: settings have no dashes, write {word}; a wandb sweep ${{args_no_hyphens}}")
        raise ConfigError(f"{message}; see --help")

    parser = get_args_parser()
    parser.error = refuse  # type: ignore[method-assign]  # Hydra makes the parser, and its own prints two lines
    try:
        arguments = parser.parse_args()
    except SystemExit:  # --version
        _check_shown()
        raise
    flags = ("run", "multirun", "cfg", "info", "shell_completion")
    given = [f"--{flag.replace('_', '-')}" for flag in flags if getattr(arguments, flag)]
    if len(given) > 1:
        refuse(f"{' and '.join(given)} do not go together")
    if arguments.resolve and not arguments.cfg:
        refuse("--resolve goes with --cfg only")
    if arguments.experimental_rerun:
        refuse("--experimental-rerun is not supported, use resume=FOLDER")
    return arguments


def _check_groups(words: list[str], conf: Path) -> None:
    """Refuse a choice that is no name, such as `low=3`, on which Hydra ends in a traceback."""
    for override in OverridesParser.create().parse_overrides(words):
        if not override.key_or_group or override.key_or_group == "hydra":
            raise ConfigError(f"{override.input_line}: {_GRAMMAR}")
        if override.is_delete() and override.key_or_group in GROUPS:
            raise ConfigError(f"{override.key_or_group}: nothing chosen; set {override.key_or_group}=NAME")
        is_text = override.is_sweep_override() or isinstance(override.value(), str | QuotedString | None)
        if override.key_or_group in _SAVED_RUNS and not override.is_delete() and not is_text:
            raise ConfigError(f"{override.input_line}: must be a folder; write {_as_text(override.input_line or '')}")
        folder = conf / override.key_or_group
        if not os.path.isdir(folder) or override.is_delete():  # unlike `Path.is_dir` for any text
            continue
        values = override.sweep_iterator() if override.is_discrete_sweep() else [override.value()]
        if not all(_is_choice(value) for value in values):
            raise ConfigError(
                f"{override.input_line}: no such choice; conf/{folder.name} has {', '.join(_choices(folder))}"
            )


def _saved_choices(arguments: argparse.Namespace, conf: Path) -> list[str]:
    """Return the choices of the run that this one starts from, as words of the command line, without those given."""
    overrides = OverridesParser.create().parse_overrides(arguments.overrides)
    values = {o.key_or_group: o.value() for o in overrides if not o.is_sweep_override() and not o.is_delete()}
    where = "resume" if values.get("resume") else "checkpoint"
    source = values.get(where)
    source = source.text if isinstance(source, QuotedString) else source
    if not isinstance(source, str) or not source or "${" in source:
        return []
    if where == "checkpoint" and values.get("mode") != "eval":
        return []  # which is refused
    if arguments.multirun or (where == "resume" and source == AUTO):
        return []  # the command line alone describes the run
    from hpamdp.run.resume import saved_choices  # takes seconds, which --help need not wait for

    given = {override.key_or_group for override in overrides}
    has_own_files = arguments.config_dir is not None or "hydra.searchpath" in given
    choices = saved_choices(source, where, arguments.overrides)
    return [
        choosing(group, name)
        for group, name in choices.items()
        if group not in given and (has_own_files or os.path.isfile(conf / group / f"{name}.yaml"))
    ]


def _folder_written_out(arguments: argparse.Namespace, conf: Path) -> list[str] | None:
    """Return the command line with `experiment=FOLDER` written out as a sweep over all in it; None without that."""
    for override in OverridesParser.create().parse_overrides(arguments.overrides):
        if override.key_or_group != "experiment" or override.is_delete() or override.is_sweep_override():
            continue
        name = override.value()
        folder = conf / "experiment" / str(name.text if isinstance(name, QuotedString) else name)
        if not os.path.isdir(folder):
            continue
        experiments = ",".join(f"{folder.name}/{file.stem}" for file in sorted(folder.glob("*.yaml")))
        words = [f"experiment={experiments}" if word == override.input_line else word for word in sys.argv]
        if not arguments.multirun:
            words.insert(sys.argv.index(arguments.overrides[0]), "--multirun")
        return words
    return None


def _sweep_dir_of_experiments(arguments: argparse.Namespace, conf: Path) -> str | None:
    """Return the folder that all experiments of a sweep over experiments name; None where there is nothing to add.

    Hydra takes a sweep's folder from the config without swept groups, in which no experiment is chosen.

    Raises:
        ConfigError: they name different ones.
    """
    overrides = OverridesParser.create().parse_overrides(arguments.overrides)
    given = {override.key_or_group: override for override in overrides}
    experiments = given.get("experiment")
    if not arguments.multirun or "hydra.sweep.dir" in given:
        return None
    if experiments is None or not experiments.is_discrete_sweep():
        return None
    search_path: list[str] = []
    if "hydra.searchpath" in given:
        search_path = [given["hydra.searchpath"].input_line or ""]
    elif arguments.config_dir is not None:
        search_path = [f"hydra.searchpath=['{Path(arguments.config_dir).absolute()}']"]
    folders: list[str] = []
    for choice in _written_out(experiments):
        try:
            with hydra.initialize_config_dir(str(conf), version_base="1.3"):
                cfg = hydra.compose("config", [choice, *search_path], return_hydra_config=True)
        except (HydraException, OmegaConfBaseException):
            return None  # which Hydra will tell
        settings: Any = OmegaConf.to_container(cfg.hydra.sweep, resolve=False)
        folders.append(settings["dir"])
    folders = list(dict.fromkeys(folders))
    if len(folders) > 1:
        different = f"their sweeps have different folders, {' and '.join(folders)}"
        raise ConfigError(f"{experiments.input_line}: {different}; set hydra.sweep.dir")
    return None if "${" in folders[0] else folders[0]


def _is_choice(value: object) -> bool:
    """Return whether the value can name a yaml file in a group's folder, or in a folder there."""
    if not isinstance(value, str | QuotedString):
        return False
    name = value if isinstance(value, str) else value.text
    return not set(name.split("/")) & {"", "..", "."}


def _run_job(cfg: DictConfig, start: str) -> float | None:
    """Run one job; return its score if it is one of a sweep."""
    put_working_directory_last()  # in a worker of a launcher, too
    with suppress(OSError):  # its first user reports the error
        resource_tracker.ensure_running()  # a helper process of Python, started while children are protected
    unprotect_children()
    job = HydraConfig.get()
    if job.job.chdir:
        _stay(job.runtime.cwd)
    if job.mode == RunMode.MULTIRUN:
        return sweep.run_job(cfg, start)
    # These take seconds, which --help need not wait for.
    from hpamdp.run import train

    output_dir = Path(job.runtime.output_dir)
    if output_dir.resolve() == Path(job.runtime.cwd):
        _exit_with("hydra.run.dir: the working directory; give a folder of the run's own, or leave hydra.run.dir out")
    try:
        with locked(output_dir):
            if cfg.resume == AUTO:
                code = _go_on(cfg, output_dir)
            else:
                code = train.run(cfg, output_dir, job_overrides())
    except ConfigError as error:
        # Not raised any further: Hydra would announce it in a line of its own.
        with suppress(OSError):
            output_dir.rmdir()  # Hydra made it; it stays if there is something in it
        _exit_with(str(error))
    except OSError as error:
        if not is_about_folder(error, output_dir):
            raise
        _exit_with(f"{output_dir}: {reason_of(error)}; the run was stopped", 1)
    if code:
        sys.exit(code)
    return None


def _go_on(cfg: DictConfig, output_dir: Path) -> int:
    """Continue the run in its folder, or start it there; return the exit code.

    Raises:
        ConfigError: the folder holds the results of another run.
    """
    from hpamdp.run import train
    from hpamdp.run.continuation import rest_of
    from hpamdp.run.resume import resolve

    cfg.resume = None
    words = job_overrides()
    score, source = rest_of(resolve(cfg, words)[0], output_dir, f"resume=auto: {output_dir}")
    if score is not None:
        say(f"{output_dir}: this run is finished, with score {score:.3f}")
        return 0
    if source is not None:
        say(f"Going on from {source}")
    return train.run(cfg, output_dir, words, source, may_overwrite=True)


def _stay(directory: str) -> None:
    """Go back to the working directory, from which all relative paths of a command line and its yaml files count."""
    os.chdir(directory)
    warn(f"hydra.job.chdir=true: the run stays in {directory}, so that relative paths stay right")


def _exit_with(mistake: str, code: int = _MISTAKE) -> NoReturn:
    warn(one_line(mistake))
    sys.exit(code)


def _explain(error: Exception, conf: Path, arguments: argparse.Namespace) -> str:
    """Return in one line what is wrong with the command line or the yaml files, given what Hydra says."""
    if isinstance(error, OverrideParseException):
        return _not_understood(error.override)
    if isinstance(error, MissingConfigException) and error.missing_cfg_file and error.options:
        group, _, name = error.missing_cfg_file.rpartition("/")
        if group in _EXTRAS:
            return _missing_plugin(group, name, error.options)
        if not group.startswith("hydra"):  # a folder of a group may be part of the choice
            group, _, name = error.missing_cfg_file.partition("/")
        options = {*error.options, *_choices(conf / group)}
        return f"{group}={name}: no such choice; conf/{group} has {', '.join(sorted(options))}"
    if not isinstance(error, HydraException | OmegaConfBaseException):
        return _first_lines(error, arguments.overrides)
    overrides = OverridesParser.create().parse_overrides(arguments.overrides)
    for override in overrides:
        if override.is_sweep_override() and not arguments.multirun:
            several = f"{override.input_line}: several values; add --multirun to run them all, or put a list in [ ]"
            return f"{several}; for one text write {_as_text(override.input_line or '')}"
    return _wrong_key(overrides, conf) or _first_lines(error, arguments.overrides)


def _not_understood(word: str) -> str:
    """Return that a word is not in Hydra's grammar, and how to write it if its value is a text."""
    if re.match(r"[+~]*[A-Za-z_@][\w.@/]*=.", word):
        return f"{word}: {_GRAMMAR}, and a text with special characters as {_as_text(word)}"
    return f"{word}: {_GRAMMAR}"


def _as_text(word: str) -> str:
    """Return `KEY=VALUE` quoted for the shell and Hydra, so that the value is a text."""
    key, _, value = word.partition("=")
    return setting(key, value)


def _missing_plugin(group: str, name: str, installed: Sequence[str]) -> str:
    if name in _EXTRAS[group]:
        return f"{group}={name}: not installed; pip install 'hpamdp[{_EXTRAS[group][name]}]'"
    return f"{group}={name}: no such choice; there is {', '.join(sorted({*installed, *_EXTRAS[group]}))}"


def _first_lines(error: Exception, words: Sequence[str]) -> str:
    """Return in one line the place of an error in a yaml file, or the messages of an error and its cause."""
    if isinstance(error, yaml.MarkedYAMLError) and error.problem_mark is not None:
        return f"{error.problem_mark.name}, line {error.problem_mark.line + 1}: {error.problem}"
    if isinstance(error, UnicodeDecodeError):  # which does not name the file
        return f"a yaml file that was chosen is not written in UTF-8 ({error})"
    if isinstance(error, OSError):
        return file_and_reason(error)
    if isinstance(error, RecursionError | ValueError) and not isinstance(error, OmegaConfBaseException):
        return beginning_of(words) + (NESTED if isinstance(error, RecursionError) else first_line(error))
    causes = [error] if error.__cause__ is None else [error, error.__cause__]
    lines = [first_line(cause).rstrip(".") for cause in causes]
    if lines[0].endswith(":"):
        lines[:1] = [lines[0].rstrip(":"), first_line(str(error).partition("\n")[2])]
    return ": ".join(dict.fromkeys(line for line in lines if line)) or type(error).__name__


def _wrong_key(overrides: list[Override], conf: Path) -> str | None:
    """Return what is wrong with the first override whose key is not in the config, if there is one."""
    groups = [o for o in overrides if "/" in o.key_or_group or os.path.isdir(conf / o.key_or_group)]
    others = [o for o in overrides if o not in groups and not o.is_add() and not o.is_force_add()]
    for choices in itertools.product(*map(_written_out, groups)):
        try:
            with hydra.initialize_config_dir(str(conf), version_base="1.3"):
                cfg = hydra.compose("config", list(choices), return_hydra_config=True)
        except (HydraException, OmegaConfBaseException):
            return None
        for override in others:
            wrong = _missing_key(cfg, override.key_or_group, conf)
            if wrong is not None:
                return wrong
    return None


def _written_out(override: Override) -> list[str]:
    """Return the overrides, each with a single value, that one with a sweep stands for."""
    if not override.is_discrete_sweep():
        return [override.input_line or ""]
    return [f"{override.get_key_element()}={value}" for value in override.sweep_string_iterator()]


def _missing_key(cfg: DictConfig, key: str, conf: Path) -> str | None:
    """Return what is wrong with a dotted key that is not in the config; None if it is there."""
    node: Any = OmegaConf.to_container(cfg)
    names = key.split(".")
    for depth, name in enumerate(names):
        if not isinstance(node, dict):
            return None
        if name not in node:
            return f"{key}: {_no_such_key(cfg, names[:depth], name, node, conf)}"
        node = node[name]
    return None


def _no_such_key(cfg: DictConfig, path: list[str], name: str, node: dict[str, Any], conf: Path) -> str:
    if not path:
        known = {*node, *(folder.name for folder in conf.iterdir() if folder.is_dir())} - {"hydra"}
        return no_such(f"group or value of the run ({RUN_FILE})", name, known)
    if len(path) == 1 and path[0] in GROUPS:
        file = f"conf/{path[0]}/{cfg.hydra.runtime.choices[path[0]]}.yaml"
        return no_such_option(node, name, file)
    return no_such(f"value of {'.'.join(path)}", name, node)


if __name__ == "__main__":
    main()
