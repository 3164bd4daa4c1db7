"""Build players: a saved agent, or a player from a command line, such as `low=planner high=oracle`."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from hpamdp.config.compose import choosing, compose_words, read
from hpamdp.config.errors import ConfigError
from hpamdp.config.schema import Config
from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.run import checkpoint
from hpamdp.run.assemble import check_built, choose_selector, make_agent, make_env, make_evaluation
from hpamdp.run.evaluate import Evaluation
from hpamdp.run.resume import check_saved_options, resolve, saved_choices
from hpamdp.specs import PAMDPSpecs


@dataclass(frozen=True)
class Player:
    """An agent, and episodes to watch it play.

    Attributes:
        config: config of the agent and its problem.
        agent: the agent, with the weights of its checkpoint if there is one.
        evaluation: evaluation with `eval.layouts` episodes, all of them filmed.
    """

    config: Config
    agent: HierarchicalAgent
    evaluation: Evaluation


def split_words(words: Sequence[str]) -> tuple[str | None, list[str]]:
    """Return the path among a command line's words, if there is one, and the settings.

    Raises:
        ConfigError: there are several paths.
    """
    paths = [word for word in words if "=" not in word or os.path.exists(word)]
    if len(paths) > 1:
        raise ConfigError(f"{' '.join(paths)}: several agents; give one, and settings as SETTING=VALUE")
    return (paths[0] if paths else None), [word for word in words if word not in paths]


def whole_number(least: int, most: int) -> Callable[[str], int]:
    """Return a function for `argparse` that reads a whole number in this range."""

    def read_number(text: str) -> int:
        if not text.isdecimal() or not least <= int(text) <= most:
            raise argparse.ArgumentTypeError(f"{text}: must be a whole number from {least} to {most}")
        return int(text)

    return read_number


def load_player(path: str | None, settings: Sequence[str]) -> Player:
    """Build a player.

    Args:
        path: the agent's folder, a checkpoint or `policy.pt`. If None, the settings describe the player.
        settings: words of a command line, such as `env=goal` or `eval.layouts=6`.

    Raises:
        ConfigError: the agent does not exist, or a setting is wrong.
    """
    config, source = _config(path, list(settings))
    torch.set_num_threads(config.run.threads)
    torch.manual_seed(config.run.seed)
    device = config.run.resolve_device()
    env = make_env(config, 1, device, config.run.seed)
    check_built(config, env)
    agent = make_agent(config, PAMDPSpecs.from_env(env), device)
    if source is not None:
        check_saved_options(config, env)
        saved = checkpoint.load(source, agent, device, with_training=False)
        saved.set_statistics(env)
    return Player(config, agent, make_evaluation(config, env, num_filmed=config.run.eval.layouts, filmed_steps=None))


def _config(path: str | None, settings: list[str]) -> tuple[Config, Path | None]:
    if path is None:
        return choose_selector(read(compose_words(settings)), settings), None
    chosen = saved_choices(path, "checkpoint", settings)
    given = {word.partition("=")[0] for word in settings}
    words = [choosing(group, name) for group, name in chosen.items() if group not in given]
    cfg = compose_words([*words, *settings])
    cfg.mode, cfg.checkpoint = "eval", path
    return resolve(cfg, settings)
