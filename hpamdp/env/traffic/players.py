"""Hand-written players: fixed times by Webster's formula, max-pressure and the longest queue.

A fourth player, `actuated`, is SUMO's own program.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from hpamdp.env.traffic.demand import Demand
from hpamdp.env.traffic.network import ARMS, MAX_GREEN, MIN_GREEN, NETWORKS, YELLOW, Signal, lanes_of
from hpamdp.env.traffic.options import PHASES

if TYPE_CHECKING:
    from hpamdp.env.traffic.simulation import Simulation


START_S = 3.0
"""Green (s) of `LongestQueue` for the start of the first vehicle."""
VEHICLE_S = (0.7, 1.2, 0.7, 1.2)
"""Green (s) of `LongestQueue` for each waiting vehicle, by phase. Phases for left turns have half as many lanes."""
_SATURATION = 1800.0  # vehicles an hour that a lane discharges at green
_LOST_S = 4.0  # lost time of a phase, by its start and its yellow
_SHORTEST_CYCLE_S, _LONGEST_CYCLE_S = 40.0, 120.0
_LARGEST_RATIO = 0.95  # of flow to saturation, for which the formula still has a cycle
_PERIOD_S = 15  # between two decisions of max-pressure
_OFFSET_S = 22  # a vehicle's time between two crossings of the corridor


class Webster:
    """Fixed times: a cycle through all phases, the same for the whole episode, from the mean flows of the demand.

    Source: Webster 1958, *Traffic signal settings*, Road Research Technical Paper 39. Let y be the critical flow ratio
    of each phase, Y their sum, and L the lost time of a cycle (s). The cycle takes (1.5 L + 5) / (1 - Y) s, and greens
    are proportional to y. All crossings of the corridor have the longest of their cycles, and begin it 22 s after their
    western neighbour.
    """

    def __init__(self, demand: Demand) -> None:
        signals = NETWORKS[demand.network]
        ratios = [_flow_ratios(demand, signal) for signal in signals]
        cycle = max(_cycle(of_signal) for of_signal in ratios)
        self.greens = [_greens(of_signal, cycle) for of_signal in ratios]
        self._offsets = [_OFFSET_S * number for number in range(len(signals))]

    def choose(self, simulation: Simulation, signal: int) -> tuple[int, int]:
        """Return the next phase of a signal and its green (s)."""
        lamp = simulation.lamps[signal]
        if lamp.num_decisions == 0:
            return 0, self.greens[signal][0] + self._offsets[signal]
        phase = (lamp.phase + 1) % len(PHASES)
        return phase, self.greens[signal][phase]


class MaxPressure:
    """The phase with the highest pressure: the queues that it serves, less the mean queues where they go.

    Source: Varaiya 2013, *Max pressure control of a network of signalized intersections*, Transportation Research
    Part C 36, with a decision every 15 s.
    """

    def choose(self, simulation: Simulation, signal: int) -> tuple[int, int]:
        """Return the next phase of a signal and its green (s). Ties keep the phase."""
        queues = simulation.queues(signal)
        onward = simulation.onward_queues(signal)
        pressures = np.zeros(len(PHASES))
        for phase in range(len(PHASES)):
            for arm, lane in lanes_of(phase):
                to = (arm + 1) % len(ARMS) if lane == 2 else (arm + 2) % len(ARMS)
                pressures[phase] += queues[arm, lane] - onward[to]
        lamp = simulation.lamps[signal]
        pressures[lamp.phase] += 1e-6
        return int(pressures.argmax()), _PERIOD_S


class LongestQueue:
    """The phase for which the most vehicles wait, for as long as they need to leave."""

    def choose(self, simulation: Simulation, signal: int) -> tuple[int, int]:
        """Return the next phase of a signal and its green (s). Ties take the first phase."""
        queues = simulation.queues(signal)
        waiting = [sum(queues[arm, lane] for arm, lane in lanes_of(phase)) for phase in range(len(PHASES))]
        phase = int(np.argmax(waiting))
        return phase, min(max(round(START_S + VEHICLE_S[phase] * waiting[phase]), MIN_GREEN), MAX_GREEN)


def _flow_ratios(demand: Demand, signal: Signal) -> np.ndarray:
    """Return the ratio of flow to saturation of each phase's busiest lane, `[4]`."""
    flows = demand.mean_flows()
    ratios = np.zeros(len(PHASES))
    for arm, edge in enumerate(signal.inward()):
        left, ahead, right = flows[edge]
        first = 0 if arm % 2 == 0 else 2
        ratios[first] = max(ratios[first], (ahead + right) / 2.0 / _SATURATION)
        ratios[first + 1] = max(ratios[first + 1], left / _SATURATION)
    return ratios


def _cycle(ratios: Sequence[float] | np.ndarray) -> float:
    lost = _LOST_S * len(PHASES)
    ratio = min(float(np.sum(ratios)), _LARGEST_RATIO)
    return min(max((1.5 * lost + 5.0) / (1.0 - ratio), _SHORTEST_CYCLE_S), _LONGEST_CYCLE_S)


def _greens(ratios: np.ndarray, cycle: float) -> list[int]:
    """Return whole greens within the bounds, except for the longest one, which fills the cycle."""
    whole = round(cycle) - YELLOW * len(PHASES)
    greens = [min(max(round(whole * ratio / ratios.sum()), MIN_GREEN), MAX_GREEN) for ratio in ratios.tolist()]
    longest = int(np.argmax(greens))
    greens[longest] += whole - sum(greens)
    return greens
