"""Code that a run calls during training: the base class of callbacks, and callbacks to choose from."""

from __future__ import annotations

import copy
import math
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from torch import Tensor

from hpamdp.cards import CallbackCard
from hpamdp.config.errors import ConfigError
from hpamdp.files import replacing
from hpamdp.messages import as_code, first_line, warn
from hpamdp.run.checkpoint import progress_of
from hpamdp.run.options import CARDS, PatienceOptions, TimeLimitOptions
from hpamdp.run.state_file import as_bytes
from hpamdp.run_files import BEST_NAME
from hpamdp.settings import SettingError

if TYPE_CHECKING:
    from hpamdp.run.trainer import Trainer

SCORE = "eval/score"
OWN = "own/"  # prefix of the columns with callbacks' metrics


class CallbackError(ConfigError):
    """Raised if a callback returns a value that cannot be recorded or saved. Training is saved first."""


class Callback:
    """Called during training. A subclass overrides the methods that it needs.

    Each method gets the trainer. `trainer.stop()` ends training after the current batch. The callback can read
    `trainer.frames`, `trainer.wall_s`, `trainer.last_score`, `trainer.parts.agent` and
    `trainer.recorder.metrics.rows()`.

    Attributes:
        card: what the class declares.
    """

    card: ClassVar[CallbackCard] = CallbackCard()

    def on_start(self, trainer: Trainer) -> None:
        """Act before the first batch, of a resumed run too. `trainer.resumed_from` is the resumed run's folder."""

    def on_batch(self, trainer: Trainer) -> None:
        """Act after the agent has learned from a batch."""

    def on_evaluation(self, trainer: Trainer, row: Mapping[str, float]) -> None:
        """Act after an evaluation.

        Args:
            trainer: the running training.
            row: the new row of metrics. Names of the evaluation's metrics begin with `eval/`.
        """

    def on_end(self, trainer: Trainer) -> None:
        """Act after the last batch, before the agent is saved."""

    def metrics(self, trainer: Trainer) -> Mapping[str, float]:
        """Return numbers by their names for the next row of metrics, in which `own/` precedes the names."""
        return {}

    def state(self) -> dict[str, Any]:
        """Return what a checkpoint has to hold: numbers, texts, dense tensors, and lists and mappings of these."""
        return {}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state`."""


class BestAgent(Callback):
    """Keep the agent with the highest score of an evaluation.

    The agent goes to `best.safetensors` in the run's folder, or stays in memory if the run has no folder.

    Attributes:
        best_score: score of the kept agent; None before the first evaluation.
        best_frames: frames of training that it has had; None if that is not known.
    """

    card = CARDS["BestAgent"]

    def __init__(self, *unknown: Any) -> None:
        if unknown:
            raise SettingError(f"BestAgent: {as_code(unknown[0])}: no such argument; its file is always {BEST_NAME}")
        self.best_score: float | None = None
        self.best_frames: int | None = None
        self._file: Path | None = None
        self._kept: tuple[dict[str, Any], dict[str, Tensor]] | None = None  # the networks, the observations' scale

    def on_start(self, trainer: Trainer) -> None:
        """Take over the best agent of the resumed run, which a killed run may have saved after its checkpoint."""
        self._file = self._kept = None  # of an earlier run
        if trainer.resumed_from is None:
            self.best_score = self.best_frames = None
            return
        file = trainer.resumed_from / BEST_NAME
        if not file.is_file():
            if self.best_score is not None:
                warn(f"{file}: not there, so the best agent is only kept from here on")
            self.best_score = self.best_frames = None
            return
        progress = progress_of(file)
        self.best_score, self.best_frames = progress["last_score"], progress["frames"]
        self._file = file
        if trainer.output_dir is not None and trainer.output_dir.resolve() != trainer.resumed_from.resolve():
            self._file = trainer.output_dir / BEST_NAME
            with replacing(self._file) as partial:
                shutil.copyfile(file, partial)

    def on_evaluation(self, trainer: Trainer, row: Mapping[str, float]) -> None:
        """Keep the agent if its score is the highest so far. An untrained agent does not count."""
        score = row[SCORE]
        if trainer.frames == 0 or (self.best_score is not None and score <= self.best_score):
            return
        trainer.check_weights()
        if trainer.output_dir is None:
            parts = trainer.parts
            self._kept = copy.deepcopy((parts.agent.state_dict(), parts.env.base_env.statistics()))
        else:
            self._file = trainer.output_dir / BEST_NAME
            trainer.save_policy(self._file)
        self.best_score, self.best_frames = score, trainer.frames

    def is_clearly_better(self, scores: np.ndarray) -> bool:
        """Return whether the kept agent has clearly more than the mean of an evaluation's scores `[episodes]`.

        That is more than two standard errors of a difference of two such evaluations.
        """
        if len(scores) < 2:  # one episode tells no standard error
            return False
        error = math.sqrt(2.0 / len(scores)) * float(scores.std())
        return self.best_score is not None and self.best_score > float(scores.mean()) + 2.0 * error

    def restore(self, trainer: Trainer) -> None:
        """Give the trainer's agent the networks of the best agent. Optimizers and replay buffers stay.

        Raises:
            RuntimeError: there was no evaluation yet.
        """
        if self._kept is not None:
            networks, statistics = self._kept
            trainer.parts.agent.load_state_dict(networks)
            trainer.parts.env.base_env.set_statistics(statistics)
            trainer.recorder.forget_evaluation()
        elif self._file is not None:
            trainer.load_policy(self._file)
        else:
            raise RuntimeError("no agent to restore: there was no evaluation yet")

    def state(self) -> dict[str, Any]:
        """Return the best score. The agent itself is in `best.safetensors`."""
        return {"best_score": self.best_score}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state`."""
        self.best_score = state["best_score"]


class Patience(Callback):
    """End training after some evaluations without an improvement of the score.

    Args:
        evaluations: the setting of this name, as in `Patience(3)`.
        options: the settings.
        settings: single settings.
    """

    Options = PatienceOptions
    card = CARDS["Patience"]

    def __init__(
        self, evaluations: int | None = None, *, options: PatienceOptions | None = None, **settings: Any
    ) -> None:
        if evaluations is not None:
            settings["evaluations"] = evaluations
        self.options: PatienceOptions = PatienceOptions.of(options, settings)
        self._best = -math.inf
        self._evaluations = 0  # since the last improvement

    def on_start(self, trainer: Trainer) -> None:
        """Begin to count in a new run, or end a resumed run that has waited long enough."""
        if trainer.resumed_from is None:
            self._best, self._evaluations = -math.inf, 0
        self._stop_if_over(trainer)

    def on_evaluation(self, trainer: Trainer, row: Mapping[str, float]) -> None:
        """Count the evaluation unless its score is an improvement."""
        score = row[SCORE]
        if score <= self._best or score - self._best < self.options.min_improvement:
            self._evaluations += 1
        else:
            self._best, self._evaluations = score, 0
        self._stop_if_over(trainer)

    def _stop_if_over(self, trainer: Trainer) -> None:
        if self._evaluations >= self.options.evaluations:
            trainer.stop(f"{self._evaluations} evaluations without an improvement")

    def state(self) -> dict[str, Any]:
        """Return the best score and the number of evaluations since then."""
        return {"best": self._best, "evaluations": self._evaluations}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state`."""
        self._best, self._evaluations = state["best"], state["evaluations"]


class TimeLimit(Callback):
    """End training after some minutes of wall time.

    Args:
        minutes: the setting of this name, as in `TimeLimit(60)`.
        options: the settings.
        settings: single settings.
    """

    Options = TimeLimitOptions
    card = CARDS["TimeLimit"]

    def __init__(
        self, minutes: float | None = None, *, options: TimeLimitOptions | None = None, **settings: Any
    ) -> None:
        if minutes is not None:
            settings["minutes"] = minutes
        self.options: TimeLimitOptions = TimeLimitOptions.of(options, settings)

    def on_start(self, trainer: Trainer) -> None:
        """End a resumed run whose time is over."""
        self.on_batch(trainer)

    def on_batch(self, trainer: Trainer) -> None:
        """End training if its time is over."""
        if trainer.wall_s >= 60.0 * self.options.minutes:
            trainer.stop(f"{self.options.minutes:g} minutes are over")


class OwnMetrics(Callback):
    """Add a function's numbers to each row of metrics.

    Args:
        function: gets the trainer and returns finite numbers by their names.
    """

    def __init__(self, function: Callable[[Trainer], Mapping[str, float]]) -> None:
        if not callable(function):
            raise SettingError(f"OwnMetrics: function={as_code(function)}: must be a function of the trainer")
        self._function = function

    def metrics(self, trainer: Trainer) -> Mapping[str, float]:
        """Return the function's numbers."""
        return self._function(trainer)


def named(callbacks: Iterable[Callback]) -> dict[str, Callback]:
    """Return callbacks under the names of their classes. A number follows the name of a further one of a class."""
    by_name: dict[str, Callback] = {}
    counts: dict[str, int] = {}
    for callback in callbacks:
        name = type(callback).__name__
        counts[name] = counts.get(name, 0) + 1
        by_name[name if counts[name] == 1 else f"{name}_{counts[name]}"] = callback
    return by_name


@contextmanager
def mistakes_explained(name: str) -> Iterator[None]:
    """Name the callback in the line about a user's mistake, so that training is saved before it ends.

    Other errors go through as they are.

    Raises:
        CallbackError: the block raised a `ConfigError`.
    """
    try:
        yield
    except CallbackError:
        raise
    except ConfigError as error:
        raise CallbackError(f"{name}: {first_line(error)}") from error


def metrics_of(callbacks: Mapping[str, Callback], trainer: Trainer) -> dict[str, float]:
    """Return the metrics of all callbacks, with `own/` before their names.

    Raises:
        CallbackError: a value is no finite number, or two callbacks return the same name.
    """
    row: dict[str, float] = {}
    for name, callback in callbacks.items():
        with mistakes_explained(name):
            metrics = callback.metrics(trainer)
        if not isinstance(metrics, Mapping):
            raise CallbackError(f"{name}.metrics: must return numbers by their names, not {type(metrics).__name__}")
        for metric, value in metrics.items():
            where = f"{name}.metrics: {metric}={value!r:.60}"
            if not isinstance(metric, str) or not metric or not metric.isprintable():
                raise CallbackError(f"{where}: the name must be a text in one line")
            if f"{OWN}{metric}" in row:
                raise CallbackError(f"{where}: another callback has a metric of this name")
            row[f"{OWN}{metric}"] = _finite_number(where, value)
    return row


def _finite_number(where: str, value: Any) -> float:
    try:
        number = math.nan if isinstance(value, str | bytes) else float(value)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise CallbackError(f"{first_line(where)}: must be a finite number")
    return number


def states_of(callbacks: Mapping[str, Callback]) -> dict[str, dict[str, Any]]:
    """Return copies of the states of all callbacks, given by name.

    Raises:
        CallbackError: a checkpoint cannot hold a state.
    """
    states = {}
    for name, callback in callbacks.items():
        with mistakes_explained(name):
            state = callback.state()
        try:
            as_bytes({"state": state})
            states[name] = copy.deepcopy(state)  # the callback may go on to change it
        except (TypeError, RuntimeError, KeyError) as error:
            raise CallbackError(f"{name}.state: no checkpoint can hold it ({first_line(error)})") from error
    return states
