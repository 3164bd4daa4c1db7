"""Compile the kernels of all problems, which takes half a minute; Numba keeps the machine code on disk.

`make test` does this while mypy runs on another core. Otherwise each process of the tests compiles what it meets.
"""

from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.boatdock_unseen.environment import UnseenBoatsEnv
from hpamdp.env.catch_point.environment import CatchPointEnv
from hpamdp.env.circuit.environment import CircuitEnv
from hpamdp.env.goal.environment import GoalEnv
from hpamdp.env.gym_hybrid.environment import MovingEnv
from hpamdp.env.hard_move.environment import HardMoveEnv
from hpamdp.env.office.environment import OfficeEnv
from hpamdp.env.pinball.environment import PinballEnv
from hpamdp.env.platform.environment import PlatformEnv

for problem in (
    BoatDockEnv, UnseenBoatsEnv, CatchPointEnv, CircuitEnv, GoalEnv, MovingEnv, HardMoveEnv, OfficeEnv, PinballEnv,
    PlatformEnv,
):  # fmt: skip
    problem(1).reset()
