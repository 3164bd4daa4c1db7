"""Run one training or evaluation: build its parts, let the trainer work, and report in lines."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import torch
from omegaconf import DictConfig

from hpamdp.cards import CallbackCard, outside_card
from hpamdp.complaints import as_json
from hpamdp.config.errors import ConfigError, problems_explained
from hpamdp.config.saved import needs_trust
from hpamdp.config.schema import Config, RunConfig
from hpamdp.env.errors import EnvironmentFaultError
from hpamdp.imports import collector_paused
from hpamdp.limits import is_about_memory
from hpamdp.messages import DIVERGED, FAILED, INTERRUPTED, as_code, first_line, say, warn
from hpamdp.run import checkpoint
from hpamdp.run.assemble import assemble, choose_selector
from hpamdp.run.callbacks import BestAgent, Callback, CallbackError
from hpamdp.run.collection.base import CollectionError
from hpamdp.run.compatibility import length_below_a_batch, need_of_evaluations, settings_without_effect
from hpamdp.run.folder import check_no_training, check_unused, remove_error
from hpamdp.run.resume import check_saved_options, resolve, rest_of
from hpamdp.run.stopping import ProgramExitError, exits_explained
from hpamdp.run.trainer import DivergedError, Trainer
from hpamdp.shell import path_setting, program


def run(
    cfg: DictConfig,
    output_dir: Path,
    overrides: Sequence[str] = (),
    stopped_at: Path | None = None,
    *,
    config: Config | None = None,
    may_overwrite: bool = False,
    tell: Callable[[str], None] = warn,
) -> int:
    """Train or score an agent, write everything under `output_dir`, and return the exit code.

    - 0: the run reached its end.
    - 130: a signal stopped the run, and it was saved.
    - 3: a reward, a loss or a weight was not finite. The last good checkpoint is kept.
    - 1: a worker process died or could not start, third-party code called `sys.exit`, or a callback returned a value
      that cannot be recorded. The agent was saved.

    Args:
        cfg: the composed config.
        output_dir: folder of the run, created if it is missing.
        overrides: the command line's words, which change a resumed run's config.
        stopped_at: the checkpoint of this very run, to continue from.
        config: the checked config, if it is known; else None.
        may_overwrite: whether the results of a run in the folder may be overwritten, as with `overwrite=true`.
        tell: function that gets the reason of the exit codes 3 and 1 in one line.

    Raises:
        ConfigError: a value or a path is wrong, or values do not go together.
    """
    try:
        with exits_explained(), problems_explained():
            source = stopped_at
            if config is None:
                config, given = resolve(cfg, overrides)
                source = stopped_at or given
            config = choose_selector(config, overrides)
            with memory_errors_explained(config):
                trainer = begin(config, source, output_dir, overrides, may_overwrite=may_overwrite)
                return _run_to_the_end(trainer, output_dir, tell)
    except ProgramExitError as error:
        tell(str(error))
        return FAILED


def go_on(
    cfg: DictConfig, output_dir: Path, overrides: Sequence[str], name: str = "its folder", *, tell: Callable = warn
) -> tuple[float | None, bool, int]:
    """Continue the run in its folder, or start it there.

    Args:
        cfg: the composed config.
        output_dir: folder of the run.
        overrides: the command line's words.
        name: name of the folder in errors.
        tell: see `run`.

    Returns:
        The score of a run that was finished before, else None; whether the run was continued; the exit code of `run`.

    Raises:
        ConfigError: the folder holds the results of another run, or as for `run`.
    """
    config, start = resolve(cfg, overrides)
    score, source = rest_of(config, output_dir, name)
    if score is not None:
        return score, False, 0
    remove_error(output_dir)
    if source is not None:
        say(f"Going on from {source}")
    code = run(cfg, output_dir, overrides, source or start, config=config, may_overwrite=True, tell=tell)
    return None, source is not None, code


@contextmanager
def memory_errors_explained(config: Config) -> Iterator[None]:
    """Turn an error about memory into one line that names the sizes to reduce.

    Raises:
        ConfigError: memory did not suffice.
    """
    try:
        yield
    except Exception as error:
        # If the environment's own code lacks memory, the line of its fault says so.
        if isinstance(error, ConfigError | EnvironmentFaultError) or not is_about_memory(error):
            raise
        run = config.run
        sizes = f"num_envs={run.num_envs}, steps_per_batch={run.steps_per_batch}, eval.layouts={run.eval.layouts}"
        for part in (config.low, config.high):
            given = {name: part.settings.get(name) for name in ("buffer_size", "hidden_dims")}
            sizes += "".join(f", {part.group}.{name}={as_json(value)}" for name, value in given.items() if value)
        reason = f" ({first_line(error):.160})" if str(error) else ""
        raise ConfigError(f"{sizes}: the run takes more memory than there is{reason}") from error


@collector_paused()
def begin(
    config: Config,
    source: Path | None = None,
    output_dir: Path | None = None,
    overrides: Sequence[str] = (),
    *,
    may_overwrite: bool = False,
    callbacks: Sequence[Callback] = (),
) -> Trainer:
    """Build a run and write its first files.

    Args:
        config: config of the run.
        source: the checkpoint to continue from or to score; None for a new run.
        output_dir: folder of the run, created if it is missing. If None, the run writes nothing.
        overrides: the command line's words, which change a resumed run's config.
        may_overwrite: whether the results of a run in the folder may be overwritten, as with `overwrite=true`.
        callbacks: called during training, after the callbacks that the config lists; see `check_callbacks`.

    Raises:
        ConfigError: a value or a path is wrong, or values do not go together.
    """
    is_training = config.run.mode != "eval"
    is_own = is_training and _is_in(source, output_dir)
    if output_dir is not None:
        if not is_training:
            check_no_training(output_dir)
        if not is_own:
            check_unused(output_dir, may_overwrite=may_overwrite or config.run.overwrite)
    torch.set_num_threads(config.run.threads)
    torch.manual_seed(config.run.seed)
    of_length = [] if source is not None else length_below_a_batch(config, overrides)
    for warning in [*settings_without_effect(config, overrides), *of_length]:
        warn(warning)
    parts = assemble(config)
    try:
        check_saved_options(config, parts.problem, source)
        trainer = Trainer(config, parts, output_dir, _all_callbacks(config, callbacks) if is_training else ())
        if source is not None:
            trainer.restore(source)
            if is_training:
                check_more(overrides, trainer.frames, config.run)
        trainer.start(is_own=is_own)
    except BaseException:
        parts.close()
        raise
    return trainer


def _all_callbacks(config: Config, given: Sequence[Callback]) -> list[Callback]:
    """Build the callbacks of a config, and return them before the given ones.

    Raises:
        ConfigError: a given object needs evaluations that the run does not make.
    """
    complaint = need_of_evaluations(config, [(type(each).__name__, each.card) for each in given])
    if complaint is not None:
        raise ConfigError(f"callbacks: {complaint}")
    callbacks = [*(chosen.build() for chosen in config.callbacks), *given]
    if config.run.save_best and not any(isinstance(each, BestAgent) for each in callbacks):
        callbacks.insert(0, BestAgent())
    return callbacks


def check_callbacks(given: object) -> None:
    """Refuse what is no list of callbacks.

    Raises:
        ConfigError: the message says what was given.
    """
    if not isinstance(given, list | tuple):
        raise ConfigError(f"callbacks={as_code(given)}: must be a list of objects of subclasses of hpamdp.Callback")
    for each in given:
        if not isinstance(each, Callback):
            what = f"{each.__name__}, a class" if isinstance(each, type) else type(each).__name__
            raise ConfigError(f"callbacks: must be objects of subclasses of Callback, not {what}")
        outside = outside_card(type(each), CallbackCard)
        if outside is not None:
            raise ConfigError(f"callbacks: {type(each).__name__}: {outside}")


def _is_in(source: Path | None, folder: Path | None) -> bool:
    return source is not None and folder is not None and source.parent.resolve() == folder.resolve()


def _run_to_the_end(trainer: Trainer, output_dir: Path, tell: Callable[[str], None]) -> int:
    """Train, report in lines, and return the exit code of `run`."""
    config = trainer.config
    is_interrupted = False
    if config.run.mode != "eval":
        try:
            is_interrupted = trainer.train()
        except DivergedError as error:
            tell(f"{error} at frame {trainer.frames:,}: training stopped; {trainer.keep_for_inspection()}")
            return DIVERGED
        except (CollectionError, CallbackError) as error:
            has_learned = (output_dir / checkpoint.FILE_NAME).is_file()
            saved = f"to go on: {_resuming(config, output_dir)}" if has_learned else "nothing was learned"
            tell(f"{error} at frame {trainer.frames:,}; {saved}")
            return FAILED
    say(trainer.finish(is_finished=not is_interrupted))
    if trainer.stop_reason and not is_interrupted:
        say(f"Training ended at {trainer.frames:,}{trainer.unit}: {trainer.stop_reason}")
    say(f"Everything is in {output_dir}")
    if is_interrupted:
        say(f"Stopped at {trainer.frames:,}{trainer.unit}; to go on: {_resuming(config, output_dir)}")
    return INTERRUPTED if is_interrupted else 0


def _resuming(config: Config, output_dir: Path) -> str:
    """Return the command that continues a run."""
    mode = "" if config.run.mode == "train" else f"mode={config.run.mode} "
    trust = " trust=true" if needs_trust(config) else ""  # the settings came from the user's own command line
    return f"{program()} {mode}{path_setting('resume', output_dir)}{trust}"


def check_more(overrides: Sequence[str], frames: int, run: RunConfig) -> None:
    """Refuse to continue a run for fewer frames than it has, counted in whole batches.

    Raises:
        ConfigError: the length is too small; the message names the frames so far.
    """
    batch = 1 if run.mode == "offline" else run.num_envs * run.steps_per_batch
    most = -(-run.num_frames // batch) * batch
    for word in overrides:
        if word.startswith(("total_frames=", "offline.updates=")) and frames > most:
            raise ConfigError(f"{word}: the run that is continued has {frames:,} already; set more, or leave it out")
