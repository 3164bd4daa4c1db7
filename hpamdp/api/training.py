"""Train agents."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from hpamdp.api.agent import Agent
from hpamdp.api.arguments import Problem, choices_and_settings, flag, path_argument, problem_of
from hpamdp.api.loading import check_problem, check_shared_names, loaded, torch_restored
from hpamdp.config.command_line import SEARCH_PATH
from hpamdp.config.compose import job_overrides, setting_of
from hpamdp.config.errors import ConfigError, problems_explained
from hpamdp.config.outside_jobs import check_no_sweep, composed, own_hydra, searching
from hpamdp.config.schema import RESUME_AUTO, Config
from hpamdp.messages import reason_of, say, warn
from hpamdp.run import checkpoint
from hpamdp.run.callbacks import Callback
from hpamdp.run.folder import locked
from hpamdp.run.resume import Rest, refuse_another, resolve, rest_of, saved_words
from hpamdp.run.stopping import exits_explained
from hpamdp.run.train import begin, check_callbacks, memory_errors_explained

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

    Ctrl-C ends training after the current batch, and an evaluation at once. Then the agent with what it has learned so
    far is returned. Its `history` is empty if the first evaluation was not over. If several trainings run at once in
    threads, they share torch's random numbers, so no seed reproduces them.

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
    callbacks = [callbacks] if isinstance(callbacks, Callback) else callbacks
    check_callbacks(callbacks)
    problem = problem_of(env)
    goes_on = settings.get("resume") == RESUME_AUTO
    if goes_on:
        settings = {**settings, "resume": None}
    with _warned_if_concurrent(), torch_restored(), exits_explained(), problems_explained(), ExitStack() as stack:
        with own_hydra(), composed(*_given(problem, settings, config_dirs)) as cfg:
            words = job_overrides()
            check_no_sweep(cfg, words)
            config, source = resolve(cfg, words, problem.objects)
            if output_dir is None:
                _check_without_folder(config, words, goes_on=goes_on)
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
    without = parts.agent.without_update()
    if without and not progress:  # the table says so
        warn(f"no update was made: {', '.join(without)}")
    return Agent(config, parts.agent, parts.problem, trainer.progress(), trainer.recorder.metrics.rows())


def _check_without_folder(config: Config, words: Sequence[str], *, goes_on: bool) -> None:
    """Refuse what needs a folder, for a run without one.

    Raises:
        ConfigError: the run is to write files, or to go on with the run in a folder.
    """
    if goes_on:
        raise ConfigError("resume=auto: goes on with the run in a folder, so give folder")
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
        check_shared_names(checkpoint.find(resumed, "resume"), words)
        words = [*saved_words(resumed, "resume", [*words, *trust]), *words]
        if not problem.words and not problem.objects:
            check_problem(checkpoint.find(resumed, "resume"), [*settings, *dict(problem.settings)], "resume")
    return words, problem.with_settings(own)


def _check_guarded() -> None:
    """End a worker process that runs an unguarded script while it imports the script."""
    if getattr(multiprocessing.current_process(), "_inheriting", False):  # as multiprocessing checks it
        raise SystemExit(
            "hpamdp.train: a worker process imports this script again; put what the script runs below "
            'if __name__ == "__main__":'
        )


_running = threading.Lock()  # held while a training of this process runs


@contextmanager
def _warned_if_concurrent() -> Iterator[None]:
    """Warn if another training runs in this process."""
    is_first = _running.acquire(blocking=False)
    if not is_first:
        warn("another training runs in this process; they share torch's random numbers, so no seed repeats them")
    try:
        yield
    finally:
        if is_first:
            _running.release()


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


def _finished_agent(config: Config, folder: Path, problem: Problem, config_dirs: Sequence[str | Path]) -> Agent:
    """Return the agent of a finished run. It needs no trust: it is built as this config would build it.

    Raises:
        ConfigError: the saved agent has another config than the run.
    """
    file = checkpoint.find(folder, "load")
    refuse_another(config, checkpoint.progress_of(file)["config"], str(file))
    folders = searching(config_dirs) or [f"{SEARCH_PATH}=[]"]  # instead of those that the file names
    return loaded(file, [*folders, *problem.words, "trust=true"], problem.with_settings(), problem.objects)
