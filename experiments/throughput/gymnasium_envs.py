"""Compare `GymnasiumEnv` with Gymnasium's own loops over the same copies, and write gymnasium_envs.csv.

Run: python experiments/throughput/gymnasium_envs.py [--seconds 10] [--copies 16]

All ways are timed in one process with one thread, in CPU time, in turns of a few milliseconds. A rate is the median of
all turns. A ratio is the median over the turns, too, with the range of the middle 80% of them.

- `loop`: `reset` and `step` of each copy, in plain Python.
- `SyncVectorEnv`: Gymnasium's vector environment over the same copies, which also resets them.
- `GymnasiumEnv.step`: `env.step` and `step_mdp`, with a reset of the copies whose episode is over.
- `GymnasiumEnv.rollout`: `env.rollout` with random actions.
- `Collector`: a run's own collector, with tracked decisions.
- `floor`: as `GymnasiumEnv.step`, but the environment returns constants. TorchRL itself takes this time.

Actions come from a pool of eight samples, except where they are random.
"""

from __future__ import annotations

import argparse
import itertools
import math
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv
from gymnasium.wrappers import TimeLimit
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector

import hpamdp
from experiments.study_tables import Rows, write_tables
from hpamdp import keys
from hpamdp.env.decisions import with_decisions
from hpamdp.env.gymnasium.environment import GymnasiumEnv
from hpamdp.messages import exit_code

POOL = 8
STEPS = 100
BOXES = [spaces.Box(-1.0, 1.0, (1,)), spaces.Box(0.0, 1.0, (2,)), spaces.Box(0.0, 2.0, (1,))]


class Trivial(gymnasium.Env):
    """A point on a line. Its step takes a microsecond."""

    action_space = spaces.Tuple([spaces.Discrete(3), spaces.Tuple(BOXES)])
    observation_space = spaces.Box(-200.0, 200.0, (4,))

    def reset(self, *, seed=None, options=None):
        """Begin at 0."""
        super().reset(seed=seed)
        self.state = np.zeros(4, np.float32)
        return self.state, {}

    def step(self, action):
        """Move by the chosen parameter."""
        discrete, parameters = action
        self.state = self.state.copy()
        self.state[discrete] += parameters[discrete][0]
        return self.state, 0.5, False, False, {}


class Quick(Trivial):
    """A ball on a table, in plain Python. Its step takes about twelve microseconds."""

    def reset(self, *, seed=None, options=None):
        """Begin in the middle, at rest."""
        gymnasium.Env.reset(self, seed=seed)
        self.state = [0.0, 0.0, 0.0, 0.0]
        return np.array(self.state, np.float32), {}

    def step(self, action):
        """Push in one of three directions, and move by eight ticks between cushions."""
        discrete, parameters = action
        angle, force = 2.0 * float(discrete), float(parameters[discrete][0])
        x, y, speed_x, speed_y = self.state
        for _ in range(8):
            speed_x = 0.99 * speed_x + 0.01 * force * math.cos(angle)
            speed_y = 0.99 * speed_y + 0.01 * force * math.sin(angle)
            x, y = max(-1.0, min(1.0, x + 0.1 * speed_x)), max(-1.0, min(1.0, y + 0.1 * speed_y))
        self.state = [x, y, speed_x, speed_y]
        return np.array(self.state, np.float32), -math.hypot(x, y), False, False, {}


class Light(Trivial):
    """A cart in the plane, in a few lines of NumPy. Its step takes some ten microseconds."""

    def reset(self, *, seed=None, options=None):
        """Begin somewhere, at rest."""
        gymnasium.Env.reset(self, seed=seed)
        self.position = self.np_random.uniform(-1.0, 1.0, 2)
        self.speed = np.zeros(2)
        return np.concatenate([self.position, self.speed]).astype(np.float32), {}

    def step(self, action):
        """Push in one of three directions, with friction and noise."""
        discrete, parameters = action
        angle = 2.0 * discrete
        force = parameters[discrete][0] * np.array([np.cos(angle), np.sin(angle)])
        self.speed = 0.9 * self.speed + 0.1 * force + 0.01 * self.np_random.normal(size=2)
        self.position = np.clip(self.position + 0.1 * self.speed, -100.0, 100.0)
        distance = float(np.linalg.norm(self.position))
        observation = np.concatenate([self.position, self.speed]).astype(np.float32)
        return observation, -distance, distance < 0.001, False, {}


class Medium(Trivial):
    """A chain of masses, observed as a `Dict` with numbers and a phase. Its step takes some fifty microseconds."""

    observation_space = spaces.Dict(
        position=spaces.Box(-1e3, 1e3, (8,), np.float64),
        speed=spaces.Box(-1e3, 1e3, (8,), np.float64),
        phase=spaces.Discrete(4),
    )

    def reset(self, *, seed=None, options=None):
        """Begin with random displacements."""
        super().reset(seed=seed)
        self.position = self.np_random.normal(size=8)
        self.speed = np.zeros(8)
        self.ticks = 0
        return self._observation(), {"energy": 0.0}

    def step(self, action):
        """Push the chosen mass, and move all of them by ten ticks."""
        discrete, parameters = action
        force = np.zeros(8)
        force[discrete] = parameters[discrete][0]
        for _ in range(10):
            self.speed = 0.99 * self.speed + 0.02 * (force - self.position)
            self.position = self.position + 0.02 * self.speed
        self.ticks += 1
        energy = float(self.speed @ self.speed)
        return self._observation(), -energy, False, False, {"energy": energy}

    def _observation(self):
        return {"position": self.position, "speed": self.speed, "phase": self.ticks % 4}


class Constant(GymnasiumEnv):
    """Return the same tensors at every step, with the specs of the environment."""

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        self.same = super()._reset(tensordict)
        self.after = self.same.clone().set(keys.REWARD, torch.zeros(self.num_envs, 1))
        return self.same.copy()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self.after.copy()


def limited(cls: type[gymnasium.Env]) -> gymnasium.Env:
    """Return a copy with a time limit."""
    return TimeLimit(cls(), STEPS)


def loop(cls: type[gymnasium.Env], copies: int) -> Callable[[], object]:
    """Return a function that steps each copy once, in plain Python."""
    envs = [limited(cls) for _ in range(copies)]
    for env in envs:
        env.reset(seed=0)
    envs[0].action_space.seed(0)
    pool = itertools.cycle([[envs[0].action_space.sample() for _ in envs] for _ in range(POOL)])

    def step() -> None:
        for env, action in zip(envs, next(pool), strict=True):
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()

    return step


def vector(cls: type[gymnasium.Env], copies: int) -> Callable[[], object]:
    """Return a function that makes a step of Gymnasium's vector environment."""
    env = SyncVectorEnv([lambda: limited(cls)] * copies)
    env.reset(seed=0)
    env.action_space.seed(0)
    pool = itertools.cycle([env.action_space.sample() for _ in range(POOL)])
    return lambda: env.step(next(pool))


def adapter(cls: type[gymnasium.Env], copies: int, kind: type[GymnasiumEnv] = GymnasiumEnv) -> GymnasiumEnv:
    """Return the TorchRL environment over the copies."""
    return kind(copies, entry_point=f"{__name__}:{cls.__name__}", max_steps=STEPS)


def stepper(env: GymnasiumEnv) -> Callable[[], object]:
    """Return a function that makes a step, with resets."""
    pool = actions_of(env)
    td = env.reset()

    def step() -> None:
        nonlocal td
        _, td = env.step_and_maybe_reset(td.set(keys.ACTION, next(pool)))

    return step


def roller(env: GymnasiumEnv) -> Callable[[], object]:
    """Return a function that makes a rollout of `STEPS` steps."""
    return lambda: env.rollout(STEPS, break_when_any_done=False)


def collecting(env: GymnasiumEnv) -> Callable[[], object]:
    """Return a function that collects `STEPS` steps of each copy, as a run does."""
    pool = actions_of(env)
    collector = Collector(
        with_decisions(env),
        TensorDictModule(lambda: next(pool), [], [keys.ACTION]),
        frames_per_batch=env.num_envs * STEPS,
        total_frames=-1,
        device="cpu",
        trust_policy=True,
        auto_register_policy_transforms=False,
        track_traj_ids=False,
    )
    batches = iter(collector)
    return lambda: next(batches)


def actions_of(env: GymnasiumEnv) -> Iterator[TensorDictBase]:
    """Yield actions from a pool."""
    pool = [env.rand_action(env.reset()).get(keys.ACTION) for _ in range(POOL)]
    while True:
        yield from pool


def rates(steppers: dict[str, tuple[Callable[[], object], int]], seconds: float) -> dict[str, list[float]]:
    """Return the steps per second of CPU time of each way in each of many turns, in which the ways alternate."""
    measured: dict[str, list[float]] = {what: [] for what in steppers}
    for step, _ in steppers.values():
        for _ in range(3):
            step()
    ended = time.perf_counter() + seconds
    while time.perf_counter() < ended:
        for what, (step, steps_per_call) in steppers.items():
            calls = max(1, 160 // steps_per_call)
            started = time.process_time()
            for _ in range(calls):
                step()
            measured[what].append(calls * steps_per_call / (time.process_time() - started))
    return measured


def main() -> None:
    """Measure all environments and write the csv file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0, help="for each environment")
    parser.add_argument("--copies", type=int, default=16)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    copies = arguments.copies
    print(f"hpamdp {hpamdp.__version__}, torch {torch.__version__}, gymnasium {gymnasium.__version__}, {copies} copies")
    rows: Rows = []
    for cls in (Trivial, Quick, Light, Medium):
        steppers = {
            "loop": (loop(cls, copies), copies),
            "SyncVectorEnv": (vector(cls, copies), copies),
            "GymnasiumEnv.step": (stepper(adapter(cls, copies)), copies),
            "GymnasiumEnv.rollout": (roller(adapter(cls, copies)), copies * STEPS),
            "Collector": (collecting(adapter(cls, copies)), copies * STEPS),
            "floor": (stepper(adapter(cls, copies, Constant)), copies),
        }
        measured = rates(steppers, arguments.seconds)
        for what, of_turns in measured.items():
            rate = statistics.median(of_turns)
            ratios = np.divide(of_turns, measured["SyncVectorEnv"])
            low, ratio, high = (f"{number:.2f}" for number in np.quantile(ratios, (0.1, 0.5, 0.9)))
            named = {"env": cls.__name__, "what": what, "steps_per_s": round(rate)}
            rows.append({**named, "ratio": ratio, "ratio_low": low, "ratio_high": high})
            print(f"{cls.__name__:<8} {what:<21} {rate:>10,.0f} steps/s  {ratio} ({low} to {high}) x SyncVectorEnv")
    write_tables(Path(__file__).parent, {"gymnasium_envs": rows})


if __name__ == "__main__":
    sys.exit(exit_code(main))
