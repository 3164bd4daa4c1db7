"""Train learners under selectors on Crossing, with options that end inside episodes, and compare with the best values.

python experiments/options/train_crossing.py high=meta_critic,actor low=hppo,pdqn seed=0    trains each pair, and adds a
                                                                                            row each to crossing.csv

The words are those of the command line, and all combinations of their values are run.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from train_rooms import DLPA_PLANS, PETS_PLANS, Recipe, learned_values, train_all, trained, value_errors

from hpamdp import keys
from hpamdp.config.schema import Config
from hpamdp.messages import exit_code
from hpamdp.run.assemble import AssembledRun

HERE = Path(__file__).resolve().parent
FILE = HERE / "crossing.csv"
RUN = ("high", "low", "seed")
EXAMPLE = HERE.parent.parent / "examples" / "crossing"
sys.path.insert(0, str(EXAMPLE))
from crossing import NUM_CELLS, Crossing, best_values, cell_of, observe  # noqa: E402

GAMMA = 0.9
OPTION_LENGTH = 3
# Settings of every run, before the words of the command line.
COMMON = [
    f"hydra.searchpath=[file://{EXAMPLE / 'conf'}]",
    "env=crossing",
    f"low.gamma={GAMMA}",
    f"high.gamma={GAMMA}",
    "high.hidden_dims=[64]",
    "high.lr=3e-3",
    "num_envs=64",
    "steps_per_batch=4",
    "total_frames=30000",
    "agent.practice=15000",
    "eval.layouts=200",
    "eval.every=0",
    "log_every=0",
]
STEPS = ["agent.termination=steps", f"agent.option_length={OPTION_LENGTH}"]
SELECTORS = {
    "meta_critic": [
        *STEPS,
        "high.num_members=1",
        "high.epsilon_final=0.02",
        "high.epsilon_decisions=3000",
        "high.warmup_decisions=200",
        "high.buffer_size=3000",
        "high.batch_size=128",
        "high.updates_per_decision=0.1",
        "high.tau=0.05",
    ],
    "actor": [*STEPS, "high.minibatch_size=128", "high.entropy=0.02"],
    "option_critic": [
        "agent.termination=learned",
        "high.epsilon_steps=15000",
        "high.warmup_steps=500",
        "high.buffer_size=5000",
        "high.batch_size=128",
        "high.updates_per_step=0.05",
        "high.termination_lr=3e-3",
        "high.tau=0.05",
    ],
}
REPLAY = [
    "low.hidden_dims=[64]",
    "low.warmup_steps=1000",
    "low.batch_size=128",
    "low.updates_per_step=0.1",
    "low.critic_lr=3e-3",
]
LEARNERS = {
    "hppo": ["steps_per_batch=16", "low.minibatch_size=256", "low.hidden_dims=[64]", "low.critic_hidden_dims=[64]"],
    "pdqn": [*REPLAY, "low.actor_tau=0.05", "low.critic_tau=0.05", "low.epsilon_steps=5000"],
    "hyar": [*REPLAY, "low.tau=0.05", "low.epsilon_steps=5000", "low.codec_pretrain_updates=300"],
    "paddpg": [*REPLAY, "low.tau=0.05", "low.epsilon_steps=5000", "low.actor_lr=1e-3"],
    "hsac": [*REPLAY, "low.tau=0.05", "low.discrete_temperature=0.002", "low.parameter_temperature=0.001"],
    "dlpa": [
        "low.hidden_dims=[64]",
        "low.warmup_steps=1000",
        "low.batch_size=128",
        "low.updates_per_step=0.1",
        "low.end_value_lr=3e-3",
        *DLPA_PLANS,
    ],
    "pets": [
        "total_frames=16000",
        "agent.practice=8000",
        "low.warmup_steps=500",
        "low.updates_per_step=0.3",
        "low.end_value_lr=3e-3",
        *PETS_PLANS,
    ],
    "qpamdp": [
        "total_frames=300000",
        "agent.practice=150000",
        "steps_per_batch=16",
        "low.features=null",
        "low.phi_order=1",
        "low.phi_max_coupled=1",
        "low.psi_order=1",
        "low.psi_max_coupled=1",
        "low.warmup_steps=5000",
        "low.envs_per_update=8",
        "low.step_size=0.1",
        "low.temperature_decay=0.9999",
        "low.initial_episodes=3000",
        "low.relearning_episodes=1000",
        "low.rollouts=500",
        "low.parameter_updates=30",
        "low.initial_mean=0.5",
        "low.sigma=0.3",
    ],
}


RECIPE = Recipe(COMMON, SELECTORS, LEARNERS)


def train(config: Config) -> dict[str, Any]:
    """Train one agent and return its row."""
    parts, frames, cpu = trained(config)
    best = torch.tensor(best_values(GAMMA, config.run.agent.option_length or 1), dtype=torch.float64)
    share, success, num_due = evaluate(parts, best)
    value = learned_values(parts.agent, observe(torch.arange(NUM_CELLS)))
    return {
        "high": config.high.name,
        "low": config.low.name,
        "seed": config.run.seed,
        "steps": frames,
        "share": round(share, 4),
        "success": round(success, 4),
        **value_errors(value[:-1], best[:-1], num_due[:-1]),  # but for the end of the way
        "cpu_s": round(cpu, 1),
    }


def evaluate(parts: AssembledRun, best: torch.Tensor) -> tuple[float, float, torch.Tensor]:
    """Play the evaluation's episodes.

    Args:
        parts: parts of the run.
        best: the best values of the cells, `[NUM_CELLS]`.

    Returns:
        The mean discounted return relative to the best one, the fraction of episodes that arrive, and the number of
        decisions in each cell, `[NUM_CELLS]`.
    """
    env = parts.evaluation.problem
    assert isinstance(env, Crossing)
    num_due = torch.zeros(NUM_CELLS, dtype=torch.float64)
    first = None

    def policy(td: TensorDictBase) -> TensorDictBase:
        nonlocal first
        cell = cell_of(env.place)
        first = cell if first is None else first
        td = parts.agent.policy(td)
        is_due = (td[keys.IS_DECISION] & ~td[keys.DONE]).squeeze(-1)
        num_due.index_add_(0, cell[is_due], torch.ones_like(cell[is_due], dtype=num_due.dtype))
        return td

    played = parts.evaluation.run(policy)
    earned = played["success"] * GAMMA ** (played["steps"] - 1.0)
    return float(earned.mean()) / best[first].mean().item(), float(played["success"].mean()), num_due


if __name__ == "__main__":
    sys.exit(exit_code(lambda: train_all(sys.argv[1:], RECIPE, train, FILE, RUN)))
