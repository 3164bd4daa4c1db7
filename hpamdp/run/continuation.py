"""Find the rest of a run in its folder if the command that started it is given again."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from hpamdp.config.errors import ConfigError
from hpamdp.config.saved import upgraded
from hpamdp.config.schema import Config
from hpamdp.run import checkpoint
from hpamdp.run_files import SUMMARY_NAME, differing_settings, flat_settings, saved_config, saved_summary

_CHOSEN = "choices."  # what precedes the groups in a saved config


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
    """Return a number that puts settings before those that may follow from them: choices, values of the run, others."""
    return 0 if name.startswith(_CHOSEN) else 1 + ("." in name)
