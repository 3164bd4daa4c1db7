"""The parts of a run from its config: environment, agent, evaluation, logger."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from torchrl.envs import TransformedEnv

from hpamdp import checkpoint
from hpamdp.config import ConfigError, RunConfig, build, name_of, run_config, validate
from hpamdp.env.decisions import with_decisions
from hpamdp.evaluate import Evaluation
from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.policies.base import Learner, Selector
from hpamdp.specs import PAMDPSpecs

# What the builder supplies; the rest of a constructor's arguments is the yaml's.
CONTEXT = {
    "env": ("num_envs", "device", "seed", "oracle"),
    "high": ("specs", "device"),
    "low": ("specs", "device"),
    "logger": ("output_dir", "config"),
}


@dataclass
class Parts:
    """What a run is made of."""

    env: TransformedEnv
    evaluation: Evaluation
    agent: HierarchicalAgent
    logger: Any
    device: torch.device


def assemble(cfg: DictConfig, settings: RunConfig, output_dir: Path) -> Parts:
    """Check every group, then build them.

    Raises:
        ConfigError: the first wrong value or impossible pair found.
    """
    classes = {group: validate(group, cfg[group], context)[0] for group, context in CONTEXT.items()}
    has_selector = classes["high"] is not None
    needs_oracle = [group for group in ("high", "low") if classes[group] is not None and classes[group].needs_oracle]
    if needs_oracle and "oracle" not in inspect.signature(classes["env"].__init__).parameters:
        group = needs_oracle[0]
        raise ConfigError(f"{group}={name_of(cfg[group])}: env={name_of(cfg.env)} has no planner to ask")
    device = settings.resolve_device()
    env = _make_env(cfg, settings.num_envs, settings.seed, device, bool(needs_oracle))
    specs = PAMDPSpecs.from_env(env)
    _check_choice(cfg, specs, has_selector)
    selector = build("high", cfg.high, specs=specs, device=device) if has_selector else None
    agent = _make_agent(cfg, settings, specs, selector, device)
    evaluation = Evaluation(_make_env(cfg, settings.eval.layouts, 0, device, bool(needs_oracle)), settings.eval.seed)
    config = OmegaConf.to_container(cfg, resolve=True)
    return Parts(env, evaluation, agent, build("logger", cfg.logger, output_dir=output_dir, config=config), device)


def _make_env(cfg: DictConfig, num_envs: int, seed: int, device: torch.device, needs_oracle: bool) -> TransformedEnv:
    context: dict[str, Any] = {"num_envs": num_envs, "seed": seed, "device": device}
    if needs_oracle:
        context["oracle"] = True
    return with_decisions(build("env", cfg.env, **context))


def _check_choice(cfg: DictConfig, specs: PAMDPSpecs, has_selector: bool) -> None:
    if has_selector and "controller" not in cfg.env and not specs.num_options:
        raise ConfigError(
            f"high={name_of(cfg.high)}: env={name_of(cfg.env)} has no options to choose from; use high=none"
        )
    if has_selector and not specs.num_options:
        raise ConfigError(
            f"high={name_of(cfg.high)}: env.controller={cfg.env.controller} leaves nothing to choose; use high=none or "
            "env.controller=choose"
        )
    if not has_selector and specs.num_options:
        raise ConfigError(
            "high=none: env.controller=choose needs a selector; use another high or env.controller=congruent, "
            "incongruent, random"
        )


def _make_agent(
    cfg: DictConfig, settings: RunConfig, specs: PAMDPSpecs, selector: Selector | None, device: torch.device
) -> HierarchicalAgent:
    is_shared = settings.agent.sharing == "shared" and specs.num_options > 0
    learner_specs, num_learners = specs, max(1, specs.num_options)
    if is_shared:
        learner_specs, num_learners = specs.with_option_observed(), 1
    learners = [_make_learner(cfg.low, learner_specs, device) for _ in range(num_learners)]
    return HierarchicalAgent(selector, learners, specs, is_shared).to(device)


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
    saved = OmegaConf.create(checkpoint.progress_of(file)["config"])
    for override in overrides:
        key = override.partition("=")[0].lstrip("+~")
        if key.split(".")[0] in ("high", "low", "agent", "experiment"):
            raise ConfigError(f"{override}: {where} takes the agent from {file}; leave this out")
        OmegaConf.update(saved, key, OmegaConf.select(cfg, key), merge=False)
    return saved, run_config(saved), file
