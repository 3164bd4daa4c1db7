"""Name the files in the folder of a run, and read its config and its summary."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from hpamdp.config.yaml_files import check_size
from hpamdp.files import read_regular

# Files of a run that others read.
CHECKPOINT_NAME = "checkpoint.zip"
POLICY_NAME = "policy.pt"
BEST_NAME = "best.pt"
SUMMARY_NAME = "summary.json"
CONFIG_NAME = "config.yaml"
METRICS_NAME = "metrics.csv"
# Folders that a run's logger writes to.
TENSORBOARD_NAME, WANDB_NAME = "tensorboard", "wandb"
# Endings of the pictures in the folder. The environment chooses their names.
FIGURES_NAME = ".figures"
# All other files that a run writes.
DIVERGED_NAME = "checkpoint.diverged.zip"
EVALUATION_NAME = "evaluation.npz"
FILM_NAME = "episodes.gif"
ERROR_NAME = "error.txt"
# The largest config or summary that is read.
MAX_TEXT_BYTES = 1 << 24
# Settings of problems that change no result, or only its rounding.
ENV_WITHOUT_INFLUENCE = ("compile_rules", "compile_physics", "num_workers", "render", "recording")
# Settings that change neither the training nor the score.
_BOOKKEEPING = (
    "resume",
    "trust",
    "overwrite",
    "film",
    "save_best",
    "logger",
    "checkpoint_every",
    "checkpoint_minutes",
    "checkpoint_replay",
)


def saved_config(folder: Path) -> dict[str, Any]:
    """Return the config of the run in a folder; empty if it is missing or cannot be read."""
    try:
        text = read_regular(folder / CONFIG_NAME, MAX_TEXT_BYTES)
        check_size(folder / CONFIG_NAME)
        config = yaml.safe_load(text)
    except Exception:  # PyYAML raises errors of any kind, such as a KeyError for `!!bool x`
        return {}
    return config if isinstance(config, dict) else {}


def saved_summary(folder: Path) -> dict[str, Any]:
    """Return the summary of the run in a folder; empty if it is missing or cannot be read."""
    try:
        summary = json.loads(read_regular(folder / SUMMARY_NAME, MAX_TEXT_BYTES))
    except (OSError, ValueError, RecursionError):  # missing, or cut off in the middle
        return {}
    return summary if isinstance(summary, dict) else {}


def flat_settings(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a saved config by their dotted names, except those that change no result."""
    flat = _flat(config)
    return {
        name: value
        for name, value in flat.items()
        if name.removeprefix("choices.").partition(".")[0] not in _BOOKKEEPING
    }


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in values.items():
        flat |= _flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return flat
