"""Traffic demand: how many vehicles enter at each time, and where they turn.

A demand is a function of its number. Numbers below `HELD_OUT` are for training, the others for evaluation, so an
evaluation never repeats a demand of training.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np

from hpamdp.env.traffic.network import NETWORKS, Signal, entries, run_tool
from hpamdp.env.traffic.options import Kind

KINDS: tuple[str, ...] = get_args(Kind)
HELD_OUT = 2**30
"""First number of a demand that training never draws."""
NUM_DEMANDS = 2**31
_SLICE_S = 300  # length of the slices of constant flow


@dataclass(frozen=True)
class Demand:
    """The expected demand of an episode.

    Attributes:
        network: name of the network.
        ends: ends of the slices of time, s `[S]`.
        flows: vehicles an hour that enter on each edge of `entries(network)`, `[S, E]`.
        turns: for each edge towards a signal the fractions that turn left, go ahead and turn right.
    """

    network: str
    ends: np.ndarray
    flows: np.ndarray
    turns: dict[str, np.ndarray]

    def mean_flows(self) -> dict[str, np.ndarray]:
        """Return the mean flow of each edge towards a signal, by turn: vehicles an hour `[3]`."""
        lengths = np.diff(self.ends, prepend=0.0)
        means = dict(zip(entries(self.network), np.average(self.flows, axis=0, weights=lengths), strict=True))
        signals = NETWORKS[self.network]
        waiting = [(signal, arm) for signal in signals for arm in range(4)]
        known: dict[str, np.ndarray] = {}
        while waiting:  # edges between signals, as soon as the flows that lead to them are known
            signal, arm = waiting.pop(0)
            edge = signal.inward()[arm]
            total = means[edge] if edge in means else _inflow(edge, signals, known)
            if total is None:
                waiting.append((signal, arm))
            else:
                known[edge] = total * self.turns[edge]
        return known


def _inflow(edge: str, signals: tuple[Signal, ...], known: dict[str, np.ndarray]) -> float | None:
    """Return the flow into an edge between signals, or None if a flow that leads to it is not known yet."""
    (signal,) = (signal for signal in signals if edge in signal.outward())
    total = 0.0
    for arm, source in enumerate(signal.inward()):
        turns = signal.turns(arm)
        if edge in turns:
            if source not in known:
                return None
            total += float(known[source][turns.index(edge)])
    return total


def draw(number: int, kind: str, network: str, duration_s: int, traffic: float) -> Demand:
    """Return a demand.

    - `light`: every arm has a constant flow;
    - `rush`: an hour with a peak, which is highest on the two arms of an axis, north-south or east-west;
    - `shifting`: one axis is busy first, then the other.

    Flows, the busy axis, times, heights and turns are drawn anew for each number.

    Args:
        number: of the demand, 0 to `NUM_DEMANDS` - 1.
        kind: one of `KINDS`.
        network: one of `NETWORKS`.
        duration_s: length of the episode, s.
        traffic: factor of all flows.
    """
    generator = np.random.default_rng((number, KINDS.index(kind)))
    starts = np.arange(0, duration_s, _SLICE_S)
    ends = np.minimum(starts + _SLICE_S, duration_s)
    time = (starts + ends)[:, None] / (2.0 * duration_s)  # as a fraction of the episode
    names = entries(network)
    axis = generator.integers(2)
    is_busy = np.array([(name.startswith(("east", "west"))) == bool(axis) for name in names])
    if kind == "light":
        flows = generator.uniform(150.0, 350.0, len(names)) + 0.0 * time
    elif kind == "rush":
        peak, width = generator.uniform(0.35, 0.65), generator.uniform(0.12, 0.22)
        heights = np.where(
            is_busy, generator.uniform(700.0, 1300.0, len(names)), generator.uniform(150.0, 450.0, len(names))
        )
        flows = generator.uniform(250.0, 450.0, len(names)) + heights * np.exp(-0.5 * ((time - peak) / width) ** 2)
    else:
        middle = generator.uniform(0.35, 0.65)
        first = np.clip((middle + 0.05 - time) / 0.1, 0.0, 1.0)
        heights = generator.uniform(500.0, 900.0, len(names))
        flows = generator.uniform(200.0, 350.0, len(names)) + heights * np.where(is_busy, first, 1.0 - first)
    turns = {}
    for signal in NETWORKS[network]:
        for edge in signal.inward():
            left, right = generator.uniform(0.1, 0.25), generator.uniform(0.1, 0.2)
            turns[edge] = np.array([left, 1.0 - left - right, right])
    return Demand(network, ends, traffic * flows, turns)


def write_vehicles(demand: Demand, number: int, network_file: Path, folder: Path) -> Path:
    """Return a file with the vehicles of a demand, which SUMO's jtrrouter draws from flows and turns.

    Arrivals are a Poisson process: the number of vehicles in a slice is Poisson, and their times are uniform.

    Args:
        demand: the expected demand.
        number: seeds the vehicles.
        network_file: SUMO's file of the network.
        folder: where the files go.
    """
    generator = np.random.default_rng((number, len(KINDS)))
    lengths = np.diff(demand.ends, prepend=0)
    counts = generator.poisson(demand.flows * lengths[:, None] / 3600.0)
    names = entries(demand.network)
    flows = []
    for end, length, of_slice in zip(demand.ends.tolist(), lengths.tolist(), counts.tolist(), strict=True):
        for name, count in zip(names, of_slice, strict=True):
            if count:
                where = f'id="{name}_{end}" from="{name}" begin="{end - length}" end="{end}" number="{count}"'
                flows.append(f'<flow {where} departLane="best" departSpeed="max"/>')
    vehicles = folder / "vehicles.rou.xml"
    if not flows:  # which jtrrouter refuses
        vehicles.write_text("<routes/>\n")
        return vehicles
    turns = []
    for signal in NETWORKS[demand.network]:
        for arm, edge in enumerate(signal.inward()):
            for to, fraction in zip(signal.turns(arm), demand.turns[edge].tolist(), strict=True):
                turns.append(f'<edgeRelation from="{edge}" to="{to}" probability="{fraction}"/>')
    (folder / "flows.xml").write_text("<routes>\n" + "\n".join(flows) + "\n</routes>\n")
    interval = f'<interval begin="0" end="{int(demand.ends[-1])}">'
    (folder / "turns.xml").write_text(f"<turns>{interval}\n" + "\n".join(turns) + "\n</interval></turns>\n")
    run_tool(
        "jtrrouter",
        *("--net-file", str(network_file), "--route-files", str(folder / "flows.xml")),
        *("--turn-ratio-files", str(folder / "turns.xml"), "--output-file", str(vehicles)),
        *("--seed", str(number), "--randomize-flows", "true", "--accept-all-destinations", "true"),
        *("--no-step-log", "true"),
    )
    return vehicles
