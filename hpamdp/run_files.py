"""Name the files in the folder of a run, and read its config and its summary."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from hpamdp.files import read_regular, regular_size

# Files of a run that others read.
CHECKPOINT_NAME = "checkpoint.safetensors"
POLICY_NAME = "policy.safetensors"
BEST_NAME = "best.safetensors"
SUMMARY_NAME = "summary.json"
CONFIG_NAME = "config.yaml"
METRICS_NAME = "metrics.csv"
# Folders that a run's logger writes to.
TENSORBOARD_NAME, WANDB_NAME = "tensorboard", "wandb"
CURVES_NAME = "learning_curves.png"
# Lists the names of the pictures in the folder, some of which the environment chooses.
FIGURES_NAME = ".figures"
# The files of saved agents of version 0.3, which are no longer read.
OLD_NAMES = ("checkpoint.zip", "policy.pt", "best.pt")
DIVERGED_NAME = "checkpoint.diverged.safetensors"
EVALUATION_NAME = "evaluation.npz"
FILM_NAME = "episodes.gif"
ERROR_NAME = "error.txt"
# The results of a run, and all other files that it writes.
RESULTS = (SUMMARY_NAME, CHECKPOINT_NAME, POLICY_NAME, BEST_NAME, *OLD_NAMES)
OTHERS = (
    METRICS_NAME,
    f"{METRICS_NAME}.previous",
    DIVERGED_NAME,
    EVALUATION_NAME,
    CURVES_NAME,
    FILM_NAME,
    ERROR_NAME,
    FIGURES_NAME,
    CONFIG_NAME,
)
# The entry of a saved agent's metadata that holds its JSON.
METADATA_KEY = "hpamdp"
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


class _WithoutAliases(yaml.SafeLoader):
    """Refuses aliases, which no run writes: a short file of somebody else could stand for values without end."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("an alias")
        return super().compose_node(parent, index)


def is_saved_agent(path: Path) -> bool:
    """Return whether a file begins like the checkpoints and policies of this version.

    Raises:
        OSError: the file is missing, not regular or unreadable.
    """
    regular_size(path)
    beginning = f'{{"__metadata__":{{"{METADATA_KEY}":'.encode()
    with path.open("rb") as file:
        return file.read(8 + len(beginning))[8:] == beginning


def saved_config(folder: Path) -> dict[str, Any]:
    """Return the config of the run in a folder; empty if it is missing, cut off or cannot be read."""
    try:
        text = read_regular(folder / CONFIG_NAME, MAX_TEXT_BYTES)
        if not text.endswith(b"\n"):  # cut off in the middle, which may still be yaml
            return {}
        config = _WithoutAliases(text).get_single_data()
    except Exception:  # PyYAML raises errors of any kind, such as a KeyError for `!!bool x`
        return {}
    return config if isinstance(config, dict) else {}


def is_config_of_run(config: Mapping[str, Any]) -> bool:
    """Return whether a config is one of this program, since other programs write files of the same name."""
    return {"mode", "seed", "env", "low"} <= config.keys()


def saved_summary(folder: Path) -> dict[str, Any]:
    """Return the summary of the run in a folder; empty if it is missing or cannot be read."""
    try:
        summary = json.loads(read_regular(folder / SUMMARY_NAME, MAX_TEXT_BYTES))
    except (OSError, ValueError, RecursionError):  # missing, or cut off in the middle
        return {}
    return summary if isinstance(summary, dict) else {}


def listed_figures(folder: Path) -> list[str]:
    """Return the names of the pictures that a run has drawn into its folder."""
    try:
        names = read_regular(folder / FIGURES_NAME, MAX_TEXT_BYTES).decode().splitlines()
    except (OSError, UnicodeDecodeError):
        return []
    return [name for name in names if Path(name).name == name and not (folder / name).is_dir()]


def flat_settings(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a saved config by their dotted names, except those that change no result."""
    flat = _flat(config)
    left_out = {f"env.{name}" for name in ENV_WITHOUT_INFLUENCE}
    return {
        name: value
        for name, value in flat.items()
        if name.removeprefix("choices.").partition(".")[0] not in _BOOKKEEPING and name not in left_out
    }


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in values.items():
        # An empty map among a user's own values, as in `env.kwargs={a: {}}`, is a value.
        if isinstance(value, Mapping) and (value or not _is_users_own(prefix)):
            flat |= _flat(value, f"{prefix}{name}.")
        else:
            flat[f"{prefix}{name}"] = value
    return flat


def _is_users_own(name: str) -> bool:
    """Return whether a dotted name lies within a setting of a problem, such as `env.kwargs`."""
    return name.startswith("env.") and name.count(".") > 1


def differing_settings(here: Mapping[str, Any], there: Mapping[str, Any]) -> list[str]:
    """Return the names whose values differ in two configs of `flat_settings`.

    A setting that is missing counts as null, since saved runs lack newer settings. Values within a setting of a
    problem, such as `env.kwargs`, are a user's own: there, a missing one differs from null.
    """
    return [
        name
        for name in {**here, **there}
        if not are_same(here.get(name), there.get(name)) or (_is_users_own(name) and (name in here) != (name in there))
    ]


def are_same(first: Any, second: Any) -> bool:
    """Return whether two values of a config are the same: 1 and 1.0 are, NaN and NaN are, 1 and true are not."""
    if isinstance(first, Mapping) and isinstance(second, Mapping):
        return first.keys() == second.keys() and all(are_same(first[name], second[name]) for name in first)
    if isinstance(first, list | tuple) and isinstance(second, list | tuple):
        return len(first) == len(second) and all(map(are_same, first, second))
    are_nan = first != first and second != second
    return isinstance(first, bool) == isinstance(second, bool) and bool(first == second or are_nan)
