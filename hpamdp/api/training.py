"""Train agents, and load trained ones."""

from __future__ import annotations

import logging
import multiprocessing
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import torch
import torchrl
from torchrl.checkpoint import GlobalRNGState

from hpamdp.api.agent import Agent
from hpamdp.api.arguments import Problem, choices_and_settings, flag, path_argument, problem_of
from hpamdp.config.command_line import SEARCH_PATH
from hpamdp.config.compose import conf_dir, job_overrides, setting_of
from hpamdp.config.errors import ConfigError
from hpamdp.config.outside_jobs import check_is_single, check_no_sweep, choosing_class, composed, own_hydra, searching
from hpamdp.config.saved import choices_of
from hpamdp.config.schema import RESUME_AUTO, Config, RunConfig
from hpamdp.env.errors import closed_on_error
from hpamdp.env.facts import NAMING_SETTINGS
from hpamdp.messages import as_code, reason_of, say, warn
from hpamdp.metrics_file import read_rows
from hpamdp.run import checkpoint
from hpamdp.run.callbacks import Callback
from hpamdp.run.capacity import memory_errors_explained
from hpamdp.run.continuation import Rest, refuse_another, rest_of
from hpamdp.run.folder import locked
from hpamdp.run.players import load_agent
from hpamdp.run.resume import resolve, saved_words
from hpamdp.run.stopping import exits_explained
from hpamdp.run.train import begin, check_callbacks, problems_explained
from hpamdp.run_files import METRICS_NAME

# Groups of a trained agent, of which only classes from Python are given again.
_OF_AGENT = ("high", "low", "encoder", "exploration")
# Values of the run that count for a trained agent, too.
_OF_LOADING = ("device", "threads")
# Values of the run that are of use only if the run writes files.
_OF_FILES = ("checkpoint_every", "checkpoint_minutes", "film")


def train(
    env: Any = None,
    *,
    folder: str | Path | None = None,
    callbacks: Sequence[Callback] = (),
    config_dirs: Sequence[str | Path] = (),
    progress: bool = True,
    **settings: Any,
) -> Agent:
    """Train an agent, as `hpamdp SETTING=VALUE ...` does, and return it.

    Ctrl-C ends training after the current batch. Then the agent with what it has learned so far is returned. If several
    trainings run at once in threads, they share torch's random numbers. No seed then reproduces them, and a warning
    says so.

    Args:
        env: the problem. If None, the default of the command line. Otherwise one of these:

            - the name of a choice of `env`;
            - a Gymnasium id;
            - a function or a class that returns an environment of Gymnasium or TorchRL;
            - such an environment, which is copied and itself stays as it is;
            - a `PAMDPEnv` or its class;
            - a dict of `name` and settings.
        folder: folder of the run, as on the command line, created if it is missing. If None, nothing is written.
        callbacks: called during training; see `hpamdp.Callback`.
        config_dirs: folders of yaml files of your own, beside those of the package.
        progress: whether to show a bar, and at the end the table that the command line shows.
        settings: the settings of the command line by their names, such as `low="hppo"`, `high=None`,
            `total_frames=200_000`, `seed=1` or `collector="multi"`. Settings of a group follow its name:
            `low={"name": "hppo", "lr": 1e-3}`, or `**{"low.lr": 1e-3}`. Instead of a name a group takes a class.
            Settings of the problem may do without `env.`, as for `make`: `max_steps=50`.

    Raises:
        ConfigError: a value is wrong or given twice, values do not go together, or the folder holds another run. Then
            nothing is written.
        DivergedError: a reward, a loss or a weight is not finite.
        EnvironmentFaultError: the environment's own code raised an error, which is the cause.
        SystemExit: a worker process imports a script that calls this function outside `if __name__ == "__main__":`.
        RuntimeError: a worker process died, or somebody's code called `sys.exit`.

    Example:
        >>> import hpamdp
        >>> agent = hpamdp.train("platform", low="hppo", total_frames=20_000, progress=False)
    """
    _check_guarded()
    if settings.get("mode") == "eval":
        raise ConfigError("mode=eval: use hpamdp.load(...).evaluate()")
    flag("progress", progress)
    output_dir = None if folder is None else path_argument("folder", folder).absolute()
    callbacks = _checked_callbacks(callbacks)
    problem = problem_of(env)
    goes_on = settings.get("resume") == RESUME_AUTO
    _check_what_needs_runs(settings, output_dir)
    if goes_on:
        settings = {**settings, "resume": None}
    with _torch_restored(), exits_explained(), problems_explained(), ExitStack() as stack:
        with own_hydra(), composed(*_given(problem, settings, config_dirs)) as cfg:
            words = job_overrides()
            check_no_sweep(cfg, words)
            config, source = resolve(cfg, words, problem.objects)
            if output_dir is None:
                _check_no_files(config, words)
            stack.enter_context(memory_errors_explained(config))
            if output_dir is not None:
                stack.enter_context(_own_folder(output_dir))
            if goes_on and output_dir is not None:
                score, source = _rest_of(config, output_dir, [type(each).__name__ for each in callbacks])
                if score is not None:
                    return _finished_agent(config, output_dir, problem, config_dirs)
            trainer = begin(config, source, output_dir, words, may_overwrite=goes_on, callbacks=callbacks)
        stack.callback(trainer.parts.close)
        trainer.shows_progress = progress
        is_interrupted = trainer.train()
        table = trainer.finish(is_finished=not is_interrupted)
    if progress:
        say(table)
        if is_interrupted:
            say(f"Stopped at {trainer.frames:,}{trainer.unit}")
    parts = trainer.parts
    return Agent(config, parts.agent, parts.problem, trainer.progress(), trainer.recorder.metrics.rows())


def _check_what_needs_runs(settings: Mapping[str, Any], folder: Path | None) -> None:
    """Refuse settings about the run in a folder, or about a saved run, if there is none.

    Raises:
        ConfigError: there is such a setting.
    """
    if folder is None and settings.get("resume") == RESUME_AUTO:
        raise ConfigError("resume=auto: goes on with the run in a folder, so give folder")
    if folder is None and settings.get("overwrite") is True:
        raise ConfigError("overwrite=True: has no effect without a folder; give folder, or leave it out")
    if settings.get("trust") is True and settings.get("resume") is None:
        raise ConfigError("trust=True: has no effect without a saved run; give resume, or leave it out")


def _check_no_files(config: Config, words: Sequence[str]) -> None:
    """Refuse settings that ask for files, for a run without a folder.

    Raises:
        ConfigError: there is such a setting.
    """
    if config.logger.name != "csv":
        raise ConfigError(f"{config.logger}: writes files, so give the run a folder")
    for each in words:
        name = setting_of(each)
        if name in _OF_FILES and getattr(config.run, name):
            raise ConfigError(f"{each}: writes files, so give the run a folder")


def _given(
    problem: Problem, settings: Mapping[str, Any], config_dirs: Sequence[str | Path]
) -> tuple[list[str], list[tuple[str, Any]]]:
    """Return the words for folders and choices, also those of the run to resume, and all settings.

    Raises:
        ConfigError: the run to resume was trained on an object, which is not given again.
    """
    if problem.num_envs is not None:
        settings = {"num_envs": problem.num_envs, **settings}
    choices, own = choices_and_settings(settings)
    words = [*searching(config_dirs), *problem.words, *choices]
    if settings.get("resume") is not None:
        resumed, trust = str(settings["resume"]), ["trust=true"] if settings.get("trust") is True else []
        words = [*saved_words(resumed, "resume", [*words, *trust]), *words]
        _check_shared_names(checkpoint.find(resumed, "resume"), words)
        if not problem.words and not problem.objects:
            _check_problem(checkpoint.find(resumed, "resume"), [*settings, *dict(problem.settings)], "resume")
    return words, problem.with_settings(own)


def _check_guarded() -> None:
    """End a worker process that runs an unguarded script while it imports the script."""
    if getattr(multiprocessing.current_process(), "_inheriting", False):  # as multiprocessing checks it
        raise SystemExit(
            "hpamdp.train: a worker process imports this script again; put what the script runs below "
            'if __name__ == "__main__":'
        )


def _checked_callbacks(given: Any) -> list[Callback]:
    """Return the callbacks as a list; a single one counts as a list of one.

    Raises:
        ConfigError: it is not a list or tuple of callbacks.
    """
    callbacks = [given] if isinstance(given, Callback) else given
    if not isinstance(callbacks, list | tuple):
        raise ConfigError(f"callbacks={as_code(given)}: must be a list of objects of subclasses of hpamdp.Callback")
    check_callbacks(callbacks)
    return [*callbacks]


@contextmanager
def _own_folder(folder: Path) -> Iterator[None]:
    """Keep other processes out of a folder, and leave no empty folder behind if the run fails before it writes.

    Raises:
        ConfigError: the folder cannot be made.
    """
    missing = [each for each in (folder, *folder.parents) if not os.path.lexists(each)]
    try:
        with ExitStack() as stack:
            try:
                stack.enter_context(locked(folder))
            except OSError as error:
                raise ConfigError(f"folder={folder}: {reason_of(error)}") from error
            yield
    finally:
        with suppress(OSError):  # at the first folder that is not empty
            for each in missing:
                each.rmdir()


def _rest_of(config: Config, folder: Path, callbacks: Sequence[str]) -> Rest:
    """Return the rest of a run in a folder. Warn if its environment is an object, which no config tells apart."""
    rest = rest_of(config, folder, callbacks=callbacks)
    if config.env.objects and rest != Rest():
        warn(
            f"resume='auto': {folder} holds a run of an environment given as an object, too; whether it was the same "
            "one is not known"
        )
    return rest


@contextmanager
def _torch_restored() -> Iterator[None]:
    """Compute gradients, and give back torch's threads and all random numbers afterwards. A run sets its own.

    TorchRL would log every replay buffer that it fills.
    """
    threads, generators, level = torch.get_num_threads(), GlobalRNGState().state_dict(), torchrl.logger.level
    torchrl.logger.setLevel(max(level, logging.WARNING))
    try:
        with torch.inference_mode(False), torch.enable_grad():
            yield
    finally:
        torch.set_num_threads(threads)
        GlobalRNGState().load_state_dict(generators)
        torchrl.logger.setLevel(level)


@own_hydra()
def load(
    source: str | Path,
    env: Any = None,
    *,
    config_dirs: Sequence[str | Path] = (),
    trust: bool = False,
    **settings: Any,
) -> Agent:
    """Load a trained agent.

    Args:
        source: the folder of a run, a file in it, or a file that `Agent.save` wrote. The name of an agent that comes
            with the package, such as `hppo_platform`, works as well.
        env: the problem, as for `train`. If None, that of the training. An agent that was trained on an object needs
            it again.
        config_dirs: folders of yaml files of your own, if the training had them.
        trust: whether the file may name code to run, such as the entry point of an environment. If so, the folders of
            yaml files that the training had are searched, too.
        settings: `device`, `threads`, and settings of the problem and of evaluations, such as `max_steps=50` and
            `**{"eval.seed": 7}`. An agent that was trained with classes from Python needs them again in a new process:
            `low=MyLearner`, and likewise `high`, `encoder` and `exploration`.

    Raises:
        ConfigError: there is no such agent, it does not fit the problem, or it needs your trust.

    Example:
        >>> import hpamdp
        >>> hpamdp.load("hppo_platform").specs.parameter_dims
        (1, 1, 1)
    """
    flag("trust", trust)
    file = checkpoint.find(path_argument("load", source), "load")
    problem = problem_of(env)
    _check_classes(file, settings)
    given = {name: value for name, value in settings.items() if name not in _OF_AGENT}
    for name in given:
        group = name.partition(".")[0]
        is_of_run = group in RunConfig.model_fields or (conf_dir() / group).is_dir()
        if is_of_run and group not in ("env", "eval") and name not in _OF_LOADING:
            raise ConfigError(f"{name}: has no effect on a trained agent; leave it out")
    choices, own = choices_and_settings(given)
    own = problem.with_settings(own)
    words = [*searching(config_dirs), *problem.words, *choices, *(["trust=true"] if trust else [])]
    if env is None:
        _check_problem(file, given, "load")
    _check_shared_names(file, [*settings, *words])
    return _loaded(file, words, own, problem.objects)


def _loaded(file: Path, words: Sequence[str], settings: Sequence[tuple[str, Any]], objects: Mapping[str, Any]) -> Agent:
    """Return the agent of a file, and the metrics beside it."""
    with _torch_restored(), problems_explained():
        loaded = load_agent(str(file), words, settings, objects, where="agent")
    with closed_on_error(loaded.env):
        return Agent(loaded.config, loaded.agent, loaded.env, loaded.progress, read_rows(file.parent / METRICS_NAME))


def _finished_agent(config: Config, folder: Path, problem: Problem, config_dirs: Sequence[str | Path]) -> Agent:
    """Return the agent of a finished run. It needs no trust: it is built as this config would build it.

    Raises:
        ConfigError: the saved agent has another config than the run.
    """
    file = checkpoint.find(folder, "load")
    refuse_another(config, checkpoint.progress_of(file)["config"], str(file))
    folders = searching(config_dirs) or [f"{SEARCH_PATH}=[]"]  # instead of those that the file names
    return _loaded(file, [*folders, *problem.words, "trust=true"], problem.with_settings(), problem.objects)


def _check_classes(file: Path, settings: Mapping[str, Any]) -> None:
    """Make the passed classes of a saved agent known, as in a process that has not trained it.

    Raises:
        ConfigError: the agent has another class, or a setting of the agent is no class.
    """
    given = [group for group in _OF_AGENT if group in settings]
    choices = choices_of(checkpoint.progress_of(file)["config"]) if given else {}
    for group in given:
        cls = settings[group]
        if not isinstance(cls, type):
            raise ConfigError(f"{group}: a trained agent keeps it; pass its class alone, or leave it out")
        if choosing_class(group, cls) != choices[group]:
            raise ConfigError(
                f"{group}={cls.__name__}: the agent was trained with {group}={choices[group]}; pass that class, or "
                "leave it out"
            )


def _check_shared_names(file: Path, words: Sequence[str]) -> None:
    """Refuse a saved agent if a class of it, which these words do not name, is not the only one of its name."""
    given = {setting_of(each) for each in words}
    for group, name in choices_of(checkpoint.progress_of(file)["config"]).items():
        if group not in given:
            check_is_single(group, name)


def _check_problem(file: Path, settings: Iterable[str], where: str) -> None:
    """Refuse an agent whose problem was an object, unless one of these settings names the problem.

    `where` is the argument that gives the file.

    Raises:
        ConfigError: the problem is unknown.
    """
    saved = checkpoint.progress_of(file)["config"].get("env")
    is_named = any(each.removeprefix("env.") in NAMING_SETTINGS for each in settings)
    is_generic = isinstance(saved, Mapping) and {*NAMING_SETTINGS} <= saved.keys()
    if is_generic and not is_named and all(saved[name] is None for name in NAMING_SETTINGS):
        raise ConfigError(f"{where}: {file}: the agent was trained on an object from Python; pass it again as env")
