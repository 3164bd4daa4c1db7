"""Run `hpamdp watch`, which films an agent, or a random or planned player, at its problem."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from torch import Tensor

from hpamdp.analysis import film
from hpamdp.config.compose import setting_of
from hpamdp.config.errors import ConfigError
from hpamdp.messages import reason_of, say
from hpamdp.run.players import add_config_dir, load_agent, split_words, whole_number, with_config_dirs

_DESCRIPTION = """\
Film an agent at its problem.

  hpamdp watch outputs/2025-01-31/12-00-00                 a run's agent
  hpamdp watch linucb_hppo --to a.mp4 --episodes 9         one that comes with the code; .mp4 needs hpamdp[video]
  hpamdp watch --config-dir conf outputs/mine              one of a problem or a learner of your own
  hpamdp watch outputs/shared trust=true                   somebody else's, whose environment may run code
  hpamdp watch low=planner high=oracle                     the best plan
  hpamdp watch low=random high=none env=platform           random actions on another problem
"""
# Settings that the command sets itself, and its flags in their place.
_FLAGS = {"eval.layouts": "--episodes", "eval.seed": "--seed"}


def main(words: Sequence[str], parser: argparse.ArgumentParser) -> int:
    """Write the film, print its scores, and return the exit code.

    Raises:
        ConfigError: a word is wrong, the agent does not exist, or the problem has no pictures.
    """
    parser.description = _DESCRIPTION
    parser.add_argument("player", nargs="*", metavar="AGENT or GROUP=CHOICE", help="who plays, and at what")
    parser.add_argument("--to", type=Path, default=Path("episodes.gif"), help="file to write, .gif or .mp4")
    parser.add_argument("--episodes", type=whole_number(1, 10_000), default=6, help="how many (6)")
    parser.add_argument("--seed", type=int, default=0, help="of the episodes; those of evaluations have seed 0")
    parser.add_argument("--fps", type=whole_number(1, film.MOST_FPS), default=25, help="pictures a second (25)")
    parser.add_argument(
        "--size", type=whole_number(20, 4096), default=320, help="height and width of a square picture, px (320)"
    )
    add_config_dir(parser)
    options = parser.parse_intermixed_args(words)
    _check_film(options)
    path, settings = split_words(options.player)
    for each in settings:
        flag = _FLAGS.get(setting_of(each))
        if flag is not None:
            raise ConfigError(f"{each}: the command has a flag for it; use {flag}")
    if path is None and not settings:
        raise ConfigError("watch: nobody to watch; give a run's folder, or a player such as low=planner high=oracle")
    episodes = [f"eval.layouts={options.episodes}", f"eval.seed={options.seed}", "film=true"]
    player = load_agent(path, [*with_config_dirs(settings, options.config_dir), *episodes])
    evaluation = player.evaluation()
    draws = player.config.env.settings.get("render") is not False
    lack = f"{player.config.env}: has no pictures to film{'' if draws else '; use env.render=true'}"
    if not evaluation.problem.film_state(1):
        raise ConfigError(lack)
    states: list[dict[str, Tensor]] = []
    played = evaluation.run(player.agent.policy, states)
    pictures = film.film(evaluation.problem, film.tracks_of(states), float(options.fps), options.size)
    try:
        film.write(options.to, pictures, float(options.fps))
    except film.NoPictureError as error:
        raise ConfigError(lack) from error
    except film.TooLargeError as error:
        raise ConfigError(f"--size {options.size} --episodes {options.episodes}: {error}") from error
    except film.FilmError as error:
        raise ConfigError(f"--to {error}") from error
    except OSError as error:
        raise ConfigError(f"--to {options.to}: {reason_of(error)}") from error
    scores = ", ".join(f"{score:.2f}" for score in played["score"])
    say(f"{options.to}: {len(played['score'])} episodes, scores {scores}")
    return 0


def _check_film(options: argparse.Namespace) -> None:
    if options.to.suffix not in film.SUFFIXES:
        raise ConfigError(f"--to {options.to}: must end in {' or '.join(film.SUFFIXES)}")
    if options.to.suffix == ".gif" and options.fps > film.GIF_FPS:
        raise ConfigError(f"--fps {options.fps}: a GIF shows at most {film.GIF_FPS} pictures a second; write an .mp4")
