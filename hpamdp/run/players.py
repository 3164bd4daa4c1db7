"""Build players: a saved agent, or a player from a command line, such as `low=planner high=oracle`."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from hpamdp.config.compose import choosing, job_overrides, read, setting_of
from hpamdp.config.errors import ConfigError
from hpamdp.config.outside_jobs import composed, searching
from hpamdp.config.schema import Config
from hpamdp.env.base import PAMDPEnv
from hpamdp.env.errors import closed_on_error
from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.run import checkpoint
from hpamdp.run.assemble import check_built, choose_selector, make_agent, make_env, make_evaluation
from hpamdp.run.compatibility import check, check_effects
from hpamdp.run.evaluate import Evaluation
from hpamdp.run.resume import check_saved_options, resolve, saved_words
from hpamdp.specs import PAMDPSpecs

# Settings that name a saved run, which a player has without a setting.
_SAVED = ("checkpoint", "resume", "low.checkpoint")


@dataclass(frozen=True)
class LoadedAgent:
    """A saved agent, or an agent that settings describe, ready to act.

    Attributes:
        config: config of the agent and its problem.
        agent: the agent, with the weights of its checkpoint if there is one.
        env: one environment, which scales observations as the agent's own did.
        progress: what the checkpoint tells of its run; empty without a checkpoint.
    """

    config: Config
    agent: HierarchicalAgent
    env: PAMDPEnv
    progress: Mapping[str, Any]

    def evaluation(self) -> Evaluation:
        """Return an evaluation with `eval.layouts` episodes, all of them filmed."""
        num_filmed = self.config.run.eval.layouts
        with closed_on_error(self.env):
            return make_evaluation(self.config, self.env, num_filmed=num_filmed, filmed_steps=None)


def paths_and_settings(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the paths among a command line's words, and the settings."""
    paths = [word for word in words if "=" not in word or os.path.exists(word)]
    return paths, [word for word in words if word not in paths]


def split_words(words: Sequence[str]) -> tuple[str | None, list[str]]:
    """Return the path among a command line's words, if there is one, and the settings.

    Raises:
        ConfigError: there are several paths.
    """
    paths, settings = paths_and_settings(words)
    if len(paths) > 1:
        raise ConfigError(f"{' '.join(paths)}: several agents; give one, and settings as SETTING=VALUE")
    return (paths[0] if paths else None), settings


def add_config_dir(parser: argparse.ArgumentParser) -> None:
    """Add the flag `--config-dir`, as the main command has it, except that it can be given several times."""
    parser.add_argument(
        "--config-dir", "-cd", action="append", default=[], metavar="FOLDER", help="yaml files of your own"
    )


def with_config_dirs(settings: Sequence[str], folders: Sequence[str]) -> list[str]:
    """Return settings with the word that adds the folders of `--config-dir`.

    Raises:
        ConfigError: a folder does not exist, or the settings name folders, too.
    """
    if folders and any(each.startswith("hydra.searchpath=") for each in settings):
        raise ConfigError("--config-dir and hydra.searchpath: give all folders in one of them")
    return [*searching(folders, "--config-dir"), *settings]


def whole_number(least: int, most: int) -> Callable[[str], int]:
    """Return a function for `argparse` that reads a whole number in this range."""

    def read_number(text: str) -> int:
        if not text.isdecimal() or not least <= int(text) <= most:
            raise argparse.ArgumentTypeError(f"{text}: must be a whole number from {least} to {most}")
        return int(text)

    return read_number


def load_agent(
    path: str | None,
    words: Sequence[str],
    settings: Sequence[tuple[str, Any]] = (),
    objects: Mapping[str, Any] | None = None,
    *,
    where: str = "player",
) -> LoadedAgent:
    """Load a saved agent, or build one that settings describe.

    Args:
        path: the agent's folder, a checkpoint, `policy.safetensors`, or the name of an agent that comes with the
            package. If None, the settings describe the agent.
        words: words of a command line, such as `env=goal` or `eval.layouts=6`.
        settings: settings from Python code, as for `composed`.
        objects: arguments for the problem's constructor from Python code.
        where: `player`, who is watched or played with, or `agent`, which Python code loads.

    Raises:
        ConfigError: the agent does not exist, or a setting is wrong or has no effect.
    """
    for each in words:
        if setting_of(each) in _SAVED:
            raise ConfigError(f"{each}: give the folder or the name of a saved agent alone, without a setting")
    of_run: list[str] = []
    if path is not None:
        of_run = [*saved_words(path, "checkpoint", words), "mode=eval", choosing("checkpoint", path)]
    with composed([*of_run, *words], settings) as cfg:
        given = [each for each in job_overrides() if each not in of_run]
        check_effects(where, given)
        if path is None:
            check_effects("eval", given)
            config, source = choose_selector(read(cfg).with_objects(objects).with_run(mode="eval"), given), None
            check(config)
        else:
            config, source = resolve(cfg, given, objects)
        torch.set_num_threads(config.run.threads)
        torch.manual_seed(config.run.seed)
        device = config.run.resolve_device()
        env = make_env(config, 1, device, config.run.seed)
        with closed_on_error(env):
            check_built(config, env)
            agent = make_agent(config, PAMDPSpecs.from_env(env), device)
            if source is None:
                return LoadedAgent(config, agent, env, {})
            check_saved_options(config, env, source)
            saved = checkpoint.load(source, agent, device, with_training=False)
            saved.set_statistics(env)
            return LoadedAgent(config, agent, env, saved.progress)
