"""Traffic lights as a batched TorchRL environment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Unbounded

from hpamdp import keys
from hpamdp.env.base import Metric
from hpamdp.env.gymnasium.environment import SimulatorEnv
from hpamdp.env.traffic.demand import HELD_OUT
from hpamdp.env.traffic.lights import TrafficLights
from hpamdp.env.traffic.network import ARMS, MAX_GREEN, MIN_GREEN, NETWORKS, lanes_of
from hpamdp.env.traffic.options import CARDS, PHASES, PLAYERS, TrafficOptions, TrafficRules
from hpamdp.env.traffic.players import START_S, VEHICLE_S
from hpamdp.env.traffic.simulation import VEHICLES, observation_names
from hpamdp.geometry import Symmetries, make_symmetries

_RESULTS = ("delay", "queue", "stops", "throughput")
_DURATION_S = 10.0  # for which a discount stands
_INITIAL_GREEN_S = 15.0  # in the corridor


class TrafficEnv(SimulatorEnv):
    """Set the traffic lights of `num_envs` networks, each simulated by SUMO in a process of its own.

    Action leaves:

    - `("action", "discrete")` int64 `[N]`: the next phase; with `strategies` also `webster`, `actuated`, `max_pressure`
      and `longest_queue`, which do what these hand-written players would do now;
    - `("action", "parameters")` float32 `[N, 4]`: for each phase the seconds of green, in [5, 60].

    A step lasts until the next decision. Its `duration` is in units of 10 s, so a discount stands for 10 s. See
    `TrafficLights`, and `GymnasiumEnv` for the arguments and the errors.
    """

    Options = TrafficOptions
    card = CARDS["TrafficEnv"]
    options: TrafficOptions
    simulator = TrafficLights
    simulator_options = TrafficRules
    reading: ClassVar[dict[str, Any]] = {"observation_scaling": "none"}
    table_metrics: ClassVar[tuple[Metric, ...]] = (
        Metric("score", "score"),
        Metric("delay", "delay, s a vehicle"),
        Metric("queue", "queue, vehicles"),
        Metric("stops", "stops a vehicle"),
        Metric("throughput", "vehicles an hour", "count"),
        Metric("steps", "decisions", "count"),
    )
    curve_metrics: ClassVar[tuple[Metric, ...]] = (
        Metric("score", "Score"),
        Metric("queue", "Vehicles that wait"),
    )

    def _prepare(self) -> None:
        self._is_single = len(NETWORKS[self.options.network]) == 1
        self.discrete_names = (*PHASES, *(PLAYERS if self.options.strategies else ()))
        self.observation_names = tuple(observation_names(self.options.network))

    def _make_specs(self) -> None:
        super()._make_specs()
        shape = (self.num_envs, 1)
        self.observation_spec[keys.DURATION] = Unbounded(shape=shape, device=self.device, dtype=torch.float32)

    def _read(self, reward: np.ndarray | None = None) -> TensorDict:
        seconds = [0] * self.num_envs if reward is None else self._copies.call("last_seconds")
        duration = torch.tensor(seconds, dtype=torch.float32, device=self.device).unsqueeze(-1) / _DURATION_S
        return super()._read(reward).set(keys.DURATION, duration)

    def initial_parameters(self) -> tuple[Tensor, Tensor]:
        """Return the greens of the player `longest_queue`; in the corridor 15 s.

        The player's green is linear in the queues of its signal. A linear function cannot tell which signal is due.
        """
        unit = 2.0 / (MAX_GREEN - MIN_GREEN)  # of a second
        names = list(self.observation_names)
        weight = torch.zeros(len(PHASES), len(names), dtype=torch.float32)
        if self._is_single:
            for phase, seconds in enumerate(VEHICLE_S):
                for arm, lane in lanes_of(phase):
                    weight[phase, names.index(f"queue_{ARMS[arm]}_{lane}")] = unit * VEHICLES * seconds
        green = START_S if self._is_single else _INITIAL_GREEN_S
        return weight, torch.full((len(PHASES),), unit * (green - MIN_GREEN) - 1.0, dtype=torch.float32)

    @property
    def symmetries(self) -> Symmetries | None:
        """The quarter turns of the crossing; the corridor has none."""
        if not self._is_single:
            return None
        names, num_turns = list(self.observation_names), len(ARMS)
        weight = torch.zeros(num_turns, len(names), len(names), dtype=torch.float32)
        discrete = torch.arange(len(self.discrete_names)).repeat(num_turns, 1)  # strategies stay as they are
        for turn in range(num_turns):
            for entry, name in enumerate(names):
                weight[turn, names.index(_turned(name, turn)), entry] = 1.0
            for phase in range(len(PHASES)):
                discrete[turn, phase] = _turned_phase(phase, turn)
        # A green moves with its phase. Turning phases twice leaves them as they were, so each map is its own inverse.
        source = discrete[:, : len(PHASES)]
        return make_symmetries(weight, discrete=discrete, source=source, num_parameters=len(PHASES))

    def fixed_episodes(self, seed: int) -> TensorDict:
        """Return numbers of demands that training never draws, one for each copy."""
        episodes = super().fixed_episodes(seed)
        return episodes.apply(lambda seeds: seeds % HELD_OUT + HELD_OUT)

    def _set_seed(self, seed: int | None) -> None:
        super()._set_seed(seed)
        self._next_seeds = [None if each is None else each % HELD_OUT for each in self._next_seeds]

    def played(self) -> dict[str, Tensor]:
        """Return `delay`, `queue`, `stops` and `throughput` of the last episodes, and `score`: minus the delay."""
        results = self._copies.call("last_results")
        columns = {name: torch.tensor([of_copy[name] for of_copy in results], dtype=torch.float32) for name in _RESULTS}
        return {**columns, "score": -columns["delay"]}

    def measure(self, played: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Return the means of the results."""
        return {name: float(played[name].mean()) for name in _RESULTS if name in played}

    def references(self, measured: Mapping[str, float]) -> dict[str, dict[str, float]]:
        """Return the results of the hand-written players on the demands of the last episodes."""
        figures = {}
        for player in PLAYERS:
            results = self._copies.call("play", player)
            means = {name: float(np.mean([of_copy[name] for of_copy in results])) for name in _RESULTS}
            figures[player] = {"score": -means["delay"], **means}
        return figures


def _turned(name: str, turn: int) -> str:
    """Return the entry of the observation to which an entry moves by quarter turns, clockwise."""
    kind, *where = name.split("_")
    if kind in ("queue", "approaching"):
        return f"{kind}_{ARMS[(ARMS.index(where[0]) + turn) % len(ARMS)]}_{where[1]}"
    return f"phase_{_turned_phase(int(where[0]), turn)}" if kind == "phase" else name


def _turned_phase(phase: int, turn: int) -> int:
    return (phase + 2 * turn) % len(PHASES)
