"""Compute what random play and the best policy return on the fixed episodes of each problem.

python experiments/own_problems/optimum.py    writes optima.csv

The best policy comes from dynamic programming on a grid of states and of amounts, with linear interpolation between
the states. It plays by looking one step ahead. `expected` is what the programme itself says of these starts. It differs
from `best` by the events of the fixed episodes and by the interpolation.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from problems import EPISODE_SEEDS, HELD, PROBLEMS, OwnProblem
from scipy.interpolate import RegularGridInterpolator

from experiments.study_tables import write_tables
from hpamdp.messages import exit_code

HERE = Path(__file__).resolve().parent
COARSE, FINE = 13, 41  # amounts from 0 to the limit, in the programme and in play


def gain(
    problem: type[OwnProblem], values: RegularGridInterpolator, time: int, state: tuple, choice: int, amount: np.ndarray
) -> np.ndarray:
    """Return the expected reward and value after an action in many states."""
    total = np.zeros(())
    for event in problem.events:
        (first, second), reward, is_over = problem.rules(time, state, choice, amount, event)
        after = values(np.stack(np.broadcast_arrays(first, second), -1))
        total = total + reward + np.where(is_over, 0.0, after)
    return total / len(problem.events)


def solve(problem: type[OwnProblem]) -> list[RegularGridInterpolator]:
    """Return the value of each state after each number of steps."""
    states = tuple(np.meshgrid(*problem.grid, indexing="ij"))
    tables = [np.zeros(states[0].shape)]
    for time in reversed(range(problem.steps)):
        following = RegularGridInterpolator(problem.grid, tables[-1], bounds_error=False, fill_value=None)
        asked = tuple(each[..., None] for each in states)
        gains = [
            gain(problem, following, time, asked, choice, problem.amounts(choice, COARSE)).max(-1)
            for choice in range(len(problem.limits))
        ]
        tables.append(np.max(gains, 0))
    return [RegularGridInterpolator(problem.grid, each, bounds_error=False, fill_value=None) for each in tables[::-1]]


def best_returns(problem: type[OwnProblem], values: list[RegularGridInterpolator]) -> tuple[np.ndarray, float]:
    """Return what the best policy gets in each of the fixed episodes, and the mean value of their starts."""
    envs = [problem() for _ in EPISODE_SEEDS]
    for env, seed in zip(envs, EPISODE_SEEDS, strict=True):
        env.reset(seed=seed)
    first, second = (np.array([env.state[axis] for env in envs]) for axis in range(2))
    expected = float(values[0](np.stack([first, second], -1)).mean())
    returns, is_running = np.zeros(len(envs)), np.ones(len(envs), bool)
    for time in range(problem.steps):
        chosen = []
        for choice in range(len(problem.limits)):
            amounts = problem.amounts(choice, FINE)
            gains = gain(problem, values[time + 1], time, (first[:, None], second[:, None]), choice, amounts)
            chosen.append((gains.max(-1), amounts[..., gains.argmax(-1)]))
        choices = np.argmax([gains for gains, _ in chosen], 0)
        for row in np.flatnonzero(is_running):
            env, choice = envs[row], int(choices[row])
            event = env.events[env.np_random.integers(len(env.events))]
            amount = chosen[choice][1][..., row]
            env.state, reward, is_over = env.rules(time, env.state, choice, amount, event)
            returns[row] += reward
            is_running[row] = not is_over
            first[row], second[row] = env.state
    return returns, expected


def random_returns(problem: type[OwnProblem]) -> np.ndarray:
    """Return what uniformly random actions get in each of the fixed episodes."""
    returns = []
    env = problem()
    for seed in EPISODE_SEEDS:
        env.reset(seed=seed)
        env.action_space.seed(seed)
        total, is_over = 0.0, False
        while not is_over:
            _, reward, terminated, truncated, _ = env.step(env.action_space.sample())
            total, is_over = total + reward, terminated or truncated
        returns.append(total)
    return np.array(returns)


def main() -> None:
    """Write a row for each problem."""
    rows = []
    for name, problem in PROBLEMS.items():
        best, expected = best_returns(problem, solve(problem))
        row = {"problem": name, "part": "held" if name in HELD else "tuned", "random": random_returns(problem).mean()}
        row |= {"best": best.mean(), "expected": expected}
        rows.append(
            {
                key: round(float(value), 4) if key in ("random", "best", "expected") else value
                for key, value in row.items()
            }
        )
        print(rows[-1], flush=True)
    write_tables(HERE, {"optima": rows})


if __name__ == "__main__":
    sys.exit(exit_code(main))
