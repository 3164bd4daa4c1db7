"""Translate old names of settings, in errors and in saved runs."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import Any

# Settings that files of 0.3 have by another name. H-PPO still has an `lr_final`, which is a rate.
_NEW_NAMES = {"agent.uniform_option_steps": "practice", "low.lr_final": "lr_final_fraction"}
# Settings that some classes have no longer; they changed no result but its rounding.
_GONE = ("env.compile_rules",)


def renamed(setting: str, known: Iterable[str]) -> str | None:
    """Return a message with the new name of a setting, if it is among the group's known names; otherwise None."""
    new = _NEW_NAMES.get(setting)
    return f"is called {setting.rpartition('.')[0]}.{new} now" if new is not None and new in known else None


def with_new_names(group: str, settings: Mapping[str, Any], known: Collection[str]) -> dict[str, Any]:
    """Return the settings of a group of a saved run under today's names, which are known."""
    settings = {name: value for name, value in settings.items() if name in known or f"{group}.{name}" not in _GONE}
    new = {name: _NEW_NAMES.get(f"{group}.{name}", name) for name in settings if name not in known}
    return {new.get(name, name): value for name, value in settings.items()}
