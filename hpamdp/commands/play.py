"""Run `hpamdp play`, which lets people play a problem in a page, served on this computer or written as files."""

from __future__ import annotations

import argparse
import json
import math
import re
import shutil
import threading
import webbrowser
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from hpamdp.commands.page_server import DATA_NAME, EpisodeFile, PageServer, as_script
from hpamdp.config.compose import package_dir, read
from hpamdp.config.errors import ConfigError
from hpamdp.config.outside_jobs import composed
from hpamdp.config.saved import choices_of
from hpamdp.config.schema import Config
from hpamdp.env.play_page import EpisodeError, PlayPage
from hpamdp.files import replacing
from hpamdp.messages import file_and_reason, first_line, reason_of, say, warn
from hpamdp.run.assemble import make_env
from hpamdp.run.checkpoint import find, progress_of
from hpamdp.run.players import LoadedAgent, add_config_dir, load_agent, split_words, whole_number, with_config_dirs
from hpamdp.run_files import POLICY_NAME, saved_summary

_DESCRIPTION = """\
Play a problem yourself, beside agents.

  hpamdp play                                      beside the agents that come with the code
  hpamdp play --agent outputs/2025-01-31/12-00-00  beside the agent of a run; --agent can be given several times
  hpamdp play --export site                        the page as files that need no server
"""
_LOOPBACK = "127.0.0.1"
# What a page takes from the command line: the problem, which an experiment may set too, and how it is built.
_OF_A_PAGE = ("env", "experiment", "recipe", "device", "threads", "trust", "hydra")


def main(words: Sequence[str], parser: argparse.ArgumentParser) -> int:
    """Serve the page until Ctrl-C, or write it to a folder, and return the exit code.

    Raises:
        ConfigError: a word is wrong, the agent does not exist, or the problem has no page.
    """
    parser.description = _DESCRIPTION
    parser.add_argument(
        "settings",
        nargs="*",
        metavar="SETTING=VALUE",
        help="of the problem, such as env=NAME; trust=true trusts the files of agents",
    )
    parser.add_argument(
        "--agent", action="append", metavar="AGENT", help="folder or name of an agent beside you; none: no agent"
    )
    parser.add_argument("--to", type=Path, default=Path("played.jsonl"), help="file that episodes are added to")
    parser.add_argument("--seed", type=whole_number(0, 2**31 - 1), default=0, help="of the episodes that people get")
    parser.add_argument("--host", default=_LOOPBACK, help=f"address to listen on ({_LOOPBACK}: this computer alone)")
    parser.add_argument("--port", type=whole_number(0, 65535), default=8750, help="0: any that is free (8750)")
    parser.add_argument("--no-browser", action="store_true", help="do not open the browser")
    parser.add_argument("--export", type=Path, metavar="FOLDER", help="write the page as files and serve nothing")
    add_config_dir(parser)
    options = parser.parse_intermixed_args(words)
    path, settings = split_words(options.settings)
    if path is not None:
        raise ConfigError(f"{path}: not SETTING=VALUE; give an agent as --agent {path}")
    for each in settings:
        if re.split("[.=/@]", each.lstrip("+~"))[0] not in _OF_A_PAGE:
            raise ConfigError(f"{each}: has no effect on the page; give settings of the problem")
    settings = with_config_dirs(settings, options.config_dir)
    with composed(settings) as cfg:
        config = read(cfg)
    page = _page(config, options.seed)
    agents = _agents(page, options.agent, config, settings)
    try:
        data = page.data(agents, has_server=options.export is None)
    except EpisodeError as error:
        raise ConfigError(f"--agent {error}") from error
    if options.export is not None:
        export(page, data, options.export)
        say(f"{options.export / 'index.html'}: open it in a browser, or put the folder on any web server")
        return 0
    return serve(page, data, options)


def _page(config: Config, seed: int) -> PlayPage:
    torch.set_num_threads(config.run.threads)
    env = make_env(config, 1, config.run.resolve_device(), 0)
    try:
        page = env.page(seed)
    except ValueError as error:
        raise ConfigError(f"env: {first_line(error)}") from error
    if page is None:
        raise ConfigError(f"{config.env}: there is no page to play it on")
    return page


def _agents(
    page: PlayPage, names: Sequence[str] | None, config: Config, settings: Sequence[str]
) -> list[dict[str, Any]]:
    """Return the named agents in the page's form; without `names`, those of this package."""
    if page.shows_agents:
        return own_agents(config) if names is None else given_agents(names, config, settings)
    if names is not None and (name := next((each for each in names if each != "none"), None)) is not None:
        raise ConfigError(f"--agent {name}: people play {config.env} alone; leave it out")
    return []


def own_agents(config: Config) -> list[dict[str, Any]]:
    """Return the agents of this package that fit the problem and its page."""
    folder = package_dir("agents")
    if folder is None:
        return []
    files = sorted(folder.glob(f"*/{POLICY_NAME}"))
    # Most agents are for other problems, and building an agent takes half a second.
    folders = [file.parent for file in files if choices_of(progress_of(file)["config"])["env"] == config.env.name]
    agents = [described(each, load_agent(str(each), [])) for each in folders]
    return [agent for agent in agents if agent is not None]


def given_agents(names: Sequence[str], config: Config, settings: Sequence[str]) -> list[dict[str, Any]]:
    """Return these agents in the page's form.

    Args:
        names: folders or files of agents, or names of those that come with the package; `none` stands for no agent.
        config: the config of the page's problem.
        settings: the words of the command line that led to `config`.

    Raises:
        ConfigError: an agent does not exist, is of another problem, or the page cannot show it.
    """
    agents = []
    for name in names:
        if name == "none":
            continue
        player = load_agent(name, permissions(name, config, settings))
        if player.config.env.cls is not config.env.cls:
            raise ConfigError(f"--agent {name}: was trained on {player.config.env}, but the page is of {config.env}")
        agent = described(find(name, "--agent").parent, player)
        if agent is None:
            raise ConfigError(
                f"--agent {name}: {player.config.high} over {player.config.low} cannot be taken into a page"
            )
        agents.append(agent)
    return agents


def permissions(name: str, config: Config, settings: Sequence[str]) -> list[str]:
    """Return the user's words that an agent's config needs: guarded settings, `trust`, and folders of yaml files."""
    is_same_problem = choices_of(progress_of(find(name, "checkpoint"))["config"])["env"] == config.env.name
    given = [word.partition("=") for word in settings]
    return [
        f"{setting}={value}"
        for setting, _, value in given
        if setting in ("trust", "hydra.searchpath")
        or (is_same_problem and config.env.is_guarded(setting.removeprefix("env."), value))
    ]


def described(folder: Path, player: LoadedAgent) -> dict[str, Any] | None:
    """Return what the page needs of the agent in a folder; None if its networks cannot be exported."""
    form = player.agent.exported()
    if form is None:
        return None
    config = player.config
    title = config.low.name if config.high.target is None else f"{config.high.name} + {config.low.name}"
    score: Any = saved_summary(folder).get("score")
    options = json.loads(json.dumps(dict(config.env.settings)))
    return {
        "name": folder.resolve().name,
        "title": title,
        "score": score if type(score) in (int, float) and math.isfinite(score) else None,
        "env": options,
        "agent": form,
    }


def export(page: PlayPage, data: dict[str, Any], folder: Path) -> None:
    """Write the page to a folder, which need not be empty.

    Raises:
        ConfigError: the folder cannot be written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, file in page.files.items():
            with replacing(folder / name) as partial:
                shutil.copyfile(file, partial)
        with replacing(folder / DATA_NAME) as partial:
            partial.write_bytes(as_script(data))
    except OSError as error:
        raise ConfigError(f"--export {folder}: {reason_of(error)}") from error


def serve(page: PlayPage, data: dict[str, Any], options: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C."""
    try:
        episodes = EpisodeFile(options.to, page)
    except EpisodeError as error:
        raise ConfigError(f"--to {error}") from error
    except OSError as error:
        raise ConfigError(f"--to {file_and_reason(error)}") from error
    try:
        server = PageServer((options.host, options.port), page, data, episodes)
    except OSError as error:
        raise ConfigError(f"--host {options.host} --port {options.port}: {reason_of(error)}") from error
    if not server.is_local:
        warn(f"--host {options.host}: others who reach this address can play and add episodes to {options.to}")
    say(f"{server.address}: episodes go to {options.to}; Ctrl-C ends it")
    if not options.no_browser:
        threading.Timer(0.2, webbrowser.open, [server.address]).start()
    with server:
        try:
            server.serve_forever(poll_interval=0.2)
        except KeyboardInterrupt:
            say(f"{options.to}: {len(episodes.added)} episodes added")
            if told := page.told(episodes.added):
                say(told)
    return 0
