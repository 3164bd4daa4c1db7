"""Measure the environments' steps per second on one core, write results.csv and print the figures.

Run: python experiments/throughput/throughput.py [--seconds 1]

Each figure is the fastest of many short trials of one process on one core. CPU time leaves out the turns of other
processes. The environments to compare with are measured in the same run:
- boats, one: `gymnasium.make`, beside Gymnasium's own CartPole;
- boats, many: Gymnasium's vector environment, `BoatDockEnv.step_and_maybe_reset` by the kernel and by the tensor
  functions, beside Gymnasium's vectorised NumPy CartPole;
- the field's domains: the TorchRL and the Gymnasium environments.

Actions are random, from a pool of eight samples. A new episode starts when one ends.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Callable
from pathlib import Path

import gymnasium
import torch

import hpamdp  # also registers the Gymnasium ids
from experiments.study_tables import Rows, write_tables
from experiments.whole_map.boat_rules import TensorBoats
from hpamdp import keys
from hpamdp.env.base import PAMDPEnv
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.catch_point.environment import CatchPointEnv
from hpamdp.env.goal.environment import GoalEnv
from hpamdp.env.gym_hybrid.environment import MovingEnv
from hpamdp.env.hard_move.environment import HardMoveEnv
from hpamdp.env.platform.environment import PlatformEnv
from hpamdp.messages import exit_code

SIZES = (64, 256, 1_024, 16_384, 65_536)
DOMAIN_SIZES = (1_024, 16_384)
DOMAINS: dict[str, type[PAMDPEnv]] = {
    "Goal": GoalEnv,
    "Platform": PlatformEnv,
    "CatchPoint": CatchPointEnv,
    "HardMove4": HardMoveEnv,
    "Moving": MovingEnv,
}
POOL = 8


def rate(step: Callable[[], object], steps_per_call: int, seconds: float) -> float:
    """Return the steps per second of CPU time in the fastest of many trials of a few milliseconds."""
    for _ in range(POOL + 2):
        step()
    calls, ended = 1, time.perf_counter() + seconds
    best = 0.0
    while time.perf_counter() < ended:
        started = time.process_time()
        for _ in range(calls):
            step()
        taken = time.process_time() - started
        best = max(best, calls * steps_per_call / taken)
        if taken < 0.0025:
            calls *= 2
    return best


def env_stepper(env: PAMDPEnv) -> Callable[[], object]:
    """Return a function that calls `step_and_maybe_reset` once."""
    leaves = [keys.OPTION, keys.ACTION] if env.has_choice else [keys.ACTION]
    actions = itertools.cycle([env.rand_action(env.reset()).select(*leaves) for _ in range(POOL)])
    td = env.reset()

    def step() -> None:
        nonlocal td
        _, td = env.step_and_maybe_reset(td.update(next(actions)))

    return step


def one_stepper(env_id: str) -> Callable[[], object]:
    """Return a function that makes 64 steps of one Gymnasium environment, with resets."""
    env = gymnasium.make(env_id)
    env.reset(seed=0)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(64)]

    def step() -> None:
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()

    return step


def vector_stepper(env_id: str, num_envs: int) -> Callable[[], object]:
    """Return a function that makes one step of a Gymnasium vector environment."""
    env = gymnasium.make_vec(env_id, num_envs=num_envs, vectorization_mode="vector_entry_point")
    env.reset(seed=0)
    env.action_space.seed(0)
    actions = itertools.cycle([env.action_space.sample() for _ in range(POOL)])
    return lambda: env.step(next(actions))


def boats(num_envs: int) -> dict[str, Callable[[], Callable[[], object]]]:
    """Return factories of the functions to time, by their names in the table."""
    return {
        "CartPole-v1, Gymnasium vector": lambda: vector_stepper("CartPole-v1", num_envs),
        "boats, Gymnasium vector": lambda: vector_stepper("hpamdp/BoatDock-v0", num_envs),
        "boats, TorchRL": lambda: env_stepper(BoatDockEnv(num_envs)),
        "boats, TorchRL, tensor functions": lambda: env_stepper(TensorBoats(num_envs)),
    }


def main() -> None:
    """Measure everything and write the csv file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=1.0, help="for each figure")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print(f"hpamdp {hpamdp.__version__}, torch {torch.__version__}, one thread")
    rows: Rows = []

    def measure(what: str, num_envs: int, step: Callable[[], object], steps_per_call: int) -> None:
        per_second = rate(step, steps_per_call, arguments.seconds)
        rows.append({"what": what, "num_envs": num_envs, "steps_per_s": round(per_second)})
        print(f"{what:<34} {num_envs:>7,} environments {per_second:>13,.0f} steps/s", flush=True)

    for env_id in ("CartPole-v1", "hpamdp/BoatDock-v0", *(f"hpamdp/{name}-v0" for name in DOMAINS)):
        measure(f"{env_id.removeprefix('hpamdp/')}, Gymnasium", 1, one_stepper(env_id), 64)
    for num_envs in SIZES:
        for what, make in boats(num_envs).items():
            measure(what, num_envs, make(), num_envs)
    for name, problem in DOMAINS.items():
        for num_envs in DOMAIN_SIZES:
            measure(f"{name}, TorchRL", num_envs, env_stepper(problem(num_envs)), num_envs)
            measure(f"{name}, Gymnasium vector", num_envs, vector_stepper(f"hpamdp/{name}-v0", num_envs), num_envs)
    write_tables(Path(__file__).parent, {"results": rows})


if __name__ == "__main__":
    sys.exit(exit_code(main))
