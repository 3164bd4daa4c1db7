"""Train the agents of this package again, each by one run, and put them into agents/.

python experiments/agents/make.py                train all of them, one after another
python experiments/agents/make.py NAME ...       only these
python experiments/agents/make.py NAME=FOLDER    only put the run in FOLDER there, a run of NAME's command
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import torch

from hpamdp.messages import exit_code
from hpamdp.run.state_file import StateFile, write

ROOT = Path(__file__).resolve().parents[2]
KEPT = ("policy.safetensors", "config.yaml", "summary.json")
# Only training needs the critics, so small ones suffice and make small files.
SMALL = "low.critic_hidden_dims=[64,64]"
ONE_BOAT = ["high=none", "low=hppo", SMALL, "total_frames=1000000", "eval.every=250000"]
HARD_MOVE = ["high=none", "low=hppo", "env=hard_move", "eval.every=50000"]
GOAL = ["high=none", "low=pdqn", "total_frames=300000", "eval.every=30000"]
AGENTS = {
    "linucb_hppo": ["high=linucb", "low=hppo", SMALL, "total_frames=4000000", "eval.every=500000"],
    "hppo_congruent": [*ONE_BOAT, "env.controller=congruent"],
    "hppo_incongruent": [*ONE_BOAT, "env.controller=incongruent"],
    "hppo_platform": ["high=none", "low=hppo", "env=platform", "eval.every=20000"],
    "pdqn_goal": [*GOAL, "env=goal", "seed=3"],
    "pdqn_hard_goal": [*GOAL, "env=hard_goal"],
    "hppo_catch_point": ["high=none", "low=hppo", "env=catch_point", "eval.every=100000", "seed=1"],
    "hppo_hard_move_4": [*HARD_MOVE, "env.n=4"],
    "hppo_hard_move_6": [*HARD_MOVE, "env.n=6"],
    "hppo_hard_move_8": [*HARD_MOVE, "env.n=8"],
    "hppo_moving": ["high=none", "low=hppo", "env=moving"],
    "hppo_sliding": ["high=none", "low=hppo", "env=sliding"],
    "hppo_lunar_lander": ["high=none", "low=hppo", "env=lunar_lander", "eval.layouts=200", "seed=101"],
    "hppo_circuit": [
        *("high=none", "low=hppo", "env=circuit", "env.task=ghz"),
        *("eval.layouts=100", "eval.seed=110", "seed=110"),
    ],
    "pdqn_pinball": ["high=none", "low=pdqn", "env=pinball", "eval.layouts=10", "eval.seed=110", "seed=110"],
    "hppo_office": [
        *("high=none", "low=hppo", "env=office", "env.tiles=20", "exploration=counts", "exploration.resolution=1"),
        *("exploration.weight=25", "exploration.table_size=16381", "eval.layouts=100", "eval.seed=130", "seed=130"),
    ],
    "hppo_primitives": [
        *("experiment=primitives", "hydra.mode=RUN", "env.task=peg_unplug_side", "eval.seed=105", "seed=105"),
    ],
    "pdqn_traffic": ["high=none", "low=pdqn", "env=traffic", "eval.seed=118", "seed=118"],
    "hppo_boatdock_unseen": [
        *("high=none", "low=hppo", SMALL, "env=boatdock_unseen", "env.frame=first_press"),
        *("total_frames=6000000", "eval.every=1000000", "seed=911"),
    ],
    # The options of this agent change inside an episode.
    "meta_critic_hppo_rooms": [
        *("high=meta_critic", "high.hidden_dims=[64,64]", "low=hppo", "env=rooms", "low.gamma=0.97"),
        *("agent.termination=learned", "agent.sharing=shared", "low.minibatch_size=512"),
        *("num_envs=128", "steps_per_batch=16", "total_frames=400000", "eval.every=100000"),
    ],
}


def make(name: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        words = [*AGENTS[name], "compile_updates=false", f"hydra.run.dir={folder}", "overwrite=true"]
        subprocess.run([sys.executable, str(ROOT / "run.py"), *words], check=True)
        keep(name, Path(folder))


def keep(name: str, run: Path) -> None:
    """Put a run's agent into agents/."""
    missing = [file for file in KEPT if not (run / file).is_file()]
    if missing:
        raise SystemExit(f"{run}: no finished run, {missing[0]} is not there")
    target = ROOT / "agents" / name
    target.mkdir(parents=True, exist_ok=True)
    for file in KEPT:
        shutil.copyfile(run / file, target / file)
    round_networks(target / "policy.safetensors")


def round_networks(file: Path) -> None:
    """Store the learners' networks in half precision, for half the size. A selector may hold counts, so it stays."""
    opened = StateFile(file)
    saved = {name: opened.read(name) for name in opened.names}
    agent = saved["agent"]
    # The same weights have several names, but are in the file once, so they must stay one tensor.
    rounded = {
        value.data_ptr(): value.half()
        for name, value in agent.items()
        if name.startswith("learners.") and isinstance(value, torch.Tensor) and value.is_floating_point()
    }
    for name, value in agent.items():
        if isinstance(value, torch.Tensor) and value.data_ptr() in rounded:
            agent[name] = rounded[value.data_ptr()]
    write(file, saved)


def main(words: list[str]) -> int:
    given = dict(word.partition("=")[::2] for word in words) or dict.fromkeys(AGENTS, "")
    unknown = given.keys() - AGENTS.keys()
    if unknown:
        print(f"{', '.join(sorted(unknown))}: no such agent; there is {', '.join(AGENTS)}", file=sys.stderr)
        return 2
    for name, folder in given.items():
        if folder:
            keep(name, Path(folder))
        else:
            make(name)
    return 0


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
