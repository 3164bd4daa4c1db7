"""The settings and the card of traffic lights."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, NonNegativeInt, PositiveInt

from hpamdp.cards import ProblemCard
from hpamdp.env.gymnasium.options import SimulatorOptions
from hpamdp.settings import Settings

Kind = Literal["light", "rush", "shifting"]
Reward = Literal["queue", "waiting"]
ACTUATED = "actuated"
PLAYERS = ("webster", ACTUATED, "max_pressure", "longest_queue")
PHASES = ("north-south", "north-south left", "east-west", "east-west left")


class TrafficRules(Settings):
    """Settings of `TrafficLights`."""

    network: Literal["crossing", "corridor"] = "crossing"
    """`crossing`: a single one; `corridor`: three in a row, whose signals the agent sets in turn."""
    demand: Kind = "rush"
    """`light`: constant; `rush`: a peak, highest on one axis; `shifting`: one axis is busy first, then the other."""
    minutes: PositiveInt = 60
    """Length of an episode in minutes."""
    traffic: Annotated[float, Field(gt=0.0, le=3.0)] = 1.0
    """Factor on the flows of all arms."""
    reward: Reward = "queue"
    """`queue`: minus the vehicle hours waited since the last decision. `waiting`: minus the change of the waiting time.

    The waiting time of `waiting` is that of the vehicles that stand now, in vehicle hours.
    """
    whole_seconds: bool = False
    """Whether greens are whole numbers. Otherwise they are continuous, and rounded to the simulator's step of 1 s."""
    strategies: bool = False
    """Whether the choices of the hand-written players are discrete actions, too."""


class TrafficOptions(SimulatorOptions, TrafficRules):
    """Settings of `TrafficEnv`."""

    num_workers: NonNegativeInt = 0
    """Worker processes that call the simulations. If 0, this process calls one after another.

    Each simulation has a process of its own in any case.
    """

    @property
    def default_options(self) -> dict[str, list[int | str]]:
        """With `strategies`: the hand-written players, and the phases as one option that is learned; else none."""
        return {**{player: [player] for player in PLAYERS}, "learned": [*PHASES]} if self.strategies else {}


CARDS = {
    "TrafficEnv": ProblemCard(options=TrafficOptions),
}
