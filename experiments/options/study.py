"""Train learners under selectors on Rooms, with options that end inside episodes, and compare them with the optimum.

python experiments/options/study.py high=meta_critic low=hppo    trains, and adds a row to results.csv
python experiments/options/study.py                              tabulates results.csv
"""

from __future__ import annotations

import csv
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import torch
from hydra import compose, initialize_config_dir
from torchrl.envs.utils import ExplorationType, set_exploration_type

from hpamdp.config import Config, read
from hpamdp.env.rooms import rules
from hpamdp.env.rooms.environment import RoomsEnv
from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.run.assemble import Parts, assemble
from hpamdp.run.train import Trainer

HERE = Path(__file__).resolve().parent
CONF = HERE.parent.parent / "conf"
COLUMNS = (
    "high",
    "low",
    "sharing",
    "option_length",
    "seed",
    "steps",
    "score",
    "optimum",
    "share",
    "value_error",
    "cpu_s",
)
GAMMA = 0.95
# On every run, before the words of the command line.
COMMON = ["env=rooms", f"low.gamma={GAMMA}", "agent.option_length=3", "eval.layouts=200", "eval.every=0", "log_every=0"]
SELECTORS = {
    "meta_critic": [f"high.gamma={GAMMA}", "high.updates_per_decision=0.02", "high.epsilon_decisions=10000"],
    "actor": [f"high.gamma={GAMMA}", "high.entropy=0.02", "high.lr=1e-3"],
    "option_critic": [f"high.gamma={GAMMA}", "high.epsilon_steps=50000", "agent.option_length=learned"],
}
LEARNERS = {
    "hppo": ["total_frames=600000", "num_envs=256", "steps_per_batch=16", "low.minibatch_size=1024"],
    "qpamdp": ["low.features=[0,1]", "low.warmup_frames=5000", "low.initial_mean=0", "low.sigma=0.3"],
    "dlpa": ["low.horizon=3"],
}


def make_config(words: Sequence[str]) -> Config:
    """Return the checked config of a run."""
    chosen = dict(word.split("=", 1) for word in words)
    own = [*SELECTORS.get(chosen.get("high", ""), []), *LEARNERS.get(chosen.get("low", ""), [])]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return read(compose("config", [*COMMON, *own, *words], return_hydra_config=True))


def train(words: Sequence[str]) -> dict[str, object]:
    """Train one agent and return its row."""
    config = make_config(words)
    cpu = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        torch.manual_seed(config.run.seed)
        parts = assemble(config, Path(folder))
        trainer = Trainer(config, parts, Path(folder))
        trainer.train()
    cpu = time.process_time() - cpu
    length = config.run.agent.option_length
    steps = length if isinstance(length, int) else 1
    means = parts.evaluation.measure(parts.evaluation.run(parts.agent.policy))
    optimum = mean_over_starts(parts, rules.best_values(1.0, steps))
    return {
        "high": config.high.name,
        "low": config.low.name,
        "sharing": config.run.agent.sharing,
        "option_length": length,
        "seed": config.run.seed,
        "steps": trainer.frames,
        "score": round(means["score"], 4),
        "optimum": round(optimum, 4),
        "share": round(means["score"] / optimum, 4),
        "value_error": round(value_error(parts.agent, rules.best_values(GAMMA, steps)), 4),
        "cpu_s": round(cpu, 1),
    }


def mean_over_starts(parts: Parts, values: torch.Tensor) -> float:
    """Return the mean of values `[x, y]` over the cells in which the evaluation's episodes begin."""
    env = parts.evaluation.problem
    assert isinstance(env, RoomsEnv)
    env.seed_evaluation(parts.evaluation.seed)
    env.reset()
    return values[env.state.x.long(), env.state.y.long()].mean().item()


@torch.no_grad()
def value_error(agent: HierarchicalAgent, values: torch.Tensor) -> float:
    """Return the mean error of the learners' values over the free cells, as a share of the mean best value.

    In each cell the selector chooses greedily, and the value is that of the chosen option's learner.
    """
    x, y = (part.flatten().int() for part in torch.meshgrid(*2 * [torch.arange(rules.SIZE)], indexing="ij"))
    is_asked = rules.is_free(x, y) & ~((x == rules.GOAL) & (y == rules.GOAL))
    x, y = x[is_asked], y[is_asked]
    none = torch.zeros_like(x)
    observation = rules.observe(rules.RoomsState(x, y, none, none, none))
    follows = agent.next_options
    assert follows is not None
    shown = observation
    if agent.is_shared:
        shown = torch.cat([observation, observation.new_zeros(len(x), agent.specs.num_options)], -1)
    agent.selector.decides_ends = False
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        option = follows.choose(shown, none.long(), none.long())
        try:
            estimate = torch.stack([follows.value(shown, option) for _ in range(10)]).mean(0)
        except NotImplementedError:
            return float("nan")
    best = values[x.long(), y.long()]
    return ((estimate - best).abs().mean() / best.mean()).item()


def main(words: Sequence[str]) -> None:
    """Train if there are words, and print the table."""
    file = HERE / "results.csv"
    if words:
        row = train(words)
        is_new = not file.exists()
        with file.open("a", newline="") as stream:
            writer = csv.DictWriter(stream, COLUMNS)
            if is_new:
                writer.writeheader()
            writer.writerow(row)
    rows = []
    if file.exists():
        with file.open(newline="") as stream:
            rows = list(csv.DictReader(stream))
    print("| " + " | ".join(COLUMNS) + " |\n|" + "---|" * len(COLUMNS))
    for row in rows:
        print("| " + " | ".join(row[name] for name in COLUMNS) + " |")


if __name__ == "__main__":
    main(sys.argv[1:])
