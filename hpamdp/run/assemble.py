"""The parts of a run from its config: environment, agent, evaluation, logger."""

from __future__ import annotations

import importlib.util
import inspect
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import TransformedEnv

from hpamdp.config import ConfigError, RunConfig, build, name_of, run_config, validate
from hpamdp.env.base import PAMDPEnv
from hpamdp.env.choice import OptionChoiceEnv
from hpamdp.env.decisions import with_decisions
from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.policies.base import Learner
from hpamdp.run import checkpoint
from hpamdp.run.evaluate import Evaluation
from hpamdp.specs import PAMDPSpecs

if TYPE_CHECKING:
    from hpamdp.run.collection.base import Collection

# What the builder supplies; the rest of a constructor's arguments is the yaml's.
CONTEXT = {
    "env": ("num_envs", "device", "seed", "first_env", "dtype", "oracle", "human"),
    "high": ("specs", "device"),
    "low": ("specs", "device"),
    "data": ("env",),
    "logger": ("output_dir", "config"),
    "collector": ("cfg", "settings", "parts", "frames"),
}


@dataclass
class Parts:
    """What a run is made of."""

    env: TransformedEnv
    policy: TensorDictModuleBase  # that acts in `env`
    evaluation: Evaluation
    agent: HierarchicalAgent
    logger: Any
    data: TensorDict | None  # others' presses `[1, M]` to learn from
    device: torch.device


def assemble(cfg: DictConfig, settings: RunConfig, output_dir: Path) -> Parts:
    """Check every group, then build them.

    Raises:
        ConfigError: the first wrong value or impossible pair found.
    """
    classes = {group: validate(group, cfg[group], context)[0] for group, context in CONTEXT.items()}
    device = settings.resolve_device()
    env = make_env(cfg, settings.num_envs, device, settings.seed)
    specs = PAMDPSpecs.from_env(env)
    _check_levels(cfg, settings, env, classes)
    _check_collector(cfg, settings, env, classes["collector"])
    agent = make_agent(cfg, settings, specs, device)
    _check_values(cfg, agent)
    _check_data(cfg, settings, classes)
    # Who goes on or is only scored has learned from it already.
    is_new = settings.mode != "eval" and settings.resume is None
    demonstrations = build("data", cfg.data, env=env) if is_new else None
    data = None if demonstrations is None else demonstrations.batch
    if settings.low.checkpoint is not None and settings.resume is None and settings.mode != "eval":
        checkpoint.load_learners(checkpoint.find(settings.low.checkpoint, "low.checkpoint"), agent, device)
    test_env = make_env(cfg, settings.eval.layouts, device, seed=0)
    test_env.set_scaling_from(env)
    evaluation = Evaluation(_with_decisions(test_env, settings), settings.eval.seed)
    config = OmegaConf.to_container(cfg, resolve=True)
    logger = build("logger", cfg.logger, output_dir=output_dir, config=config)
    return Parts(*acting(env, agent, settings), evaluation, agent, logger, data, device)


def make_env(cfg: DictConfig, num_envs: int, device: torch.device, seed: int, first_env: int = 0) -> PAMDPEnv:
    """Build the environments from number `first_env` on, with all that the two levels need of them.

    Those of a class without an argument `first_env` get a seed of their own.

    Raises:
        ConfigError: a wrong option, or something that this environment does not have.
    """
    classes = {group: validate(group, cfg[group], CONTEXT[group])[0] for group in ("env", "high", "low")}
    if first_env > 0 and "first_env" not in inspect.signature(classes["env"].__init__).parameters:
        seed = int(np.random.SeedSequence((seed, first_env)).generate_state(1)[0])
    asked = _asked_of_env(cfg, classes)
    return build("env", cfg.env, num_envs=num_envs, device=device, seed=seed, first_env=first_env, **asked)


def acting(env: PAMDPEnv, agent: HierarchicalAgent, settings: RunConfig) -> tuple[TransformedEnv, TensorDictModuleBase]:
    """Return the environment to train in, with its decisions tracked, and the policy that acts there."""
    gamma, policy = 1.0 if agent.selector is None else agent.selector.gamma, agent.policy
    if settings.low.freeze:
        env, policy = OptionChoiceEnv(agent.router, env), agent.selector
    return _with_decisions(env, settings, gamma), policy


def _asked_of_env(cfg: DictConfig, classes: dict[str, type | None]) -> dict[str, Any]:
    """Return the environment's arguments for what the two levels need of it."""
    offered = inspect.signature(classes["env"].__init__).parameters
    asked = {}
    for group in ("high", "low"):
        for name in classes[group].needs if classes[group] is not None else ():
            if name not in offered:
                lacks = {"oracle": "has no planner to ask", "human": "has no human data"}[name]
                raise ConfigError(f"{group}={name_of(cfg[group])}: env={name_of(cfg.env)} {lacks}")
            asked[name] = True
    return asked


def _with_decisions(env: PAMDPEnv, settings: RunConfig, gamma: float = 1.0) -> TransformedEnv:
    length = settings.agent.option_length
    return with_decisions(env) if length == "episode" else with_decisions(env, gamma, length)


def _check_levels(cfg: DictConfig, settings: RunConfig, env: PAMDPEnv, classes: dict[str, type | None]) -> None:
    high, name, length = name_of(cfg.high), name_of(cfg.env), settings.agent.option_length
    if classes["high"] is not None and not env.option_names and high != "fixed":
        raise ConfigError(f"high={high}: env={name} has no options to choose; use high=none")
    if classes["high"] is not None and env.option_names and not env.has_choice:
        raise ConfigError(
            f"high={high}: env.controller={cfg.env.controller} leaves nothing to choose; use high=none or "
            "env.controller=choose"
        )
    if classes["high"] is None and env.has_choice:
        raise ConfigError(
            "high=none: env.controller=choose needs a selector; use another high or env.controller=congruent, "
            "incongruent, random"
        )
    if length != "episode" and not (env.has_choice and env.can_change_option):
        why = "keeps an option for an episode" if env.has_choice else "has no options"
        raise ConfigError(f"agent.option_length={length}: env={name} {why}; use agent.option_length=episode")
    if settings.low.freeze and not env.has_choice:
        raise ConfigError("low.freeze=true: there is no choice left to learn; use low.freeze=false")
    if settings.low.freeze and length != "episode":
        raise ConfigError(
            f"agent.option_length={length}: low.freeze=true plays whole episodes; use agent.option_length=episode"
        )


_SOURCES = {"train": "its own presses", "offline": "data sets"}  # by the mode of a run


def _check_data(cfg: DictConfig, settings: RunConfig, classes: dict[str, type | None]) -> None:
    low, modes = name_of(cfg.low), classes["low"].modes
    can = f"low={low} learns from {' and '.join(_SOURCES[mode] for mode in modes)}"
    if settings.mode == "train" and "train" not in modes:
        raise ConfigError(f"mode=train: {can} only; use mode=offline data=human, or another low")
    if settings.mode == "offline" and classes["data"] is None:
        raise ConfigError("mode=offline: data=none leaves nothing to learn from; use data=human")
    if settings.mode != "eval" and classes["data"] is not None and "offline" not in modes:
        raise ConfigError(f"data={name_of(cfg.data)}: {can} only; use data=none, or another low")
    if settings.mode == "offline" and settings.low.freeze:
        raise ConfigError("low.freeze=true: mode=offline trains the learners; use low.freeze=false")


def _check_values(cfg: DictConfig, agent: HierarchicalAgent) -> None:
    if agent.selector is not None and agent.selector.needs_values and not agent.learners[0].has_value:
        raise ConfigError(
            f"high.bootstrap={cfg.high.bootstrap}: low={name_of(cfg.low)} has no value of a state; use high.bootstrap=0"
        )


def _check_collector(cfg: DictConfig, settings: RunConfig, env: PAMDPEnv, collection: type[Collection]) -> None:
    name, num_workers = name_of(cfg.collector), cfg.collector.get("num_workers", 1)
    if settings.mode == "eval":  # which collects nothing
        return
    if settings.mode == "offline" and name != "single":
        raise ConfigError(f"collector={name}: mode=offline presses nothing; use collector=single")
    if collection.package is not None and importlib.util.find_spec(collection.package) is None:
        raise ConfigError(
            f"collector={name}: {collection.package} is not installed; pip install hpamdp[{collection.package}]"
        )
    if settings.num_envs % num_workers:
        raise ConfigError(
            f"collector.num_workers={num_workers}: must divide num_envs={settings.num_envs}, of which each worker has "
            "an equal share"
        )
    if num_workers > 1 and not env.is_shardable:
        raise ConfigError(
            f"collector={name}: env={name_of(cfg.env)} learns the scale of its observations from all environments "
            "together; use collector=single or env.observation_scaling=bounds"
        )


def make_agent(cfg: DictConfig, settings: RunConfig, specs: PAMDPSpecs, device: torch.device) -> HierarchicalAgent:
    """Build both levels, as they begin.

    Raises:
        ConfigError: a wrong option.
    """
    selector = build("high", cfg.high, specs=specs, device=device) if specs.num_options else None
    is_shared = settings.agent.sharing == "shared" and specs.num_options > 0
    learner_specs, num_learners = specs, max(1, specs.num_options)
    if is_shared:
        learner_specs, num_learners = specs.with_option_observed(), 1
    learners = [_make_learner(cfg.low, learner_specs, device) for _ in range(num_learners)]
    agent = HierarchicalAgent(
        selector, learners, specs, is_shared, settings.low.freeze, settings.agent.uniform_option_frames
    )
    return agent.to(device)


def _make_learner(node: Any, specs: PAMDPSpecs, device: torch.device) -> Learner:
    return build("low", node, specs=specs, device=device)


def random_policy(parts: Parts) -> torch.nn.Module:
    """Return the policy that chooses and presses at random: the lower line of every figure."""
    specs = parts.agent.specs
    learners = [_make_learner({"_target_": "hpamdp.policies.low_level.random.Random"}, specs, parts.device)]
    selector = None
    if specs.num_options:
        selector = build("high", {"_target_": "hpamdp.policies.high_level.uniform.Uniform"}, specs=specs)
    return HierarchicalAgent(selector, learners, specs).policy


def resolve(cfg: DictConfig, overrides: Sequence[str]) -> tuple[DictConfig, RunConfig, Path | None]:
    """Return the config to run, its typed run values and the checkpoint to start from, if any.

    With `resume` or `mode=eval` the checkpoint's own config is taken, changed by what `overrides`, the command line's
    words, set anew.

    Raises:
        ConfigError: a wrong value, no such checkpoint, or a word that would change the saved agent.
    """
    settings = run_config(cfg)
    where = "resume" if settings.resume is not None else "checkpoint"
    source = settings.resume or settings.checkpoint
    if source is None:
        return cfg, settings, None
    file = checkpoint.find(source, where)
    # Early runs chose no collector and no data.
    later = {"collector": cfg.collector, "data": {"_target_": None}, "offline": cfg.offline}
    saved = OmegaConf.create(later | checkpoint.progress_of(file)["config"])
    if settings.resume is not None and settings.mode != saved.mode:
        raise ConfigError(
            f"resume={source}: a run with mode={saved.mode}; resume it so, or start one with low.checkpoint={source}"
        )
    for key in ("mode", "resume", "checkpoint"):  # what that run began with is no matter of this one
        saved[key] = cfg[key]
    for override in overrides:
        key = override.partition("=")[0].lstrip("+~")
        if key.split(".")[0] in ("high", "low", "agent", "experiment", "search"):
            raise ConfigError(f"{override}: {where} takes the agent from {file}; leave this out")
        OmegaConf.update(saved, key, OmegaConf.select(cfg, key), merge=False)
    return saved, run_config(saved), file
