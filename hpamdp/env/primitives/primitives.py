"""Ten primitives of a robot's arm, and position steps of two sizes, as loops over the simulator's own action.

The simulator's action is a displacement of the hand's target in units of 1 cm, clipped to [-1, 1], and the effort of
the fingers: 1 closes, -1 opens. The target stays within the workspace, so the hand stops at its walls.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

STEP_M = 0.01
"""Displacement of the hand's target in one low-level step by an action of 1, in metres."""
GAIN = 10.0
"""Action for each metre that is left to the end pose, as in Meta-World's own scripted policies."""
STEPS, OPENING_STEPS = 60, 40
"""Low-level steps of each phase of a primitive, and of opening the fingers."""
SMALL_STEPS, LARGE_STEPS = 1, 10
"""Low-level steps of a small and of a large position step."""

_OPEN, _CLOSE = -1.0, 1.0


class Hand(Protocol):
    """What a primitive sees of the arm before each low-level step."""

    def position(self) -> np.ndarray:
        """Return where the hand is, in metres, `[3]`."""

    def holding_effort(self) -> float:
        """Return the effort with which the fingers stay where they are."""


@dataclass(frozen=True)
class Phase:
    """A part of an action, in which the hand moves to one end pose.

    Attributes:
        displacement: of the end pose from where the phase begins, in metres.
        effort: of the fingers; None to keep them where they are.
        steps: number of low-level steps.
        is_direct: whether every step moves the hand's target by an equal part, whatever the hand does.
    """

    displacement: tuple[float, float, float]
    effort: float | None
    steps: int = STEPS
    is_direct: bool = False

    def commands(self, hand: Hand) -> Iterator[np.ndarray]:
        """Yield the simulator's actions, float32 `[4]`; each is computed from where the hand is then."""
        displacement = np.array(self.displacement)
        end = hand.position() + displacement
        for _ in range(self.steps):
            if self.is_direct:
                wanted = displacement / (self.steps * STEP_M)
            else:
                wanted = GAIN * (end - hand.position())
            effort = hand.holding_effort() if self.effort is None else self.effort
            yield np.append(np.clip(wanted, -1.0, 1.0), effort).astype(np.float32)


@dataclass(frozen=True)
class Action:
    """A discrete action.

    Attributes:
        name: of the action.
        num_arguments: number of its parameters, distances in metres.
        reach: largest absolute value of a parameter, in metres; None if it is a setting.
        ticks: how much of an episode the action takes; a primitive takes `STEPS`.
    """

    name: str
    num_arguments: int
    reach: float | None = None
    ticks: int = STEPS


PRIMITIVES = (
    Action("move", 3),
    Action("grasp", 3),
    *(Action(name, 1) for name in ("lift", "drop", "left", "right", "forward", "backward")),
    Action("open", 0),
    Action("close", 0),
)
SMALL_POSITION_STEPS, LARGE_POSITION_STEPS = (
    tuple(Action(f"{size} step {fingers}", 3, steps * STEP_M, steps) for fingers in ("open", "closed"))
    for size, steps in (("small", SMALL_STEPS), ("large", LARGE_STEPS))
)

# Directions of the primitives along one axis, in x, y and z.
AXES = {
    "lift": (0, 0, 1),
    "drop": (0, 0, -1),
    "left": (-1, 0, 0),
    "right": (1, 0, 0),
    "forward": (0, 1, 0),
    "backward": (0, -1, 0),
}


def phases(action: Action, arguments: np.ndarray) -> tuple[Phase, ...]:
    """Return the phases of an action with these arguments, in metres.

    - `move`: by (x, y, z), with the fingers where they are, without force;
    - `grasp`: from above: open, move by y, by x, by z, close;
    - `lift`, `drop`, `left`, `right`, `forward`, `backward`: by a distance along one axis with closed fingers. A
      negative distance counts as 0;
    - `open`, `close`: the fingers;
    - `small step open`, `large step closed` and so on: the hand's target moves by (x, y, z) and the fingers open or
      close.

    Source: Dalal, Pathak and Salakhutdinov (2021), *Accelerating Robotic Reinforcement Learning via Parameterized
    Action Primitives*, NeurIPS, arXiv 2110.15360, and its code for Meta-World: names, phases, and 300 physics steps a
    phase (200 to open), which are 60 and 40 of Meta-World's steps.

    Differs from the source:

    - The control law is that of Meta-World's own policies, so the hand arrives. In the source, the hand's target is 5 %
      of the way ahead of the hand in each physics step. With MuJoCo 3.3, the hand then covers half of 20 cm.
    - In `move` the fingers stay. In the source, one of them follows a joint that is not its own.
    """
    x, y, z = (float(value) for value in arguments) if action.num_arguments == 3 else (0.0, 0.0, 0.0)
    if action in PRIMITIVES:
        if action.name == "grasp":
            return (
                Phase((0.0, 0.0, 0.0), _OPEN, OPENING_STEPS),
                Phase((0.0, y, 0.0), None),
                Phase((x, 0.0, 0.0), None),
                Phase((0.0, 0.0, z), None),
                Phase((0.0, 0.0, 0.0), _CLOSE),
            )
        if action.name == "move":
            return (Phase((x, y, z), None),)
        if action.name == "open":
            return (Phase((0.0, 0.0, 0.0), _OPEN, OPENING_STEPS),)
        if action.name == "close":
            return (Phase((0.0, 0.0, 0.0), _CLOSE),)
        distance = max(float(arguments[0]), 0.0)
        right, forward, up = (distance * part for part in AXES[action.name])
        return (Phase((right, forward, up), _CLOSE),)
    effort = _OPEN if action.name.endswith("open") else _CLOSE
    return (Phase((x, y, z), effort, action.ticks, is_direct=True),)
