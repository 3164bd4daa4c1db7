"""Train learners under selectors on Rooms, with options that end inside episodes, and compare them with the optimum.

python experiments/options/train_rooms.py high=meta_critic,actor low=hppo,pdqn seed=0    trains each pair, and adds a
                                                                                         row each to rooms.csv

The words are those of the command line, and all combinations of their values are run.
"""

from __future__ import annotations

import itertools
import re
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import torch
from tensordict import TensorDictBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from experiments.study_tables import add_to_tables
from hpamdp import keys
from hpamdp.config.compose import read
from hpamdp.config.errors import ConfigError
from hpamdp.config.outside_jobs import composed
from hpamdp.config.schema import Config
from hpamdp.env.rooms import rules
from hpamdp.env.rooms.environment import RoomsEnv
from hpamdp.messages import exit_code
from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.policies.base import States
from hpamdp.run.assemble import AssembledRun, assemble
from hpamdp.run.trainer import Trainer

HERE = Path(__file__).resolve().parent
FILE = HERE / "rooms.csv"
RUN = ("high", "low", "sharing", "termination", "option_length", "seed")
GAMMA = 0.95
Settings: TypeAlias = Mapping[str, Sequence[str]]  # words of the command line, by the selector or the learner


class Recipe(NamedTuple):
    """Words of the command line for every run, for each selector and for each learner."""

    common: Sequence[str]
    selectors: Settings
    learners: Settings


# Settings of every run, before the words of the command line.
COMMON = [
    "env=rooms",
    f"low.gamma={GAMMA}",
    "agent.termination=steps",
    "agent.option_length=3",
    "eval.layouts=200",
    "eval.every=0",
    "log_every=0",
]
# Selectors make many updates from recent decisions only. The defaults suit one decision per episode.
SELECTORS = {
    "meta_critic": [
        f"high.gamma={GAMMA}",
        "high.num_members=1",
        "high.epsilon_final=0.02",
        "high.epsilon_decisions=10000",
        "high.buffer_size=10000",
        "high.batch_size=256",
        "high.updates_per_decision=0.05",
        "high.tau=0.05",
    ],
    "actor": [f"high.gamma={GAMMA}", "high.minibatch_size=256", "high.entropy=0.02", "high.lr=1e-3"],
    "option_critic": [
        f"high.gamma={GAMMA}",
        "high.epsilon_steps=50000",
        "high.buffer_size=10000",
        "high.batch_size=256",
        "high.tau=0.05",
        "agent.termination=learned",
        "agent.option_length=null",
    ],
}
# Options are uniform for half of the steps. Otherwise a learner that is not chosen does not learn, and is never chosen.
# Replay learners have small networks and fast targets, for a problem of 104 cells.
REPLAY = [
    "num_envs=256",
    "total_frames=200000",
    "agent.practice=120000",
    "low.hidden_dims=[64,64]",
]
# Plans have one step. The value of the last state covers the rest, and distinguishes lengths of steps more clearly.
ONE_STEP_PLANS = [
    "low.end_values=true",
    "low.end_value_tau=0.05",
    "low.horizon=1",
    "low.temperature=0.01",
    "low.num_iterations=3",
]
DLPA_PLANS = [*ONE_STEP_PLANS, "low.num_samples=32", "low.num_elites=8", "low.epsilon=0.2"]
PETS_PLANS = [*ONE_STEP_PLANS, "low.greedy_samples=12", "low.parameter_noise=0.2"]
LEARNERS = {
    # Small batches, for many updates of a policy that must cross the rooms before it finds a reward.
    "hppo": [
        "total_frames=160000",
        "agent.practice=80000",
        "num_envs=64",
        "steps_per_batch=16",
        "low.minibatch_size=256",
    ],
    "pdqn": [
        *REPLAY,
        "agent.practice=100000",
        "low.warmup_steps=2000",
        "low.updates_per_step=0.05",
        "low.actor_tau=0.05",
        "low.critic_tau=0.05",
        "low.epsilon_steps=15000",
    ],
    "hyar": [
        *REPLAY,
        "low.warmup_steps=5000",
        "low.updates_per_step=0.1",
        "low.tau=0.05",
        "low.epsilon_steps=30000",
        "low.codec_pretrain_updates=1000",
    ],
    # One in 500 random episodes arrives, so there are many random steps at the start.
    "paddpg": [
        *REPLAY,
        "low.warmup_steps=25000",
        "low.twin=true",
        "low.updates_per_step=0.1",
        "low.hidden_dims=[128,128]",
        "low.tau=0.05",
        "low.epsilon_final=0.2",
        "low.epsilon_steps=60000",
        "low.actor_lr=3e-4",
    ],
    # Low temperatures. With the defaults, a step's entropy bonus exceeds its cost, and never arriving is best.
    "hsac": [
        *REPLAY,
        "low.warmup_steps=25000",
        "low.updates_per_step=0.1",
        "low.batch_size=128",
        "low.tau=0.05",
        "low.discrete_temperature=0.01",
        "low.parameter_temperature=0.005",
        "low.discrete_target_entropy=0.5",
        "low.parameter_target_entropy=-1.0",
    ],
    "dlpa": [
        "num_envs=64",
        "total_frames=100000",
        "agent.practice=60000",
        "low.hidden_dims=[64,64]",
        "low.warmup_steps=15000",
        "low.updates_per_step=0.1",
        *DLPA_PLANS,
    ],
    # As for PADDPG, but more random steps, for models that learn from few arrivals.
    "pets": [
        "total_frames=140000",
        "agent.practice=110000",
        "num_envs=64",
        "steps_per_batch=4",
        "low.warmup_steps=40000",
        "low.updates_per_step=0.15",
        "low.batch_size=256",
        "low.weight_decay=0.1",
        "low.optimism=0",
        *PETS_PLANS,
    ],
    # Features of two entries each: with one-hot vectors, this gives each cell a value. Episodes are options.
    "qpamdp": [
        "total_frames=800000",
        "agent.practice=400000",
        "num_envs=64",
        "steps_per_batch=16",
        "low.features=null",
        "low.phi_order=1",
        "low.psi_order=1",
        "low.warmup_steps=20000",
        "low.initial_episodes=30000",
        "low.relearning_episodes=10000",
        "low.parameter_updates=5",
        "low.rollouts=5000",
        "low.temperature_decay=0.9999",
        "low.initial_mean=0.5",
        "low.sigma=0.3",
    ],
}


RECIPE = Recipe(COMMON, SELECTORS, LEARNERS)


def make_config(words: Sequence[str], recipe: Recipe) -> Config:
    """Return the checked config of a run: the recipe with the words' selector and learner, changed by the words."""
    chosen = dict(word.split("=", 1) for word in words)
    own = [*recipe.selectors.get(chosen.get("high", ""), []), *recipe.learners.get(chosen.get("low", ""), [])]
    with composed([*recipe.common, *own, *words]) as cfg:
        return read(cfg)


def trained(config: Config) -> tuple[AssembledRun, int, float]:
    """Train an agent, and return the parts of its run, its steps and its CPU seconds."""
    cpu = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        torch.manual_seed(config.run.seed)
        parts = assemble(config)
        trainer = Trainer(config, parts, Path(folder))
        trainer.train()
    return parts, trainer.frames, time.process_time() - cpu


def value_errors(value: torch.Tensor, best: torch.Tensor, num_due: torch.Tensor) -> dict[str, float]:
    """Return the errors of values relative to the mean best value, at decisions and in all cells.

    Args:
        value, best: learned and best values of the cells, `[*C]`.
        num_due: number of decisions in each cell, `[*C]`.
    """
    error = (value - best).abs()
    return {
        "value_error": round(((num_due * error).sum() / (num_due * best).sum()).item(), 4),
        "value_error_everywhere": round((error.sum() / best.sum()).item(), 4),
    }


def train(config: Config) -> dict[str, Any]:
    """Train one agent and return its row."""
    parts, frames, cpu = trained(config)
    length = config.run.agent.option_length
    steps = length or 1
    means, num_due = evaluate(parts)
    optimum = mean_over_starts(parts, rules.best_values(1.0, steps))
    return {
        "high": config.high.name,
        "low": config.low.name,
        "sharing": config.run.agent.sharing,
        "termination": config.run.agent.termination,
        "option_length": length,
        "seed": config.run.seed,
        "steps": frames,
        "score": round(means["score"], 4),
        "optimum": round(optimum, 4),
        "share": round(means["score"] / optimum, 4),
        "success": round(means["success"], 4),
        **value_errors(values_of_cells(parts.agent), rules.best_values(GAMMA, steps), num_due),
        "cpu_s": round(cpu, 1),
    }


def mean_over_starts(parts: AssembledRun, values: torch.Tensor) -> float:
    """Return the mean of values `[x, y]` over the cells in which the evaluation's episodes begin."""
    env = parts.evaluation.problem
    assert isinstance(env, RoomsEnv)
    env.seed_evaluation(parts.evaluation.seed)
    env.reset()
    return values[env.state.x.long(), env.state.y.long()].mean().item()


def evaluate(parts: AssembledRun) -> tuple[dict[str, float], torch.Tensor]:
    """Play the evaluation's episodes, and return their means and the number of decisions in each cell, `[x, y]`."""
    env = parts.evaluation.problem
    assert isinstance(env, RoomsEnv)
    num_due = torch.zeros(rules.SIZE, rules.SIZE, dtype=torch.float64)

    def policy(td: TensorDictBase) -> TensorDictBase:
        x, y = env.state.x.long(), env.state.y.long()
        td = parts.agent.policy(td)
        is_due = (td[keys.IS_DECISION] & ~td[keys.DONE]).squeeze(-1)
        num_due.index_put_((x[is_due], y[is_due]), num_due.new_ones(()), accumulate=True)
        return td

    return parts.evaluation.measure(parts.evaluation.run(policy)), num_due


@torch.no_grad()
def learned_values(agent: HierarchicalAgent, observation: torch.Tensor) -> torch.Tensor:
    """Return the learners' values of states `[N, observation_dim]`, float64 `[N]`; NaN if they have none.

    In each state the selector chooses greedily, and the value is that of the chosen option's learner.
    """
    none = torch.zeros(len(observation), dtype=torch.long)
    follows = agent.next_options
    assert follows is not None and agent.selector is not None
    shown = observation
    if agent.is_shared:
        shown = torch.cat([observation, observation.new_zeros(len(observation), agent.specs.num_options)], -1)
    agent.selector.decides_ends = False
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        option = follows.choose(shown, none, none)
        try:
            value = torch.stack([follows.value(States(shown), option) for _ in range(10)]).mean(0)  # some are noisy
        except NotImplementedError:
            value = torch.full(none.shape, torch.nan)
    return value.double()


def values_of_cells(agent: HierarchicalAgent) -> torch.Tensor:
    """Return the learners' values of all cells, float64 `[x, y]`: 0 at walls and at the goal."""
    x, y = (part.flatten().int() for part in torch.meshgrid(*2 * [torch.arange(rules.SIZE)], indexing="ij"))
    none = torch.zeros_like(x)
    value = learned_values(agent, rules.observe(rules.RoomsState(x, y, none, none, none)))
    is_nothing = ~rules.is_free(x, y) | ((x == rules.GOAL) & (y == rules.GOAL))
    return value.masked_fill(is_nothing, 0.0).reshape(rules.SIZE, rules.SIZE)


def train_all(
    words: Sequence[str], recipe: Recipe, train: Callable[[Config], dict[str, Any]], file: Path, run: Sequence[str]
) -> None:
    """Check the settings of all combinations of the words' values, then train with each and add its row to a csv file.

    Args:
        words: of the command line, such as `low=hppo,pdqn`.
        recipe: gives the settings that the words do not.
        train: trains with the config of one run and returns its row.
        file: the csv file.
        run: its columns that name a run.

    Raises:
        SystemExit: there is no word, one is wrong, or they do not go together.
    """
    wrong = next((word for word in words if "=" not in word), None)
    if wrong is not None or not words:
        raise SystemExit(f"give words such as low=hppo,pdqn{'' if wrong is None else f', not {wrong}'}")
    names, values = zip(*(word.split("=", 1) for word in words), strict=True)
    # A comma inside brackets separates no values, as in low.hidden_dims=[64,64].
    combinations = itertools.product(*(re.split(r",(?![^\[]*\])", each) for each in values))
    try:
        configs = [
            make_config([f"{name}={value}" for name, value in zip(names, chosen, strict=True)], recipe)
            for chosen in combinations
        ]
    except ConfigError as error:
        raise SystemExit(f"{error}\nno run was trained") from error
    for config in configs:
        try:
            row = train(config)
        except ConfigError as error:  # such as a selector that refuses the options of its run
            raise SystemExit(str(error)) from error
        add_row(file, row, run, steps="steps")
    print(f"{file}: rows added; study.py tabulates them")


def add_row(file: Path, row: Mapping[str, Any], run: Sequence[str], **how: Any) -> None:
    """Add the row of a run to a csv file. If it is refused, show it, since the run is over.

    Args:
        file: the csv file.
        row: the row.
        run: its columns that name the run.
        how: further arguments of `add_to_tables`.

    Raises:
        SystemExit: the row does not go with those in the file.
    """
    try:
        add_to_tables(file.parent, {file.stem: [row]}, run, **how)
    except SystemExit as refused:
        raise SystemExit(f"{refused}. The row of the run: {','.join(map(str, row.values()))}") from refused


if __name__ == "__main__":
    sys.exit(exit_code(lambda: train_all(sys.argv[1:], RECIPE, train, FILE, RUN)))
