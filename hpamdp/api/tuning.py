"""Search for good settings with Optuna, and run `hpamdp tune`."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Literal, get_args

from hpamdp.api.arguments import count, path_argument
from hpamdp.api.judging import judge
from hpamdp.api.training import train
from hpamdp.config.errors import ConfigError
from hpamdp.config.search_space import Range, Space, parsed_space, space_of_learner, split_words
from hpamdp.messages import INTERRUPTED, one_line, reason_of, say
from hpamdp.run.callbacks import Callback
from hpamdp.run.players import whole_number
from hpamdp.run.trainer import DivergedError
from hpamdp.shell import for_shell, setting

if TYPE_CHECKING:
    from optuna import Study, Trial

    from hpamdp.run.trainer import Trainer

_DESCRIPTION = """\
Search for good settings of a learner with Optuna.

  hpamdp tune env=platform low=hppo --trials 40 --to tuned       the learner's settings in conf/search
  hpamdp tune env=platform low=hppo low.lr=1e-4,1e-3 low.epochs=2,5,10
  hpamdp tune env=platform low=hppo 'low.lr=tag(log,interval(1e-4,1e-2))'

Words with several values are the space, all others are fixed. The same command with the same --to goes on.

  hpamdp tune mode=offline data=human data.held_out=[0,3,6,9] high=linucb low=iql --objective data

chooses by held-out transitions, as `hpamdp judge` does, and not by the environment.
"""
Objective = Literal["score", "data"]
TRIALS_NAME = "trials.log"
_SEED = 1_000_000
_DEFINITION = "definition"  # entry of a study: what is searched
_WHY = "why"  # entry of a trial that was refused or has diverged


@dataclass(frozen=True)
class Tuned:
    """The result of a search.

    Attributes:
        settings: the best settings by name, for `hpamdp.train(env, low=..., **settings)`.
        score: of the evaluation at the end of this trial, or what the data say of its agent. The best of many trials
            is partly lucky, so score its settings again with other seeds.
        words: the settings as words of a command line.
        trials: number of trials, pruned ones included.
    """

    settings: dict[str, Any]
    score: float
    words: str
    trials: int


class _Report(Callback):
    """Report each evaluation to Optuna, and end a trial that is to be pruned."""

    def __init__(self, trial: Trial) -> None:
        self._trial = trial
        self.score: float | None = None
        self.is_pruned = self.is_over = False

    def on_evaluation(self, trainer: Trainer, row: Mapping[str, float]) -> None:
        """Report the score of an agent that has learned."""
        if trainer.frames == 0:
            return
        self.score = row["eval/score"]
        self._trial.report(self.score, trainer.frames)
        if not trainer.is_over() and self._trial.should_prune():
            self.is_pruned = True
            trainer.stop("pruned")

    def on_end(self, trainer: Trainer) -> None:
        """Note whether the run has come to its end, and was not interrupted."""
        self.is_over = trainer.is_over() and not trainer.is_evaluation_due


def tune(
    env: Any = None,
    *,
    low: Any = "hppo",
    trials: int = 40,
    space: Mapping[str, Any] | None = None,
    folder: str | Path | None = None,
    objective: Objective = "score",
    seed: int = _SEED,
    progress: bool = True,
    **settings: Any,
) -> Tuned:
    """Search for the settings with the highest score at the end of a training.

    Optuna's tree-structured Parzen estimator proposes the settings of each trial. After five trials, a trial ends
    early if its best score so far is below the median score of the earlier ones after as many steps. Trial number i
    trains with the seed `seed` + i, and all evaluations have `eval.seed=seed`. So the episodes are not those of a usual
    evaluation, whose seed is 0.

    Ctrl-C ends the search, and the best settings so far are returned.

    Args:
        env: the problem, as for `train`.
        low: the learner, as for `train`.
        trials: number of trials, with those in the folder.
        space: for each setting a text as on the command line, such as `tag(log, interval(1e-4, 1e-2))`,
            `interval(0.9, 0.99)`, `range(2, 10)` or `2,5,10`; or a list. If None, the space of `conf/search` for the
            learner, without the settings that are given.
        folder: keeps the trials, in a journal of Optuna. If it holds some already, the search goes on. Several
            processes may search in one folder at the same time. If None, nothing is written.
        objective: `score`, that of the evaluation at the end; or `data`, the return that `hpamdp.judge` predicts from
            the transitions that `data.held_out` keeps apart, without the environment. Then no trial is pruned.
        seed: of the search.
        progress: whether to print a line for each trial, and the best settings at the end.
        settings: those of all trials, as for `train`.

    Raises:
        ConfigError: an argument is wrong, Optuna is not installed, the folder has another search, or no trial came to
            its end.

    Example:
        >>> import hpamdp
        >>> best = hpamdp.tune("platform", low="hppo", trials=20, total_frames=50_000)  # doctest: +SKIP
        >>> agent = hpamdp.train("platform", low="hppo", **best.settings)  # doctest: +SKIP
    """
    name, own = (low.get("name"), low) if isinstance(low, Mapping) else (low, {})
    if space is None:
        given = {*settings, *(f"low.{each}" for each in own)}
        space = space_of_learner(str(getattr(name, "__name__", name)), [*given])
    found = parsed_space(space)
    fixed = {"low": low, **settings}
    return _search(_Objective(env, fixed, found, seed, objective), trials, folder, progress=progress)[0]


@dataclass(frozen=True)
class _Objective:
    """What Optuna maximises: the score of a training with the settings of a trial, or what data say of its agent."""

    env: Any
    fixed: Mapping[str, Any]
    space: Space
    seed: int
    by: Objective = "score"

    def __post_init__(self) -> None:
        if self.by not in get_args(Objective):
            raise ConfigError(f"objective={self.by}: must be 'score' or 'data'")
        if self.by == "data" and not self.fixed.get("data.held_out"):
            raise ConfigError("objective=data: data.held_out must say which transitions judge")
        for name in ("callbacks", "folder", "progress"):
            if name in {*self.fixed, *self.space}:
                raise ConfigError(f"{name}: trials have none of their own; leave it out")

    @property
    def definition(self) -> str:
        """What distinguishes this search from another one, as text."""
        return json.dumps([self.env, self.fixed, self.space, self.seed, self.by], default=_named)

    def __call__(self, trial: Trial) -> float:
        """Return the score at the end of the training, or the return that the data predict.

        Raises:
            TrialPruned: the training ended early, diverged, or was refused.
            ConfigError: the first training was refused.
            KeyboardInterrupt: the user stopped it.
        """
        from optuna import TrialPruned

        values = {name: _suggested(trial, name, each) for name, each in self.space.items()}
        report, seeds = _Report(trial), {"seed": self.seed + trial.number, "eval.seed": self.seed}
        with TemporaryDirectory() if self.by == "data" else nullcontext() as folder:
            kept = {} if folder is None else {"folder": folder, "offline.eval_every": 0, "eval.layouts": 1}
            try:
                train(self.env, callbacks=[report], progress=False, **{**seeds, **kept, **self.fixed, **values})
            except (ConfigError, DivergedError) as error:
                if isinstance(error, ConfigError) and trial.number == 0:
                    raise
                trial.set_user_attr(_WHY, one_line(error))
                raise TrialPruned from error
            if report.is_pruned:
                raise TrialPruned
            if not report.is_over or report.score is None:
                raise KeyboardInterrupt
            if folder is None:
                return report.score
            (row,) = judge(folder, **{name: each for name, each in self.fixed.items() if name.split(".")[0] == "data"})
            return float(row["return"])


def _search(objective: _Objective, trials: int, folder: Any, *, progress: bool) -> tuple[Tuned, bool]:
    """Make trials until there are as many as asked, see `tune`.

    Returns:
        The best one's settings, and whether there are as many trials as asked.
    """
    try:
        import optuna
    except ImportError as error:
        raise ConfigError("Optuna is not installed; pip install 'hpamdp[tune]'") from error
    count("trials", trials)
    if not objective.space:
        raise ConfigError("tune: nothing to search; every setting of the space is given")
    optuna.logging.set_verbosity(optuna.logging.ERROR)  # it would warn of an error that is raised, with a traceback
    study = _study(folder, objective)
    complete, pruned = optuna.trial.TrialState.COMPLETE, optuna.trial.TrialState.PRUNED

    def num(*states: Any) -> int:
        return len(study.get_trials(deepcopy=False, states=states))

    def tell(study: Study, trial: Any) -> None:
        end = f"score {trial.value:.3f}" if trial.state == complete else trial.user_attrs.get(_WHY, "pruned")
        say(f"Trial {trial.number}: {end}, {_words(trial.params)}")

    try:
        while num(complete, pruned) < trials:
            study.optimize(objective, n_trials=1, callbacks=[tell] if progress else [])
    except KeyboardInterrupt:
        say(f"Stopped with {trials - num(complete, pruned)} trials to go")
    if not num(complete):
        raise ConfigError("tune: no trial came to its end")
    best = Tuned(study.best_params, study.best_value, _words(study.best_params), num(complete, pruned))
    if progress:
        say(f"Best score {best.score:.3f} in {best.trials} trials, with the settings\n{best.words}")
    return best, best.trials >= trials


def _study(folder: Any, objective: _Objective) -> Study:
    """Return the study of a folder, or one in memory.

    Raises:
        ConfigError: the folder has another search, or cannot be written to.
    """
    import optuna
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend

    storage = None
    if folder is not None:
        path = path_argument("folder", folder)
        try:
            path.mkdir(parents=True, exist_ok=True)
            storage = JournalStorage(JournalFileBackend(str(path / TRIALS_NAME)))
        except OSError as error:
            raise ConfigError(f"folder={folder}: {reason_of(error)}") from error
    study = optuna.create_study(storage=storage, study_name="hpamdp", load_if_exists=True, direction="maximize")
    if study.user_attrs.get(_DEFINITION, objective.definition) != objective.definition:
        raise ConfigError(f"folder={folder}: has another search; give a folder of its own")
    study.set_user_attr(_DEFINITION, objective.definition)
    study.pruner = optuna.pruners.MedianPruner()
    # With the same seed the sampler would propose its first trials again.
    study.sampler = optuna.samplers.TPESampler(seed=(objective.seed + len(study.trials)) % 2**32)
    return study


def _suggested(trial: Trial, name: str, values: Range | list[Any]) -> Any:
    if isinstance(values, list):
        return trial.suggest_categorical(name, values)
    if isinstance(values.low, int) and isinstance(values.high, int):
        return trial.suggest_int(name, values.low, values.high, step=values.step, log=values.is_log)
    return trial.suggest_float(name, values.low, values.high, log=values.is_log)


def _words(settings: Mapping[str, Any]) -> str:
    words = (
        setting(name, value) if isinstance(value, str) else for_shell(f"{name}={json.dumps(value)}")
        for name, value in settings.items()
    )
    return " ".join(words)


def _named(value: Any) -> Any:
    """Return what stands for an object in the definition of a search, the same in every process."""
    return vars(value) if isinstance(value, Range) else getattr(value, "__qualname__", type(value).__name__)


def main(words: Sequence[str], parser: argparse.ArgumentParser) -> int:
    """Run `hpamdp tune`, and return the exit code.

    Raises:
        ConfigError: see `tune`.
    """
    parser.description = _DESCRIPTION
    parser.add_argument(
        "words", nargs="*", metavar="SETTING=VALUE", help="as for a training; several values are searched"
    )
    parser.add_argument("--trials", type=whole_number(1, 1_000_000), default=40, help="how many (40)")
    parser.add_argument("--to", type=Path, help="folder that keeps the trials")
    parser.add_argument("--objective", choices=get_args(Objective), default="score", help="what chooses (score)")
    parser.add_argument("--seed", type=int, default=_SEED, help=f"of the search ({_SEED})")
    options = parser.parse_intermixed_args(words)
    settings, space = split_words(options.words)
    env = settings.pop("env", None)
    settings.setdefault("low", "hppo")
    if not space:
        space = parsed_space(space_of_learner(settings["low"], [*settings]))
    objective = _Objective(env, settings, space, options.seed, options.objective)
    _, is_finished = _search(objective, options.trials, options.to, progress=True)
    return 0 if is_finished else INTERRUPTED
