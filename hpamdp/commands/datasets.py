"""Run `hpamdp datasets`, which makes the data sets of the offline benchmark in Minari's folder."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType

from hpamdp import keys
from hpamdp.acting import acting
from hpamdp.config.compose import read
from hpamdp.config.errors import ConfigError
from hpamdp.config.outside_jobs import composed
from hpamdp.data import DataError, minari
from hpamdp.env.decisions import with_decisions
from hpamdp.env.registration import register
from hpamdp.messages import say, warn
from hpamdp.policies.masks import random_action
from hpamdp.policies.random_agent import random_agent
from hpamdp.run.assemble import assemble, make_data, make_env
from hpamdp.run.players import load_agent
from hpamdp.specs import PAMDPSpecs

_DESCRIPTION = """\
Make data sets of the offline benchmark, in Minari's folder ($MINARI_DATASETS_PATH). Without a name: list them.

  hpamdp datasets hpamdp/platform/mixed-v0
  python run.py mode=offline env=platform data=minari data.dataset=hpamdp/platform/mixed-v0 high=none low=iql
"""
# For each domain: `env_id` and `env_kwargs` of its environment in Gymnasium, and the `layout` of its actions; the
# `agent` that comes with the package; `noise`, the probability of a random action of the medium player; `episodes` of a
# data set; `frames`, the steps of the agent's training from which `replay` takes them; mean returns of the data sets
# `random` and `expert`; mean scores of random actions and of the best learner, for the benchmark's table; `recorded`,
# the words that choose recordings; `checksums`.
DOMAINS: dict[str, dict[str, Any]] = json.loads(Path(__file__).with_name("datasets.json").read_text())
# Which part of the episodes of `mixed` comes from each of these data sets.
_MIXED = {"random": 0.5, "medium": 0.4, "expert": 0.1}
_SEEDS = {"random": 1, "medium": 2, "expert": 3}  # of the episodes


def names() -> list[str]:
    """Return the names of all data sets."""
    return [f"hpamdp/{domain}/{part}-v0" for domain, each in DOMAINS.items() for part in each["checksums"]]


def main(words: Sequence[str], parser: argparse.ArgumentParser) -> int:
    """Make the named data sets, print a line for each, and return the exit code.

    Raises:
        ConfigError: there is no such data set, or it cannot be made.
    """
    parser.description = _DESCRIPTION
    parser.add_argument("names", nargs="*", metavar="NAME", help="data sets to make, unless they are there")
    given = parser.parse_args(words).names
    for name in given:
        if name not in names():
            raise ConfigError(f"{name}: no data set of the package; hpamdp datasets lists them")
    for name in given:
        say(_made(name))
    if not given:
        say("\n".join(names()))
    return 0


def _made(name: str) -> str:
    """Make a data set unless it is there, and return its figures in a line."""
    domain, part = name.removesuffix("-v0").split("/")[1:]
    try:
        if not minari.is_there(name):
            make(domain, part)
        rows = minari.load(name)
    except DataError as error:
        raise ConfigError(str(error)) from error
    found, published = minari.checksum(rows), DOMAINS[domain]["checksums"][part]
    if found != published:
        warn(f"{name}: its checksum is not {published}; other versions or another processor made it")
    num = int(rows["next", keys.DONE].sum())
    mean = float(rows["next", keys.REWARD].sum()) / num
    return f"{name}: {num:,} episodes, {len(rows):,} steps, mean return {mean:.3f}, checksum {found}"


def make(domain: str, part: str) -> None:
    """Make a data set in Minari's folder.

    Raises:
        DataError: Minari is missing or refuses the data.
        ConfigError: the recording is missing.
    """
    settings = DOMAINS[domain]
    register()
    players = {"random": "random actions", **dict.fromkeys(settings["recorded"], "people")}
    minari.export(
        transitions(domain, part),
        f"hpamdp/{domain}/{part}-v0",
        minari.MinariLayout(**settings.get("layout", {})),
        env_id=settings["env_id"],
        env_kwargs=settings.get("env_kwargs"),
        algorithm_name=players.get(part, settings["agent"]),
        description=f"`{part}` of hpamdp's offline benchmark. Reference scores: returns of `random` and `expert`.",
        # Those of `human-sparse` have other rewards.
        reference_scores=None if part == "human-sparse" else (settings["random_return"], settings["expert_return"]),
    )


def transitions(domain: str, part: str) -> TensorDict:
    """Return the transitions `[N]` of a data set, without numbers of episodes.

    Raises:
        ConfigError: the recording is missing.
    """
    settings = DOMAINS[domain]
    if part in settings["recorded"]:
        return _recorded(settings["recorded"][part])
    if part == "replay":
        return _trained(settings["agent"], settings["frames"], settings["episodes"])
    noise = {"random": 1.0, "medium": settings["noise"], "expert": 0.0}
    if part in noise:
        return _acted(settings["agent"], noise[part], settings["episodes"], _SEEDS[part])
    parts = []
    for name, fraction in _MIXED.items():
        rows = transitions(domain, name)
        parts.append(rows[_episode_of(rows) < fraction * settings["episodes"]])
    return torch.cat(parts)


def _acted(name: str, noise: float, num_episodes: int, seed: int) -> TensorDict:
    """Return episodes of a greedy agent, some of whose actions are random, or of random actions alone."""
    loaded = load_agent(name, ["eval.layouts=1"])
    env = with_decisions(make_env(loaded.config, num_episodes, torch.device("cpu"), seed))
    env.set_scaling_from(loaded.env)
    specs = PAMDPSpecs.from_env(env.base_env)
    agent = random_agent(specs, env.device) if noise == 1.0 else loaded.agent
    torch.manual_seed(seed)
    with closing(env), acting(ExplorationType.DETERMINISTIC), torch.no_grad():
        played = env.rollout(
            env.max_steps, _Noisy(agent.policy, specs, noise), break_when_any_done=False, break_when_all_done=True
        )
    done = played["next", keys.DONE].squeeze(-1).long()
    return _rows(played, done.cumsum(1) - done == 0, specs)


class _Noisy(TensorDictModuleBase):
    """Replaces actions of a policy by random ones with a probability."""

    def __init__(self, policy: TensorDictModuleBase, specs: PAMDPSpecs, noise: float) -> None:
        super().__init__()
        self.in_keys, self.out_keys = policy.in_keys, policy.out_keys
        self.policy, self.specs, self.noise = policy, specs, noise

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        td = self.policy(td)
        other = random_action(self.specs, td.copy())
        is_random = torch.rand(td.batch_size, dtype=torch.float32) < self.noise
        td[keys.DISCRETE] = torch.where(is_random, other[keys.DISCRETE], td[keys.DISCRETE])
        td[keys.PARAMETERS] = torch.where(is_random.unsqueeze(-1), other[keys.PARAMETERS], td[keys.PARAMETERS])
        return td


def _trained(name: str, frames: int, num_episodes: int) -> TensorDict:
    """Return some of the finished episodes among the first steps of the training that made an agent."""
    config = load_agent(name, ["eval.layouts=1"]).config
    torch.manual_seed(config.run.seed)
    parts = assemble(config.with_run(mode="train", checkpoint=None))
    collection = config.collector.build(config=config, parts=parts, frames=0)
    batches: list[TensorDictBase] = []
    with closing(parts), closing(collection):
        while sum(batch.numel() for batch in batches) < frames:
            batches.append(collection.next().clone())
            parts.agent.learn(batches[-1])
    played = cast(TensorDictBase, torch.cat(batches, 1))
    is_last = played["next", keys.DONE].squeeze(-1)
    is_finished = is_last.flip(1).cumsum(1).flip(1) > 0
    rows = _rows(played, is_finished, parts.agent.specs)
    episode = _episode_of(rows)
    chosen = torch.randperm(int(episode[-1]) + 1)[:num_episodes]
    return rows[torch.isin(episode, chosen)]


def _episode_of(rows: TensorDict) -> Tensor:
    """Return the number of the episode of each of the transitions `[N]`."""
    done = rows["next", keys.DONE].squeeze(-1).long()
    return done.cumsum(0) - done


def _rows(played: TensorDictBase, is_kept: Tensor, specs: PAMDPSpecs) -> TensorDict:
    """Return the kept ones of steps as transitions `[N]`, in which parameters of other actions are 0."""
    states = (keys.OBSERVATION, keys.IS_DECISION, keys.DONE, keys.TERMINATED, keys.TRUNCATED)
    rows = played.select(*states, keys.OPTION, keys.ACTION, strict=False)
    rows["next"] = played["next"].select(*states, keys.REWARD)
    rows = rows[is_kept].clone()
    is_own = specs.components.is_chosen(rows[keys.DISCRETE]).index_select(-1, specs.parameter_owner)
    rows[keys.PARAMETERS] = torch.where(is_own, rows[keys.PARAMETERS], 0.0)
    return rows


def _recorded(words: Sequence[str]) -> TensorDict:
    """Return recorded transitions, chosen by words of a command line."""
    with composed(words, []) as cfg:
        config = read(cfg)
    with closing(make_env(config, 1, torch.device("cpu"), 0)) as env:
        data = make_data(config, env, 1.0)
        assert data is not None
        rows = data.batch.squeeze(0)
        return _rows(rows, torch.ones(len(rows), dtype=torch.bool), PAMDPSpecs.from_env(env))
