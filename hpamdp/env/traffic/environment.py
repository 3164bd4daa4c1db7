"""Traffic lights as a batched TorchRL environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial, update_wrapper
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import torch
from pydantic import Field, NonNegativeInt, PositiveInt
from tensordict import TensorDict
from torch import Tensor

from hpamdp.env.base import Metric
from hpamdp.env.facts import ProblemFacts
from hpamdp.env.gymnasium.environment import GymnasiumEnv, GymnasiumOptions
from hpamdp.env.traffic.demand import HELD_OUT, Kind
from hpamdp.env.traffic.lights import TrafficLights
from hpamdp.env.traffic.network import MAX_GREEN, MIN_GREEN, NETWORKS, PHASES
from hpamdp.env.traffic.players import PLAYERS
from hpamdp.env.traffic.simulation import observation_names
from hpamdp.settings import PositiveFraction, Settings

_RESULTS = ("delay", "queue", "stops", "throughput")
_LEARNED = "learned"
_INITIAL_GREEN_S = 15.0


class TrafficOptions(Settings):
    """Settings of `TrafficEnv`."""

    network: Literal["crossing", "corridor"] = "crossing"
    """`crossing`: one; `corridor`: three in a row, whose signals the agent sets in turn."""
    demand: Kind = "rush"
    """`light`: constant; `rush`: a peak, highest on one axis; `shifting`: one axis is busy first, then the other."""
    minutes: PositiveInt = 60
    """Length of an episode in minutes."""
    traffic: Annotated[float, Field(gt=0.0, le=3.0)] = 1.0
    """Factor of all flows."""
    reward: Literal["queue", "waiting"] = "queue"
    """`queue`: minus the vehicle hours waited since the last decision. `waiting`: minus the change of the waiting time.

    The waiting time of `waiting` is that of the vehicles that stand now, in vehicle hours.
    """
    whole_seconds: bool = False
    """Whether greens are whole numbers. Otherwise they are continuous, and rounded to the simulator's step of 1 s."""
    strategies: bool = False
    """Whether fixed times, SUMO's actuated signals and max-pressure are discrete actions, too."""
    render: bool = False
    """Draw the network, for films; steps then take longer."""
    reward_scaling: PositiveFraction | None = None
    """Divide rewards in training by the running standard deviation of the return with this discount.

    If None, rewards are not scaled.
    """
    num_workers: NonNegativeInt = 0
    """Processes that step the environments in parallel. If 0, this process steps them one after another."""


class TrafficEnv(GymnasiumEnv):
    """Set the traffic lights of `num_envs` networks, each simulated by SUMO in a process of its own.

    Action leaves:

    - `("action", "discrete")` int64 `[N]`: the next phase; with `strategies` also `webster`, `actuated` and
      `max_pressure`, which do what these players by hand would do now;
    - `("action", "parameters")` float32 `[N, 4]`: for each phase the seconds of green, in [5, 60].

    A step lasts until the next decision. See `TrafficLights`, and `GymnasiumEnv` for the arguments and the errors.
    """

    Options: ClassVar[type[Settings]] = TrafficOptions
    guarded_settings: ClassVar[tuple[str, ...]] = ()
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

    def __init__(
        self,
        num_envs: int = 1,
        *,
        options: TrafficOptions | None = None,
        device: torch.device | str | None = "cpu",
        seed: int = 0,
        first_env: int = 0,
        **settings: Any,
    ) -> None:
        given = TrafficOptions.of(options, settings)
        names = ("network", "demand", "minutes", "traffic", "reward", "whole_seconds", "strategies")
        self._has_strategies = given.strategies
        # Names before the base class reads them.
        self.discrete_names = (*PHASES, *(PLAYERS if given.strategies else ()))
        self.observation_names = tuple(observation_names(given.network))
        most = 60 * given.minutes // MIN_GREEN + 1
        reading = GymnasiumOptions(
            max_steps=most * len(NETWORKS[given.network]),
            observation_scaling="none",
            reward_scaling=given.reward_scaling,
            num_workers=given.num_workers,
        )
        chosen = {name: getattr(given, name) for name in names}
        make = partial(TrafficLights, render_mode="rgb_array" if given.render else None, **chosen)
        update_wrapper(make, TrafficLights)  # so that errors name TrafficLights
        super().__init__(num_envs, make=make, options=reading, device=device, seed=seed, first_env=first_env)

    @classmethod
    def facts(cls, options: Any) -> ProblemFacts:
        """Return the facts about the problem under these settings."""
        return ProblemFacts(
            title=cls.__name__,
            is_shardable=options.num_workers == 0,
            has_statistics=options.reward_scaling is not None,
            default_options=_options(options.strategies),
        )

    @property
    def default_options(self) -> Mapping[str, Sequence[int | str]]:
        """With `strategies`, each of them, and all phases for the learner."""
        return _options(self._has_strategies)

    def initial_parameters(self) -> tuple[Tensor, Tensor]:
        """Return constant greens of 15 s. Those of mid-range, 32 s, are too long for phases of few vehicles."""
        bias = 2.0 * (_INITIAL_GREEN_S - MIN_GREEN) / (MAX_GREEN - MIN_GREEN) - 1.0
        num, dim = len(PHASES), len(self.observation_names)
        return torch.zeros(num, dim, dtype=torch.float32), torch.full((num,), bias, dtype=torch.float32)

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
        """Return the results of the players by hand with the demands of the last episodes."""
        figures = {}
        for player in PLAYERS:
            results = self._copies.call("play", player)
            means = {name: float(np.mean([of_copy[name] for of_copy in results])) for name in _RESULTS}
            figures[player] = {"score": -means["delay"], **means}
        return figures


def _options(has_strategies: bool) -> dict[str, Sequence[int | str]]:
    return {**{player: [player] for player in PLAYERS}, _LEARNED: [*PHASES]} if has_strategies else {}
