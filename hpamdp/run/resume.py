"""Continue runs: the saved config changed by the command line, and the rest of a run that is started again."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from omegaconf import DictConfig, ListConfig, OmegaConf

from hpamdp.complaints import as_json
from hpamdp.config.components import GROUPS
from hpamdp.config.compose import choosing, chosen_names, conf_dir, names_of, plain, read_run, setting_of
from hpamdp.config.errors import ConfigError, MissingChoiceError
from hpamdp.config.outside_jobs import searched, searching
from hpamdp.config.saved import choices_of, read_saved, upgraded
from hpamdp.config.schema import Config
from hpamdp.env.base import OBSERVATION_ENTRIES, PAMDPEnv
from hpamdp.env.facts import SOURCE_SETTINGS
from hpamdp.messages import warn
from hpamdp.run import checkpoint, compatibility
from hpamdp.run.assemble import choose_selector
from hpamdp.run_files import (
    SUMMARY_NAME,
    differing_settings,
    flat_settings,
    saved_config,
    saved_summary,
)
from hpamdp.settings import Schedule
from hpamdp.shell import setting

# Settings that a run does not take over from the saved run.
_BEGIN = ("mode", "resume", "checkpoint", "overwrite", "trust")
# Groups that an evaluation does not take from the saved run: it collects no steps and logs where the command line says.
_NOT_EVALUATED = ("data", "logger", "collector")
# Values that matter in training only, likewise.
_OF_TRAINING = ("callbacks", "save_best")
_CHOSEN = "choices."  # what precedes the groups in a saved config


def resolve(
    cfg: DictConfig, overrides: Sequence[str], objects: Mapping[str, Any] | None = None
) -> tuple[Config, Path | None]:
    """Return the config to run and the checkpoint to start from, if there is one.

    With `resume` or `mode=eval`, the config is the saved one, changed by the command line.

    Args:
        cfg: the composed config.
        overrides: the words of the command line.
        objects: arguments for the problem's constructor from Python code, if there are any.

    Raises:
        ConfigError: a value is wrong, the checkpoint does not exist, or a word would change the saved agent or nothing.
    """
    if cfg.resume is None and cfg.mode != "eval":
        return choose_selector(compatibility.checked(cfg, overrides, objects), overrides), None
    run, folders = read_run(cfg)
    compatibility.check_saved_run(run)
    where = "resume" if run.resume is not None else "checkpoint"
    source = run.resume or run.checkpoint or ""
    file = checkpoint.find(source, where)
    saved = checkpoint.progress_of(file)["config"]
    if run.resume is not None and run.mode != saved["mode"]:
        raise ConfigError(
            f"resume={source}: a run with mode={saved['mode']}; resume it so, or start one with "
            f"{setting('low.checkpoint', source)}"
        )
    values = {name: cfg[name] for name in _BEGIN}
    if run.mode == "eval":
        values |= {name: _plain_value(cfg, name) for name in (*_NOT_EVALUATED, *_OF_TRAINING)}
    changes = _changes(overrides, saved, file, where)
    compatibility.check_effects(run.mode, changes)
    changed = map(setting_of, changes)
    values |= {name: _plain_value(cfg, name) for name in changed if not name.startswith("hydra")}
    if objects and "env" not in values:  # the object takes the place of the saved run's environment
        values |= {f"env.{name}": None for name in SOURCE_SETTINGS if f"env.{name}" not in values}
    names = {group: chosen_names(cfg)[group] for group in GROUPS if group in values}
    try:
        resolved = read_saved(saved, values, names, composed=cfg, trust=run.trust, file=file)
    except MissingChoiceError as error:
        raise _not_there(error, file) from error
    if run.resume is not None:
        _check_same_run(saved, resolved, file, changes)
        _warn_of_ended_schedules(saved, resolved, source)
    return replace(resolved, config_dirs=folders).with_objects(objects), file


def _check_same_run(saved: Mapping[str, Any], resolved: Config, file: Path, words: Sequence[str]) -> None:
    """Refuse another seed or problem than the run had: its results would be saved as those of the new one.

    A path or an entry point may change, since the files of a run may have moved. So may a setting that a later version
    has added to the problem.

    Raises:
        ConfigError: a word changes one of them.
    """
    before, now = flat_settings(upgraded(saved)), flat_settings(resolved.to_dict())
    given = {setting_of(word).partition(".")[0] for word in words} & {"seed", "env"}
    for name in sorted(differing_settings(before, now), key=_rank):
        group, _, own = name.removeprefix(_CHOSEN).partition(".")
        value, earlier = now.get(name), before.get(name)
        is_later = bool(own) and own.partition(".")[0] not in saved["env"]
        has_moved = isinstance(value, str) and resolved.env.is_guarded(own, value)
        if group in given and not is_later and not has_moved:
            shown, is_choice = name.removeprefix(_CHOSEN), name.startswith(_CHOSEN)
            given_now, saved_then = (str(each) if is_choice else as_json(each) for each in (value, earlier))
            raise ConfigError(
                f"{shown}={given_now}: the run in {file} has {shown}={saved_then}; leave it out when you resume, or "
                f"start a run with {setting('low.checkpoint', str(file.parent))}"
            )


def _warn_of_ended_schedules(saved: Mapping[str, Any], resolved: Config, source: str) -> None:
    """Warn if the run gets longer, but schedules of its agent end where it used to end."""
    before, now = saved.get("total_frames"), resolved.run.total_frames
    if not isinstance(before, int) or now <= before:
        return
    levels = {group: saved.get(group) for group in ("high", "low", "exploration")}
    ended = [
        name
        for name, value in flat_settings(levels).items()
        if value == before and Schedule in map(type, compatibility.marks_of(resolved, name)[0])
    ]
    if ended:
        warn(
            f"resume={source}: total_frames is raised to {now:,}, but {', '.join(ended)} stay at {before:,}: what "
            "falls until then keeps its last value"
        )


def _plain_value(cfg: DictConfig, name: str) -> Any:
    value = OmegaConf.select(cfg, name)
    if isinstance(value, ListConfig):
        return OmegaConf.to_container(value, resolve=True)
    return plain(value, name) if isinstance(value, DictConfig) else value


def saved_words(source: str, where: str, words: Sequence[str]) -> list[str]:
    """Return the choices of a saved run as words, and its folders of yaml files if the words trust the run.

    Nothing of these folders is read without `trust=true`, since somebody else may have written the file.

    Args:
        source: the run's output folder or its checkpoint.
        where: the setting that names the source.
        words: the words of the command line, whose choices and folders precede those of the saved run.

    Raises:
        ConfigError: the checkpoint does not exist, a word would change the saved agent, or a choice has no yaml file.
    """
    given = {setting_of(each): each.partition("=")[2] for each in words}
    file = checkpoint.find(source, where)
    progress = checkpoint.progress_of(file)
    _changes(words, progress["config"], file, where)
    left_out = {*given, *(() if where == "resume" else _NOT_EVALUATED)}
    choices = {group: name for group, name in choices_of(progress["config"]).items() if group not in left_out}
    folders = []
    if given.get("trust", "").lower() == "true" and "hydra.searchpath" not in given:
        known = progress.get("config_dirs") or []
        folders = searching([folder for folder in known if os.path.isdir(folder)])
    with searched([*folders, *words]):
        for group, name in choices.items():
            if not (conf_dir() / group / f"{name}.yaml").is_file() and name not in names_of(group):
                raise _not_there(MissingChoiceError(f"{group}/{name}", names_of(group)), file)
    return [*folders, *(choosing(group, name) for group, name in choices.items())]


def _not_there(error: MissingChoiceError, file: Path) -> ConfigError:
    """Return a refusal that names the folders of yaml files that the saved run had."""
    folders = checkpoint.progress_of(file).get("config_dirs")
    if not folders:
        return error
    named = ", ".join(map(as_json, folders))
    return ConfigError(f"{error}. The run had {named}; give the folder again, or add trust=true if you trust {file}")


def check_saved_options(config: Config, env: PAMDPEnv, source: Path | None) -> None:
    """Refuse a saved agent if number or order of its options differs, and warn if their names or its bounds differ.

    An agent knows its options only by their numbers, and its parameters and observations only within their bounds.

    Args:
        config: config of the run.
        env: the environment of the run.
        source: the checkpoint of the agent. If None, `low.checkpoint` may name one.

    Raises:
        ConfigError: the options differ; the message names the options of both.
    """
    if source is None and config.run.low.checkpoint is not None:
        source = checkpoint.find(config.run.low.checkpoint, "low.checkpoint")
    if source is None:
        return
    progress = checkpoint.progress_of(source)
    warn_of_other_ranges(f"{source}: its agent", progress.get("ranges", {}), env)
    saved, now_env = upgraded(progress["config"]), config.to_dict()
    if (saved["choices"]["env"], saved["env"]) == (now_env["choices"]["env"], now_env["env"]):
        return
    before, now = tuple(progress["option_names"]), env.option_names if env.has_choice else ()
    if not before or not now or before == now:
        return
    both = f"{source}: its agent chooses among {', '.join(before)}, but {config.env} has {', '.join(now)}"
    if len(before) != len(now):
        raise ConfigError(both)
    if set(before) == set(now):
        raise ConfigError(f"{both}; keep the order")
    warn(f"{both}, which take their places")


def warn_of_other_ranges(agent: str, before: Mapping[str, Sequence[float]], env: PAMDPEnv) -> None:
    """Warn if an agent has learned with other bounds, scales or entries than an environment has.

    Args:
        agent: what the line calls the agent.
        before: the `ranges` of the environment that it has learned in; empty if they are unknown.
        env: the environment that it acts in.
    """
    for name, numbers in env.ranges().items():
        if name == OBSERVATION_ENTRIES and before.get(name, numbers) != numbers:
            warn(f"{agent} has learned with entries of the observation whose order or names differ in {env.title}")
            return
        for place, (was, now) in enumerate(zip(before.get(name, ()), numbers, strict=False)):
            if was != now:
                both = f"{name}[{place}]={was:g}, but {env.title} has {now:g}"
                warn(f"{agent} has learned with {both}: its actions do not fit; restore the number, or train anew")
                return


def _changes(overrides: Sequence[str], saved: Mapping[str, Any], file: Path, where: str) -> list[str]:
    """Return the words that change the saved run; a repeated choice of a group changes nothing."""
    choices = choices_of(saved)
    changes = [
        word for word in overrides if setting_of(word) not in GROUPS or _choice(word) != choices[setting_of(word)]
    ]
    for word in changes:
        if re.split(r"[./]", setting_of(word))[0] in compatibility.GROUPS_OF_AGENT:
            raise ConfigError(f"{word}: {where} takes the agent from {file}; leave this out")
    return changes


def _choice(override: str) -> str:
    return override.partition("=")[2].strip("'\"")


class Rest(NamedTuple):
    """What is left of a run.

    If `score` is set, the run is finished. If only `checkpoint` is set, it continues from there. If neither is set, it
    starts anew.
    """

    score: float | None = None
    checkpoint: Path | None = None


def rest_of(wanted: Config, folder: Path, name: str = "its folder", callbacks: Sequence[str] = ()) -> Rest:
    """Return the rest of a run in its folder, which may be new.

    Args:
        wanted: the config of the run.
        folder: the run's folder.
        name: name of the folder in the error.
        callbacks: names of the classes of callbacks that Python code gives.

    Raises:
        ConfigError: the folder holds the results of another run, and `overwrite` is false.
    """
    file = folder / checkpoint.FILE_NAME
    if not file.exists() and not (folder / SUMMARY_NAME).exists():
        return Rest()
    saved, summary = saved_config(folder), saved_summary(folder)
    if not saved and file.exists():
        saved = checkpoint.progress_of(file)["config"]
    difference, stopped_by = _difference(wanted, saved), summary.get("stopped_by")
    names = [*(each.class_name for each in wanted.callbacks), *callbacks]
    if not difference and summary.get("finished") and stopped_by not in (None, *names):
        difference = f"callbacks={json.dumps([stopped_by])} for {json.dumps(names)}"
    if difference:
        if wanted.run.overwrite:
            return Rest()
        raise _refusal(name, difference)
    score = summary.get("score") if summary.get("finished") else None
    return Rest(score if isinstance(score, int | float) else None, file if file.exists() else None)


def refuse_another(wanted: Config, saved: Mapping[str, Any], name: str) -> None:
    """Refuse a saved run with another config, except for bookkeeping.

    Args:
        wanted: the config of the run.
        saved: the config of the saved run.
        name: name of its folder in the error.

    Raises:
        ConfigError: the configs differ.
    """
    difference = _difference(wanted, saved)
    if difference:
        raise _refusal(name, difference)


def _refusal(name: str, difference: str) -> ConfigError:
    return ConfigError(
        f"{name} has the results of another config, with {difference}; they stay as they are: set another folder, or "
        "move this one away"
    )


def _difference(wanted: Config, saved: Mapping[str, Any]) -> str:
    """Return the difference of two configs as text, except in bookkeeping; empty if they agree."""
    # Convert through yaml, like the saved config.
    here = flat_settings(yaml.safe_load(wanted.to_yaml()))
    there = flat_settings(upgraded(saved) if saved else {})
    names = sorted(differing_settings(here, there), key=_rank)
    if not names:
        return ""
    more = f" and {len(names) - 1} more" if names[1:] else ""
    values = [json.dumps(each[names[0]], default=str) if names[0] in each else "no value" for each in (there, here)]
    return f"{names[0].removeprefix(_CHOSEN)}={values[0]} for {values[1]}{more}"


def _rank(name: str) -> int:
    """Return a number by which differing settings are named: first choices, then values of the run, then all others."""
    return 0 if name.startswith(_CHOSEN) else 1 + ("." in name)
