"""Refuse old names of settings with the new name, and read settings with old names from saved runs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

# Old names of settings and the new ones. A dotted name belongs to one group, a plain name to any group.
_NEW_NAMES = {
    "agent.uniform_option_frames": "uniform_option_steps",
    "env.options": "grouping",
    "warmup_frames": "warmup_steps",
    "updates_per_frame": "updates_per_step",
    "epsilon_frames": "epsilon_steps",
    "lr_frames": "lr_steps",
    "anneal_frames": "anneal_steps",
    "weight_decay_frames": "weight_decay_steps",
    "twin_q": "twin",
    "rl": "twin",
    "target_noise": "target_smoothing",
    "target_noise_clip": "target_smoothing_clip",
    "exploration_noise": "parameter_noise",
}
# Old values whose meaning changed with the name.
_NEW_VALUES: dict[tuple[str, Any], Any] = {("rl", "td3"): True, ("rl", "ddpg"): False}


def renamed(setting: str, known: Iterable[str]) -> str | None:
    """Return a message with the new name of a setting; None if it was not renamed.

    Args:
        setting: the old name as on the command line, such as `low.warmup_frames`.
        known: names of the group's settings. The new name of a setting of any group must be among them.
    """
    new = _NEW_NAMES.get(setting)
    if new is None:
        new = _NEW_NAMES.get(setting.rpartition(".")[2])
        if new is None or new not in known:
            return None
    values = [
        f"{old}={value} is {new}={str(now).lower()}"
        for (old, value), now in _NEW_VALUES.items()
        if setting.endswith(f".{old}")
    ]
    meaning = f" ({', '.join(values)})" if values else ""
    return f"is called {setting.rpartition('.')[0]}.{new} now{meaning}"


def with_new_names(group: str, settings: Mapping[str, Any], known: Iterable[str]) -> dict[str, Any]:
    """Return the settings of a saved run under today's names.

    Args:
        group: such as `low`.
        settings: the saved values by their names at the time.
        known: today's names of the group's settings.
    """
    known = set(known)
    values: dict[str, Any] = {}
    for name, value in settings.items():
        new = _NEW_NAMES.get(f"{group}.{name}") or _NEW_NAMES.get(name)
        is_renamed = new is not None and name not in known and new in known and new not in settings
        if is_renamed and isinstance(value, str | bool):
            value = _NEW_VALUES.get((name, value), value)
        values[new if is_renamed and new is not None else name] = value
    return values
