"""Translate names: old ones of settings in errors and saved runs, and those of other libraries in errors."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

# Old names of settings and the new ones. A dotted name belongs to one group, a plain name to any group.
_NEW_NAMES = {
    "agent.uniform_option_frames": "practice",
    "agent.uniform_option_steps": "practice",
    "env.options": "grouping",
    "warmup_frames": "warmup_steps",
    "updates_per_frame": "updates_per_step",
    "epsilon_frames": "epsilon_steps",
    "lr_frames": "lr_steps",
    "anneal_frames": "anneal_steps",
    "lr_final": "lr_final_fraction",  # of replay learners; that of H-PPO is a rate, and keeps its name
    "weight_decay_frames": "weight_decay_steps",
    "twin_q": "twin",
    "rl": "twin",
    "target_noise": "target_smoothing",
    "target_noise_clip": "target_smoothing_clip",
    "exploration_noise": "parameter_noise",
}
# Names of settings in Stable-Baselines3, CleanRL and Spinning Up, and ours.
_ELSEWHERE: dict[str, tuple[str, ...]] = {
    "learning_rate": ("lr", "actor_lr", "critic_lr"),
    "lr": ("actor_lr", "critic_lr"),
    "batch_size": ("minibatch_size",),
    "num_minibatches": ("minibatch_size",),
    "n_epochs": ("epochs",),
    "update_epochs": ("epochs",),
    "clip_range": ("clip",),
    "clip_coef": ("clip",),
    "ent_coef": ("discrete_entropy", "parameter_entropy", "discrete_temperature", "parameter_temperature"),
    "vf_coef": ("critic_weight",),
    "tau": ("actor_tau", "critic_tau"),
    "learning_starts": ("warmup_steps",),
    "gradient_steps": ("updates_per_step",),
    "train_freq": ("updates_per_step",),
    "policy_frequency": ("policy_delay",),
    "exploration_fraction": ("epsilon_steps",),
    "exploration_final_eps": ("epsilon_final",),
    "end_e": ("epsilon_final",),
    "exploration_noise": ("parameter_noise",),
    "net_arch": ("hidden_dims",),
    "hidden_sizes": ("hidden_dims",),
    "n_steps": ("steps_per_batch",),
    "num_steps": ("steps_per_batch",),
    "rollout_length": ("steps_per_batch",),
    "total_timesteps": ("total_frames",),
    "num_timesteps": ("total_frames",),
    "total_steps": ("total_frames",),
    "n_envs": ("num_envs",),
    "eval_freq": ("eval.every",),
    "n_eval_episodes": ("eval.layouts",),
}
# Methods of other libraries' agents, and what to use here.
_MEMBERS_ELSEWHERE = {
    "predict": "act(observation)",
    "get_action": "act(observation)",
    "get_action_and_value": "act(observation)",
    "learn": "hpamdp.train",
    "load": "hpamdp.load",
}
# Names that stand for values of the run, which a group does not have.
_OF_RUN = ("steps_per_batch", "total_frames", "num_envs", "eval.every", "eval.layouts")
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
    return f"is called {setting.removesuffix(setting.rpartition('.')[2])}{new} now{meaning}"


def elsewhere(name: str, known: Iterable[str]) -> list[str]:
    """Return our names for a setting of another library: those among the known names, or values of the run."""
    known = set(known)
    return [ours for ours in _ELSEWHERE.get(name, ()) if ours in known or ours in _OF_RUN]


def no_member(owner: object, name: str) -> AttributeError:
    """Return the error for a missing attribute, which names ours for one of another library."""
    ours = _MEMBERS_ELSEWHERE.get(name)
    hint = "" if ours is None else f"; use {ours} (docs/coming-from.md)"
    return AttributeError(f"{type(owner).__name__!r} object has no attribute {name!r}{hint}", name=name, obj=owner)


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
