"""Run `hpamdp judge`: order trained agents by recorded transitions alone, and say where these do not suffice."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from hpamdp import keys
from hpamdp.analysis.statistics import mean_interval
from hpamdp.commands.fitted_values import fitted_values
from hpamdp.commands.importance import RecordedEpisodes
from hpamdp.commands.recorded_problem import RecordedProblem, Rollout, starts_of
from hpamdp.config.compose import choosing, read, setting_of
from hpamdp.config.errors import ConfigError
from hpamdp.config.outside_jobs import composed
from hpamdp.config.schema import Config
from hpamdp.data.row_checks import PERSON
from hpamdp.env.decisions import DecisionTracker, decision_tracker
from hpamdp.messages import aligned, say
from hpamdp.run.assemble import make_data, option_length
from hpamdp.run.players import (
    LoadedAgent,
    add_config_dir,
    load_agent,
    paths_and_settings,
    whole_number,
    with_config_dirs,
)
from hpamdp.specs import PAMDPSpecs

DEFAULT_EPISODES = 100
_DESCRIPTION = """\
Order trained agents by recorded transitions, without their environment. A model of the transitions predicts what each
agent gets. Let it learn from people of whom the agents know nothing:

  python run.py mode=offline data=human data.held_out=[0,3,6,9,12] high=linucb low=iql    # a run, and others like it
  hpamdp judge outputs/DATE/TIME outputs/DATE/TIME data=human data.rest_to_rest=clean

SETTING=VALUE are those of `mode=offline low=pets`. If the runs hold out the same people, data.held_out is theirs. With
data=minari it is a fraction of the episodes, such as data.held_out=0.5.
"""
_LEAST_COVERED, _MOST_UNFINISHED = 0.8, 0.05
_LEAST_EFFECTIVE, _LEAST_WHOLE = 30, 0.8  # episodes; a mean of fewer tells little


def main(words: Sequence[str], parser: argparse.ArgumentParser) -> int:
    """Print a line for each agent, the best first, and what the data cannot tell; return the exit code.

    Raises:
        ConfigError: a word is wrong, an agent does not exist, or the data cannot judge it.
    """
    parser.description = _DESCRIPTION
    parser.add_argument("words", nargs="+", metavar="AGENT or SETTING=VALUE", help="the agents, and the data")
    parser.add_argument(
        "--episodes",
        type=whole_number(1, 10_000),
        default=DEFAULT_EPISODES,
        help=f"starts of recorded episodes ({DEFAULT_EPISODES})",
    )
    parser.add_argument(
        "--compare", action="store_true", help="also estimate returns by fitted Q evaluation and importance sampling"
    )
    add_config_dir(parser)
    options = parser.parse_intermixed_args(words)
    paths, settings = paths_and_settings(options.words)
    rows = judged(
        paths, with_config_dirs(settings, options.config_dir), episodes=options.episodes, compare=options.compare
    )
    say(_table(rows))
    return 0


def judged(
    paths: Sequence[str],
    words: Sequence[str],
    settings: Sequence[tuple[str, Any]] = (),
    *,
    episodes: int,
    compare: bool = False,
) -> list[dict[str, Any]]:
    """Return what recorded transitions say of agents, the one with the highest return first; see `hpamdp.judge`."""
    if not paths:
        raise ConfigError("judge: nobody to judge; give the folders of runs")
    of_problem = [word for word in words if setting_of(word).startswith("env.")]
    agents = [load_agent(path, of_problem) for path in paths]
    first = agents[0]
    for path, other in zip(paths, agents, strict=True):
        if other.config.env != first.config.env:
            raise ConfigError(f"judge: {path} is of another problem than {paths[0]}; judge them one by one")
        _check_reads_observations(path, other)
    chosen = dict(word.split("=", 1) for word in words).get("data")
    held_out = _common([_data_settings_of(each).get("held_out") for each in agents if _data_of(each) == chosen])
    given = {setting_of(word) for word in words} | {name for name, _ in settings}
    more = [f"data.held_out={held_out}".replace(" ", "")] if held_out and not given & _HELD_OUT_SETTINGS else []
    with composed(["mode=offline", "low=pets", choosing("env", first.config.env.name), *words, *more], settings) as cfg:
        config = read(cfg)
    if config.data.target is None:
        raise ConfigError("judge: no recorded transitions; name a data set, such as data=human")
    torch.set_num_threads(config.run.threads)
    data = make_data(config, first.env, 1.0)
    assert data is not None
    rows = (data.batch if data.held_out is None else data.held_out).squeeze(0)
    starts, people = starts_of(rows, episodes, config.run.seed)
    max_steps = int(rows["next", keys.OPTION_STEPS].max())
    specs = PAMDPSpecs.from_env(first.env)
    torch.manual_seed(config.run.seed)
    learner = config.low.build(specs=specs.with_option_observed() if specs.num_options else specs)
    problem = RecordedProblem(learner, specs, rows, config.run.offline.updates)
    found = []
    for path, each in zip(paths, agents, strict=True):
        rollout = problem.roll_out(each.agent, _tracker_of(each), starts, max_steps)
        doubts = [*_doubts(rollout, max_steps), *_is_known(each, config, rows)]
        found.append({"agent": path, **_row(rollout, people), "doubts": doubts})
    if compare:
        recorded = RecordedEpisodes(specs, rows)
        for row, each in zip(found, agents, strict=True):
            torch.manual_seed(config.run.seed)  # so that an agent's figures do not depend on the others
            _compare(row, each, problem, recorded, rows, starts, config.run.offline.updates)
    return sorted(found, key=lambda row: -row["return"])


def _compare(
    row: dict[str, Any],
    loaded: LoadedAgent,
    problem: RecordedProblem,
    recorded: RecordedEpisodes,
    rows: TensorDict,
    starts: Tensor,
    num_updates: int,
) -> None:
    """Add to an agent's row what fitted Q evaluation and importance sampling tell of it, and what they cannot tell."""
    agent, tracker, doubts = loaded.agent, _tracker_of(loaded), row["doubts"]
    row |= {"fitted": math.nan, "importance": math.nan, "effective": 0.0}
    if tracker.ends_inside or any(learner.memory_key for learner in agent.learners):
        why = "options that end inside episodes" if tracker.ends_inside else "a memory"
        doubts.append(f"it has {why}, so that only roll-outs judge it")
        return
    row["fitted"] = float(fitted_values(problem, rows, agent, tracker, starts, num_updates).mean())
    row["importance"], row["effective"] = recorded.estimate(agent, tracker)
    whole, num = len(recorded.returns), recorded.num_recorded
    if row["effective"] < _LEAST_EFFECTIVE or whole < _LEAST_WHOLE * num:
        rests = f"importance sampling rests on {row['effective']:.1f} of them"
        doubts.append(f"{whole} of {num} episodes have no gap and end by themselves; {rests}")


def _tracker_of(loaded: LoadedAgent) -> DecisionTracker:
    return decision_tracker(loaded.env, option_length=option_length(loaded.config))


_HELD_OUT_SETTINGS = {"data.held_out", "data.people"}


def _check_reads_observations(path: str, loaded: LoadedAgent) -> None:
    """Refuse an agent that reads what a model of observations does not predict."""
    for level in (loaded.config.high, *loaded.config.learners):
        if level.card.needs:
            raise ConfigError(f"judge: {path}: {level} asks the environment itself, which is not there")
    selector = loaded.agent.selector
    if selector is not None and keys.OPTION_RETURN in selector.in_keys:
        raise ConfigError(f"judge: {path}: {loaded.config.high} chooses by the rewards of earlier trips")


def _data_of(loaded: LoadedAgent) -> str:
    """Return the name of the data that an agent learned from, or `none`."""
    return str(loaded.progress.get("config", {}).get("choices", {}).get("data", "none"))


def _data_settings_of(loaded: LoadedAgent) -> Mapping[str, Any]:
    """Return the settings of the data that an agent learned from; empty if it learned from none."""
    return {} if _data_of(loaded) == "none" else loaded.progress["config"].get("data", {})


def _common(values: Sequence[Any]) -> Any:
    """Return what all runs with data hold out, if it is the same; else None."""
    given = [each for each in values if each]
    return given[0] if given and all(each == given[0] for each in given) else None


def _row(rollout: Rollout, people: np.ndarray | None) -> dict[str, Any]:
    mean = rollout.returns.mean(0).double().cpu().numpy()
    units = mean if people is None else np.array([mean[people == each].mean() for each in np.unique(people)])
    by_member = rollout.returns.double().mean(1)
    return {
        "return": float(mean.mean()),
        "interval": mean_interval(units.tolist() if len(units) > 1 else mean.tolist()),
        "between_members": float(by_member.std()) if len(by_member) > 1 else 0.0,
        "coverage": rollout.coverage,
        "steps": rollout.steps,
        "unfinished": rollout.unfinished,
    }


def _doubts(rollout: Rollout, max_steps: int) -> list[str]:
    """Return what the data cannot tell of an agent."""
    doubts = []
    if rollout.coverage < _LEAST_COVERED:
        doubts.append(
            f"only {rollout.coverage:.0%} of its actions are like recorded ones; of the others nothing is known"
        )
    if rollout.unfinished > _MOST_UNFINISHED:
        doubts.append(f"{rollout.unfinished:.0%} of its episodes go on after {max_steps} steps, the longest recorded")
    return doubts


def _is_known(loaded: LoadedAgent, config: Config, rows: TensorDict) -> list[str]:
    """Return a doubt if an agent may have learned from the transitions `[M]` that judge it.

    Without persons it is known to have not only if it held out the same part of the same data.
    """
    learned = _data_settings_of(loaded)
    if not learned or _data_of(loaded) != config.data.name:
        return []
    if PERSON in rows.keys():
        judging = set(rows[PERSON].unique().tolist())
        known = judging & set(learned.get("people") or judging)
        if known <= set(learned.get("held_out") or ()):
            return []
    elif learned.get("held_out") and all(learned.get(name) == value for name, value in config.data.settings.items()):
        return []
    return ["it may have learned from the transitions that judge it; hold some out of its data (data.held_out)"]


def _table(rows: Sequence[Mapping[str, Any]]) -> str:
    header = ["", "return", "95 % over people", "between members", "covered", "steps"]
    methods = ["fitted", "importance", "effective"] if "fitted" in rows[0] else []
    cells = [
        [
            row["agent"],
            f"{row['return']:.3f}",
            "{:.3f} to {:.3f}".format(*row["interval"]),
            f"{row['between_members']:.3f}",
            f"{row['coverage']:.0%}",
            f"{row['steps']:.2f}",
            *(f"{row[name]:.{1 if name == 'effective' else 3}f}" for name in methods),
        ]
        for row in rows
    ]
    return "\n".join(
        [*aligned([header + methods, *cells]), *(f"{row['agent']}: {doubt}" for row in rows for doubt in row["doubts"])]
    )
