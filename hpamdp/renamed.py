"""Translate names: old ones of settings in errors and saved runs, and those of other libraries in errors."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import Any

# Settings that files of 0.3 have by another name. H-PPO still has an `lr_final`, which is a rate.
_NEW_NAMES = {"agent.uniform_option_steps": "practice", "low.lr_final": "lr_final_fraction"}
# Settings that some classes have no longer; they changed no result but its rounding.
_GONE = ("env.compile_rules",)
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
    "policy_kwargs": ("hidden_dims",),
    "tensorboard_log": ("logger",),
    "verbose": ("hpamdp.train(..., progress=True)",),
    "deterministic": ("agent.act(observation, greedy=True)",),
}
# Arguments of other libraries' evaluations, and those of `Agent.evaluate`.
OF_EVALUATION = {
    "n_eval_episodes": "episodes",
    "num_episodes": "episodes",
    "n_episodes": "episodes",
    "eval.layouts": "episodes",
    "return_episode_rewards": "per_episode",
    "deterministic": "act, as evaluate is always greedy",
}
# Methods of other libraries' agents, their algorithms, and what to use here.
_MEMBERS_ELSEWHERE = {
    "predict": "act(observation)",
    "get_action": "act(observation)",
    "get_action_and_value": "act(observation)",
    "learn": "hpamdp.train",
    "load": "hpamdp.load",
    "PPO": 'hpamdp.train(env, low="hppo") or hpamdp.HPPO',
    "DQN": 'hpamdp.train(env, low="pdqn") or hpamdp.PDQN',
    "SAC": 'hpamdp.train(env, low="hsac") or hpamdp.HSAC',
}
# Names that stand for values of the run and for arguments of functions, which a group does not have.
_OF_RUN = ("steps_per_batch", "total_frames", "num_envs", "eval.every", "eval.layouts", "logger")
_OF_PYTHON = _ELSEWHERE["verbose"] + _ELSEWHERE["deterministic"]


def renamed(setting: str, known: Iterable[str]) -> str | None:
    """Return a message with the new name of a setting, if it is among the group's known names; otherwise None."""
    new = _NEW_NAMES.get(setting)
    return f"is called {setting.rpartition('.')[0]}.{new} now" if new is not None and new in known else None


def elsewhere(name: str, known: Iterable[str]) -> list[str]:
    """Return our names for a setting of another library: those among the known names, and those outside groups."""
    known = set(known)
    return [ours for ours in _ELSEWHERE.get(name, ()) if ours in known or ours in _OF_RUN + _OF_PYTHON]


def no_member(owner: object, name: str) -> AttributeError:
    """Return the error for a missing attribute, which names ours for one of another library."""
    ours = _MEMBERS_ELSEWHERE.get(name)
    hint = "" if ours is None else f"; use {ours} (docs/coming-from.md)"
    title = getattr(owner, "__name__", type(owner).__name__)  # of a module or of the class
    return AttributeError(f"{title!r} object has no attribute {name!r}{hint}", name=name, obj=owner)


def with_new_names(group: str, settings: Mapping[str, Any], known: Collection[str]) -> dict[str, Any]:
    """Return the settings of a group of a saved run under today's names, which are known."""
    settings = {name: value for name, value in settings.items() if name in known or f"{group}.{name}" not in _GONE}
    new = {name: _NEW_NAMES.get(f"{group}.{name}", name) for name in settings if name not in known}
    return {new.get(name, name): value for name, value in settings.items()}
