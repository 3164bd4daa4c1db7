"""The config of a run that starts from a checkpoint: that of the saved run, changed by the command line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from hpamdp.config import GROUPS, Config, ConfigError, chosen_names, compose_saved, read
from hpamdp.env.base import PAMDPEnv
from hpamdp.messages import warn
from hpamdp.run import checkpoint
from hpamdp.run.assemble import make_env

# Parts of the config that make the agent what it is.
_AGENT = ("high", "low", "agent", "experiment", "search")


def resolve(cfg: DictConfig, overrides: Sequence[str]) -> tuple[Config, Path | None]:
    """Return the config to run and the checkpoint to start from, if there is one.

    With `resume` or `mode=eval` the saved run's config is taken, changed by what the command line sets anew.

    Args:
        cfg: the composed config.
        overrides: the words of the command line.

    Raises:
        ConfigError: a wrong value, no such checkpoint, or a word that would change the saved agent.
    """
    config = read(cfg)
    where = "resume" if config.run.resume is not None else "checkpoint"
    source = config.run.resume or config.run.checkpoint
    if source is None:
        return config, None
    file = checkpoint.find(source, where)
    saved = checkpoint.progress_of(file)["config"]
    if config.run.resume is not None and config.run.mode != saved["mode"]:
        raise ConfigError(
            f"resume={source}: a run with mode={saved['mode']}; resume it so, or start one with low.checkpoint={source}"
        )
    merged, names = compose_saved(saved)
    for key in ("mode", "resume", "checkpoint", "overwrite"):  # how that run began does not matter to this one
        merged[key] = cfg[key]
    for override in _anew(overrides, saved, file, where):
        key = _key(override)
        OmegaConf.update(merged, key, OmegaConf.select(cfg, key), merge=False)
        if key in GROUPS:
            names[key] = chosen_names(cfg)[key]
    return read(merged, names), file


def saved_choices(source: str, where: str, overrides: Sequence[str]) -> dict[str, str]:
    """Return the names that a saved run chose for the groups, so that the command line is read as an addition to it.

    Args:
        source: the run's output folder or its checkpoint.
        where: the setting that names it.
        overrides: the words of the command line.

    Raises:
        ConfigError: no such checkpoint, or a word that would change the saved agent.
    """
    file = checkpoint.find(source, where)
    saved = checkpoint.progress_of(file)["config"]
    _anew(overrides, saved, file, where)
    return {group: saved[group]["name"] for group in GROUPS}


def check_saved_options(config: Config, env: PAMDPEnv) -> None:
    """Refuse a saved agent of other options in number or order, and warn where its options have other names.

    An agent knows its options by number alone.

    Args:
        config: of the run, whose `resume`, `checkpoint` or `low.checkpoint` has the agent.
        env: the environment of the run.

    Raises:
        ConfigError: with the options of both.
    """
    run = config.run
    sources = {"resume": run.resume, "checkpoint": run.checkpoint, "low.checkpoint": run.low.checkpoint}
    where, source = next(((name, path) for name, path in sources.items() if path is not None), ("", None))
    if source is None:
        return
    progress = checkpoint.progress_of(checkpoint.find(source, where))
    if progress["config"]["env"] == config.to_dict()["env"]:
        return
    before, now = _option_names(progress), env.option_names if env.has_choice else ()
    if not before or not now or before == now:
        return
    both = f"{where}={source}: its agent chooses among {', '.join(before)}, but {config.env} has {', '.join(now)}"
    if len(before) != len(now):
        raise ConfigError(both)
    if set(before) == set(now):
        raise ConfigError(f"{both}; keep the order")
    warn(f"{both}, which take their places")


def _option_names(progress: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the options that a saved run's agent chose among; none if they are not known."""
    if "option_names" in progress:
        return tuple(progress["option_names"])
    saved = progress["config"]  # Checkpoints of earlier versions lack the names.
    try:
        env = make_env(read(*compose_saved({**saved, "resume": None, "checkpoint": None})), 1, torch.device("cpu"), 0)
    except ConfigError:
        return ()
    return env.option_names if env.has_choice else ()


def _anew(overrides: Sequence[str], saved: Mapping[str, Any], file: Path, where: str) -> list[str]:
    """Return the words that set something anew: without those that choose for a group what the saved run has."""
    anew = [
        word for word in overrides if _key(word) not in GROUPS or word != f"{_key(word)}={saved[_key(word)]['name']}"
    ]
    for word in anew:
        if _key(word).split(".")[0] in _AGENT:
            raise ConfigError(f"{word}: {where} takes the agent from {file}; leave this out")
    return anew


def _key(override: str) -> str:
    return override.partition("=")[0].lstrip("+~")
