"""Measure how many presses a second the environment makes on one core; write results.csv and print the figures.

Run: python experiments/throughput/throughput.py [--seconds 2] [--device cpu]

Three interfaces are timed, each with automatic resets and with random actions that were sampled before (a pool of
eight):
- physics: `episode.step` and `episode.reset` as one function, without observations;
- env: `BoatDockEnv.step_and_maybe_reset`, with observations and TorchRL's bookkeeping;
- gymnasium: `BoatDockVector.step`, with NumPy arrays. Gymnasium's own vectorised CartPole is timed for comparison.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import gymnasium
import torch
from torch import Tensor

import hpamdp  # also registers the Gymnasium ids
from hpamdp import keys
from hpamdp.env import counter_rng
from hpamdp.env.boatdock import episode, physics
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.boatdock.episode import BoatState, Rules

SIZES = (1, 1_024, 16_384, 65_536, 131_072)
POOL = 8


def rate(step: Callable[[], object], num_envs: int, seconds: float) -> float:
    """Return the presses a second of the fastest of five trials that take about `seconds` together."""
    for _ in range(POOL + 2):
        step()
    num_steps = 0  # in a twentieth of the time
    started = time.perf_counter()
    while time.perf_counter() - started < seconds / 20:
        step()
        num_steps += 1
    num_steps *= 4
    best = 0.0
    for _ in range(5):
        started = time.perf_counter()
        for _ in range(num_steps):
            step()
        best = max(best, num_steps * num_envs / (time.perf_counter() - started))
    return best


def random_actions(env: BoatDockEnv) -> Iterator[dict[str, Tensor]]:
    """Return an endless iterator over a pool of random actions."""
    pool = [env.rand_action(env.reset()).select(keys.OPTION, keys.ACTION) for _ in range(POOL)]
    return itertools.cycle(pool)


def physics_stepper(num_envs: int, is_compiled: bool, device: str) -> Callable[[], object]:
    """Return a function that makes one press in every environment, with resets."""
    rules = Rules()
    seed = counter_rng.seed_tensor(0, torch.device(device))
    environment = torch.arange(num_envs, dtype=torch.int32, device=device)

    def press(state: BoatState, option: Tensor, key: Tensor, durations: Tensor) -> tuple[BoatState, Tensor, Tensor]:
        moved, reward, _ = episode.step(state, option, key, durations, seed, environment, rules)
        over = moved.outcome != physics.SAILING
        return episode.reset(moved, over, seed, environment, rules), reward, moved.outcome

    if is_compiled:
        press = torch.compile(press, **counter_rng.COMPILE_ARGUMENTS)
    env = BoatDockEnv(num_envs, device=device)
    actions = random_actions(env)
    env.reset()
    state = env.state

    def step() -> None:
        nonlocal state
        action = next(actions)
        state, _, _ = press(state, action[keys.OPTION], action[keys.DISCRETE], action[keys.PARAMETERS])

    return step


def env_stepper(num_envs: int, is_compiled: bool, device: str) -> Callable[[], object]:
    """Return a function that calls `step_and_maybe_reset` once."""
    env = BoatDockEnv(num_envs, compile_rules=is_compiled, device=device)
    actions = random_actions(env)
    td = env.reset()

    def step() -> None:
        nonlocal td
        _, td = env.step_and_maybe_reset(td.update(next(actions)))

    return step


def gymnasium_stepper(env_id: str, num_envs: int) -> Callable[[], object]:
    """Return a function that makes one step of a Gymnasium vector environment."""
    env = gymnasium.make_vec(env_id, num_envs=num_envs, vectorization_mode="vector_entry_point")
    env.reset(seed=0)
    env.action_space.seed(0)
    actions = itertools.cycle([env.action_space.sample() for _ in range(POOL)])
    return lambda: env.step(next(actions))


def steppers(num_envs: int, device: str) -> dict[str, Callable[[], Callable[[], object]]]:
    """Return what makes each function to time, by its name in the table."""
    return {
        "physics eager": lambda: physics_stepper(num_envs, False, device),
        "physics compiled": lambda: physics_stepper(num_envs, True, device),
        "env eager": lambda: env_stepper(num_envs, False, device),
        "env compiled": lambda: env_stepper(num_envs, True, device),
        "gymnasium": lambda: gymnasium_stepper("hpamdp/BoatDock-v0", num_envs),
        "gymnasium CartPole-v1": lambda: gymnasium_stepper("CartPole-v1", num_envs),
    }


def main() -> None:
    """Measure everything and write the csv file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=2.0, help="for each figure")
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print(f"hpamdp {hpamdp.__version__}, torch {torch.__version__}, one thread, {arguments.device}")
    rows = []
    for num_envs in SIZES:
        for what, make in steppers(num_envs, arguments.device).items():
            torch.compiler.reset()
            million = rate(make(), num_envs, arguments.seconds) / 1e6
            rows.append({"what": what, "num_envs": num_envs, "million_presses_per_s": round(million, 4)})
            print(f"{what:<22} {num_envs:>8,} environments {million:9.3f} million presses/s", flush=True)
    name = "results.csv" if arguments.device == "cpu" else f"results_{arguments.device}.csv"
    with (Path(__file__).parent / name).open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
