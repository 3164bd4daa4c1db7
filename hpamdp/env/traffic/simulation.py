"""SUMO's simulation of an episode, in a process of its own: libsumo holds one simulation a process.

`serve` answers the calls that arrive through a connection, see `process`.
"""

from __future__ import annotations

import os
import shutil
import sys
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from hpamdp.env.traffic.demand import Demand, draw, write_vehicles
from hpamdp.env.traffic.network import ARMS, GREENS, MAX_GREEN, MIN_GREEN, NETWORKS, NUM_LANES, YELLOW
from hpamdp.env.traffic.options import ACTUATED, PHASES
from hpamdp.env.traffic.players import LongestQueue, MaxPressure, Webster
from hpamdp.messages import one_line

VEHICLES = 20.0
"""Queues and approaching vehicles are observed in units of this many vehicles."""
HOUR_S = 3600.0
FOLDER_PREFIX = "hpamdp-traffic-"
"""The folder of a simulation is named so, and no other is removed."""
_STANDING = 0.1  # m/s, below which SUMO counts a vehicle as waiting
_TRIPS = "trips.xml"


@dataclass(frozen=True)
class Task:
    """What the episodes of a copy have in common.

    Attributes:
        network, demand: names of the network and of the kind of demand.
        network_file: SUMO's file of the network.
        duration_s: length of an episode, s.
        traffic: factor of all flows.
        reward: `queue` or `waiting`.
        is_drawn: whether decisions see a `Scene`, too.
    """

    network: str
    demand: str
    network_file: str
    duration_s: int
    traffic: float
    reward: str
    is_drawn: bool = False


@dataclass
class Lamp:
    """The state of a signal. Times are s since the episode began.

    Attributes:
        phase: of the current green, or of the next one during yellow.
        since: when this green began or will begin.
        until: when it ends; None if SUMO's own program ends it.
        num_decisions: number of decisions so far.
        is_actuated: whether SUMO's actuated program has the signal.
        yellow_since: when the current yellow began, or None.
    """

    phase: int = 0
    since: int = 0
    until: int | None = 0
    num_decisions: int = 0
    is_actuated: bool = True
    yellow_since: int | None = None


@dataclass(frozen=True)
class Scene:
    """What a picture shows.

    Attributes:
        time_s: since the episode began.
        vehicles: x, y (m) and whether it waits, `[V, 3]`.
        num_outside: number of vehicles that wait to enter.
        lights: SUMO's states of the signals.
        phases: their phases.
    """

    time_s: int
    vehicles: np.ndarray
    num_outside: int
    lights: list[str]
    phases: list[int]


@dataclass(frozen=True)
class Seen:
    """What a decision sees.

    Attributes:
        observation: float32.
        reward: of the time since the last decision.
        seconds: this time.
        is_over: whether the episode has ended.
        results: of the whole episode if it has ended: `delay`, `queue`, `stops`, `throughput`.
        scene: for a picture, if the task is drawn.
    """

    observation: np.ndarray
    reward: float
    seconds: int
    is_over: bool
    results: dict[str, float]
    scene: Scene | None


def observation_names(network: str) -> list[str]:
    """Return the names of the entries of an observation."""
    signals = NETWORKS[network]
    is_single = len(signals) == 1
    names = []
    for signal in signals:
        lanes = [f"{arm}_{lane}" for arm in ARMS for lane in range(NUM_LANES)]
        own = [*(f"queue_{lane}" for lane in lanes), *(f"approaching_{lane}" for lane in lanes)]
        own += [*(f"phase_{number}" for number in range(len(PHASES))), "time_in_phase"]
        if not is_single:
            own += ["time_left", "is_due"]
        names += own if is_single else [f"{signal.name}_{name}" for name in own]
    return names


class Simulation:
    """An episode of traffic.

    Args:
        task: what all episodes have in common.
        folder: where SUMO's files of the episode go.

    Attributes:
        lamps: the states of the signals.
    """

    def __init__(self, task: Task, folder: Path) -> None:
        import libsumo

        self._sumo = libsumo
        self._task = task
        self._folder = folder
        self._signals = NETWORKS[task.network]
        self._inward = [edge for signal in self._signals for edge in signal.inward()]
        self._lanes = [
            [f"{edge}_{lane}" for edge in signal.inward() for lane in range(NUM_LANES)] for signal in self._signals
        ]
        known = {*self._inward}
        self._onward = [[(edge if edge in known else None) for edge in signal.outward()] for signal in self._signals]
        self._is_running = False
        self._number = 0
        self._demand: Demand | None = None

    def begin(self, number: int) -> Seen:
        """Begin the episode with a demand, and return what the first decision sees."""
        self._demand = draw(number, self._task.demand, self._task.network, self._task.duration_s, self._task.traffic)
        self._vehicles = write_vehicles(self._demand, number, Path(self._task.network_file), self._folder)
        self._number = number
        self._start()
        return self._seen(0.0, 0)

    def _start(self) -> None:
        self._stop()
        given = ["sumo", "--net-file", self._task.network_file, "--route-files", str(self._vehicles)]
        given += ["--seed", str(self._number), "--time-to-teleport", "-1"]
        given += ["--tripinfo-output", str(self._folder / _TRIPS)]
        given += ["--tripinfo-output.write-unfinished", "true", "--tripinfo-output.write-undeparted", "true"]
        given += ["--no-step-log", "true", "--no-warnings", "true", "--duration-log.disable", "true"]
        self._sumo.start(given)
        self._is_running = True
        self._now = 0
        self._queue_s = 0.0  # vehicles times seconds, of the whole episode
        self._earlier = 0.0  # what the reward is counted from
        self._strategies: dict[str, Webster | MaxPressure | LongestQueue] = {}
        self.lamps = [Lamp() for _ in self._signals]
        self._due = 0

    def _stop(self) -> None:
        if self._is_running:
            self._sumo.close()
            self._is_running = False

    def act(self, phase: int, green: float) -> Seen:
        """Give the signal that is due a phase and its green (s), and go on to the next decision."""
        self._set_phase(self._due, phase, round(green))
        return self._go_on()

    def follow(self, player: str) -> Seen:
        """Give the signal that is due what a hand-written player would, and go on to the next decision."""
        if player == ACTUATED:
            self._hand_over(self._due)
        else:
            self._set_phase(self._due, *self._strategy(player).choose(self, self._due))
        return self._go_on()

    def play(self, player: str) -> dict[str, float]:
        """Return the results of a hand-written player on the last demand. An unfinished episode is abandoned."""
        self._start()
        seen = self.follow(player)
        while not seen.is_over:
            seen = self.follow(player)
        return seen.results

    def _strategy(self, player: str) -> Webster | MaxPressure | LongestQueue:
        if player not in self._strategies:
            if player == "longest_queue":
                self._strategies[player] = LongestQueue()
            elif player == "max_pressure":
                self._strategies[player] = MaxPressure()
            else:
                assert self._demand is not None
                self._strategies[player] = Webster(self._demand)
        return self._strategies[player]

    def _set_phase(self, number: int, phase: int, green: int) -> None:
        lamp, name = self.lamps[number], self._signals[number].name
        if phase != lamp.phase:
            # SUMO's own program may have begun the yellow.
            began = self._now if lamp.yellow_since is None else lamp.yellow_since
            self._sumo.trafficlight.setRedYellowGreenState(name, GREENS[lamp.phase].replace("G", "y"))
            lamp.since = max(began + YELLOW, self._now)
            lamp.phase = phase
        elif lamp.is_actuated:
            self._sumo.trafficlight.setRedYellowGreenState(name, GREENS[phase])
        lamp.yellow_since, lamp.is_actuated = None, False
        lamp.until = max(lamp.since, self._now) + green
        lamp.num_decisions += 1

    def _hand_over(self, number: int) -> None:
        """Let SUMO's actuated program decide when the next phase of its cycle ends."""
        lamp = self.lamps[number]
        if not lamp.is_actuated:
            self._set_phase(number, (lamp.phase + 1) % len(PHASES), MIN_GREEN)
            lamp.is_actuated = True
        elif lamp.yellow_since is not None:
            lamp.phase = (lamp.phase + 1) % len(PHASES)
            lamp.since = lamp.yellow_since + YELLOW
            lamp.yellow_since = None
        lamp.until = None
        lamp.num_decisions += 1

    def _go_on(self) -> Seen:
        """Simulate until a signal is due or the episode is over."""
        before = self._now
        while True:
            due = [
                number for number, lamp in enumerate(self.lamps) if lamp.until is not None and lamp.until <= self._now
            ]
            if due or self._now >= self._task.duration_s:
                break
            self._step()
        if due:
            self._due = due[0]
        earlier, self._earlier = self._earlier, self._measure()
        return self._seen((earlier - self._earlier) / HOUR_S, self._now - before)

    def _measure(self) -> float:
        """Return the vehicle seconds whose increase since the last decision costs the agent."""
        if self._task.reward == "queue":
            return self._queue_s
        return sum(map(self._sumo.edge.getWaitingTime, self._inward))

    def _step(self) -> None:
        sumo = self._sumo
        for signal, lamp in zip(self._signals, self.lamps, strict=True):
            if lamp.since == self._now and self._now > 0:
                if not lamp.is_actuated:
                    sumo.trafficlight.setRedYellowGreenState(signal.name, GREENS[lamp.phase])
                elif lamp.until is None and sumo.trafficlight.getProgram(signal.name) != ACTUATED:
                    sumo.trafficlight.setProgram(signal.name, ACTUATED)
                    sumo.trafficlight.setPhase(signal.name, 2 * lamp.phase)
                    sumo.trafficlight.setPhaseDuration(signal.name, MIN_GREEN)
        sumo.simulationStep()
        self._now += 1
        halting = sum(map(sumo.edge.getLastStepHaltingNumber, self._inward))
        self._queue_s += halting + len(sumo.simulation.getPendingVehicles())
        for signal, lamp in zip(self._signals, self.lamps, strict=True):
            has_begun = lamp.is_actuated and lamp.until is None and self._now > lamp.since
            if has_begun and sumo.trafficlight.getPhase(signal.name) == 2 * lamp.phase + 1:
                lamp.until = self._now
                lamp.yellow_since = self._now - 1  # the step had yellow already

    def queues(self, number: int) -> np.ndarray:
        """Return the waiting vehicles of a signal's lanes, `[arm, lane]`."""
        waiting = list(map(self._sumo.lane.getLastStepHaltingNumber, self._lanes[number]))
        return np.array(waiting, np.float64).reshape(len(ARMS), NUM_LANES)

    def onward_queues(self, number: int) -> np.ndarray:
        """Return the mean queue of a lane on each arm that leads on from a signal, `[arm]`; 0 out of the network."""
        edges = self._onward[number]
        return np.array(
            [0.0 if edge is None else self._sumo.edge.getLastStepHaltingNumber(edge) / NUM_LANES for edge in edges]
        )

    def _seen(self, reward: float, seconds: int) -> Seen:
        is_over = self._now >= self._task.duration_s
        observation = np.concatenate([self._observed(number) for number in range(len(self._signals))])
        scene = self._scene() if self._task.is_drawn else None
        return Seen(observation.astype(np.float32), reward, seconds, is_over, self._results() if is_over else {}, scene)

    def _observed(self, number: int) -> np.ndarray:
        lamp = self.lamps[number]
        queues = self.queues(number).ravel()
        present = np.array(list(map(self._sumo.lane.getLastStepVehicleNumber, self._lanes[number])))
        phase = np.eye(len(PHASES))[lamp.phase]
        entries = [queues / VEHICLES, (present - queues) / VEHICLES, phase, [(self._now - lamp.since) / MAX_GREEN]]
        if len(self._signals) > 1:
            left = 0.0 if lamp.until is None else (lamp.until - self._now) / MAX_GREEN
            entries.append([left, float(number == self._due)])
        return np.concatenate(entries)

    def _scene(self) -> Scene:
        sumo = self._sumo
        names = sumo.vehicle.getIDList()
        rows = [(*sumo.vehicle.getPosition(name), sumo.vehicle.getSpeed(name) < _STANDING) for name in names]
        return Scene(
            self._now,
            np.array(rows, np.float32).reshape(-1, 3),
            len(sumo.simulation.getPendingVehicles()),
            [sumo.trafficlight.getRedYellowGreenState(signal.name) for signal in self._signals],
            [lamp.phase for lamp in self.lamps],
        )

    def _results(self) -> dict[str, float]:
        """End the simulation and return its results over all vehicles that wanted to enter."""
        self._stop()
        trips = ElementTree.parse(self._folder / _TRIPS).getroot()
        delays = [float(trip.attrib["timeLoss"]) + float(trip.attrib["departDelay"]) for trip in trips]
        stops = [int(trip.attrib["waitingCount"]) for trip in trips]
        arrived = sum(float(trip.attrib["arrival"]) >= 0.0 for trip in trips)
        duration = self._task.duration_s
        return {
            "delay": float(np.mean(delays)) if delays else 0.0,
            "queue": self._queue_s / duration,
            "stops": float(np.mean(stops)) if stops else 0.0,
            "throughput": arrived * HOUR_S / duration,
        }


def serve() -> None:
    """Serve the calls that arrive through the connection whose number is the argument, until it is closed.

    Then remove the working directory, which is the folder of this simulation: a run that was killed cannot do it.
    """
    connection = Connection(int(sys.argv[1]))
    folder = Path.cwd()
    try:
        _serve(connection)
    except BrokenPipeError:  # the run was killed while it waited for an answer
        pass
    finally:
        os.chdir(folder.parent)
        if folder.name.startswith(FOLDER_PREFIX):
            shutil.rmtree(folder, ignore_errors=True)


def _serve(connection: Connection) -> None:
    """Answer calls until the connection is closed."""
    simulation: Simulation | None = None
    while True:
        try:
            method, arguments = connection.recv()
        except EOFError:
            return
        try:
            if simulation is None:
                simulation = Simulation(*arguments)
                answer: Any = None
            else:
                answer = getattr(simulation, method)(*arguments)
        except Exception as error:
            connection.send((False, one_line(f"{type(error).__name__}: {error}")))
        else:
            connection.send((True, answer))
