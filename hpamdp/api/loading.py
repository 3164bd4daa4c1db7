"""Load trained agents."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
import torchrl
from torchrl.checkpoint import GlobalRNGState

from hpamdp.api.agent import Agent
from hpamdp.api.arguments import choices_and_settings, flag, path_argument, problem_of
from hpamdp.config.compose import conf_dir, setting_of
from hpamdp.config.errors import ConfigError, problems_explained
from hpamdp.config.outside_jobs import check_is_single, choosing_class, own_hydra, searching
from hpamdp.config.saved import choices_of
from hpamdp.config.schema import RunConfig
from hpamdp.env.errors import closed_on_error
from hpamdp.env.facts import NAMING_SETTINGS
from hpamdp.imports import collector_paused
from hpamdp.metrics_file import read_rows
from hpamdp.run import checkpoint
from hpamdp.run.players import load_agent
from hpamdp.run_files import METRICS_NAME

# Groups of a trained agent, of which only classes from Python are given again.
_OF_AGENT = ("high", "low", "encoder", "exploration")
# Values of the run that count for a trained agent, too.
_OF_LOADING = ("device", "threads")


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
        check_problem(file, given, "load")
    check_shared_names(file, [*settings, *words])
    return loaded(file, words, own, problem.objects)


@collector_paused()
def loaded(file: Path, words: Sequence[str], settings: Sequence[tuple[str, Any]], objects: Mapping[str, Any]) -> Agent:
    """Return the agent of a file, and the metrics beside it."""
    with torch_restored(), problems_explained():
        loaded = load_agent(str(file), words, settings, objects, where="agent")
    with closed_on_error(loaded.env):
        return Agent(loaded.config, loaded.agent, loaded.env, loaded.progress, read_rows(file.parent / METRICS_NAME))


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


def check_shared_names(file: Path, words: Sequence[str]) -> None:
    """Refuse a saved agent if a class of it, which these words do not name, is not the only one of its name."""
    given = {setting_of(each) for each in words}
    for group, name in choices_of(checkpoint.progress_of(file)["config"]).items():
        if group not in given:
            check_is_single(group, name)


def check_problem(file: Path, settings: Iterable[str], where: str) -> None:
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


@contextmanager
def torch_restored() -> Iterator[None]:
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
