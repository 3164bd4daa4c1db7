"""Continue an Optuna search whose trials are in a storage."""

from __future__ import annotations

import warnings
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf

from hpamdp.config.errors import ConfigError
from hpamdp.messages import first_line
from hpamdp.run.folder import locked

if TYPE_CHECKING:
    from optuna import Study

# The study's entry with the numbers of repeated trials.
_TRIED_AGAIN = "tried_again"


def first_job_of_search(config: DictConfig) -> int | None:
    """Set up Hydra's Optuna sweeper to continue a search, and return the number of its first job.

    The search first repeats trials that were stopped or failed. Then it proposes new trials until `n_trials` are
    complete. Without a storage, or with another sweeper, the first job has number 0.

    Args:
        config: the sweep's config with its `hydra` part, which is changed.

    Returns:
        The number of the first job, or None if all trials are complete.

    Raises:
        ConfigError: the storage cannot be used.
    """
    sweeper = config.hydra.sweeper
    if "optuna" not in sweeper._target_ or not sweeper.storage:
        return 0
    study = _load(config)
    from optuna.trial import TrialState

    num_left = sweeper.n_trials - sum(trial.state == TrialState.COMPLETE for trial in study.trials)
    if num_left <= 0:
        return None
    sweeper.n_trials = num_left
    again = set(study.user_attrs.get(_TRIED_AGAIN, []))
    for trial in study.trials:
        if trial.state in (TrialState.RUNNING, TrialState.FAIL) and trial.params and trial.number not in again:
            again.add(trial.number)
            study.set_user_attr(_TRIED_AGAIN, sorted(again))
            _move(config, trial.number, len(study.trials))
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # Optuna 2 calls this experimental
                study.enqueue_trial(trial.params)
    waiting = [trial.number for trial in study.trials if trial.state == TrialState.WAITING]
    first = min(waiting, default=len(study.trials))
    # With the same seed the sampler would propose its first trials again.
    if sweeper.sampler.get("seed") is not None:
        sweeper.sampler.seed += first
    return first


def has_numbered_folders(config: DictConfig) -> bool:
    """Return whether the folder of a sweep's job is named after the job's number."""
    settings: Any = OmegaConf.to_container(config.hydra.sweep, resolve=False)
    return settings["subdir"] == "${hydra.job.num}"


def _load(config: DictConfig) -> Study:
    """Load the study from the storage, or create it. By default, its name is the sweep's folder."""
    import optuna
    import sqlalchemy

    sweeper = config.hydra.sweeper
    if int(sqlalchemy.__version__.partition(".")[0]) > 1:
        raise ConfigError(
            f"hydra.sweeper.storage: Optuna {version('optuna')} needs SQLAlchemy 1, and {sqlalchemy.__version__} is "
            "installed; pip install 'hpamdp[optuna]'"
        )
    if sweeper.study_name is None:
        sweeper.study_name = str(config.hydra.sweep.dir)
    direction = getattr(sweeper.direction, "name", sweeper.direction)
    try:
        return optuna.create_study(
            storage=sweeper.storage,
            study_name=sweeper.study_name,
            load_if_exists=True,
            **({"direction": direction} if isinstance(direction, str) else {"directions": list(direction)}),
        )
    except (sqlalchemy.exc.SQLAlchemyError, ImportError, ValueError) as error:
        raise ConfigError(f"hydra.sweeper.storage={sweeper.storage}: {first_line(error)}") from error


def _move(config: DictConfig, before: int, now: int) -> None:
    """Rename a trial's folder to its new number, unless a process uses it, so that the job finds its checkpoint."""
    sweep = config.hydra.sweep
    if not has_numbered_folders(config):
        return
    old, new = (Path(sweep.dir, str(number)) for number in (before, now))
    if old.is_dir() and not new.exists():
        with suppress(ConfigError, OSError), locked(old):
            old.rename(new)
