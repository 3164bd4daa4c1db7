"""Thirty action spaces, what they are read as, and a Gymnasium environment that refuses actions outside of them."""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, OneOf, Tuple


class Tree(NamedTuple):
    """An action space and what it is read as.

    Attributes:
        space: the space.
        sizes: number of discrete actions of each component, also of a single one.
        dims: number of parameters of each discrete action.
        whole: numbers of the parameters that are whole.
        form: `env.action_form`.
    """

    space: spaces.Space
    sizes: tuple[int, ...]
    dims: tuple[int, ...]
    whole: tuple[int, ...] = ()
    form: str = "auto"

    @property
    def component_sizes(self) -> tuple[int, ...]:
        """As `PAMDPEnv.component_sizes`."""
        return self.sizes if len(self.sizes) > 1 else ()

    @property
    def integer_parameters(self) -> tuple[bool, ...]:
        """As `PAMDPEnv.integer_parameters`."""
        return tuple(number in self.whole for number in range(sum(self.dims))) if self.whole else ()


UNIT = Box(-1.0, 1.0, (1,))
PAIR = Box(np.float32([0.0, 10.0]), np.float32([1.0, 30.0]))
GRID = Box(-2.0, 3.0, (2, 2), np.float64)
NONE = Box(0.0, 1.0, (0,))
COUNTS = Box(2, 5, (2,), np.int64)
SCALAR = Box(0.5, 1.5, ())
LATE = Box(1.7e9, 1.7e9 + 3600.0, (1,), np.float64)
ORDER = Tuple([UNIT, Discrete(10), PAIR])

TREES: dict[str, Tree] = {
    # One choice with parameters of its own.
    "nested": Tree(Tuple([Discrete(3), Tuple([UNIT, NONE, PAIR])]), (3,), (1, 0, 2)),
    "flat": Tree(Tuple([Discrete(2, start=4), GRID, SCALAR]), (2,), (4, 1)),
    "shared": Tree(Tuple([Discrete(2), PAIR]), (2,), (2, 2)),
    "named": Tree(Dict(kind=Discrete(2, start=-1), by=Dict(go2=UNIT, at1=PAIR)), (2,), (2, 1)),
    "one of": Tree(OneOf([UNIT, Box(0.0, 1.0, (2,), np.float16)]), (2,), (1, 2)),
    "orders": Tree(Tuple([Discrete(3), ORDER]), (3,), (1, 1, 2), (1,)),
    "counted boxes": Tree(Tuple([Discrete(2), COUNTS, UNIT]), (2,), (2, 1), (0, 1)),
    "shared counts": Tree(Dict(what=Discrete(2), many=COUNTS), (2,), (2, 2), (0, 1, 2, 3)),
    "one of trees": Tree(
        OneOf([Discrete(3, start=1), Tuple([UNIT, MultiBinary(2)]), Dict(n=MultiDiscrete([2, 1, 4]), x=PAIR)]),
        (3,),
        (1, 3, 4),
        (0, 2, 3, 4, 5),
    ),
    "one of in one of": Tree(OneOf([OneOf([UNIT, PAIR]), Discrete(2)]), (2,), (4, 1), (0, 4)),
    "late": Tree(Tuple([Discrete(2), Tuple([LATE, Box(2**30, 2**30 + 3, (1,), np.int32)])]), (2,), (1, 1), (1,)),
    # One component without a choice, or without parameters.
    "box": Tree(GRID, (1,), (4,)),
    "counts": Tree(COUNTS, (1,), (2,), (0, 1)),
    "bytes": Tree(Box(0, 255, (3,), np.uint8), (1,), (3,), (0, 1, 2)),
    "flags": Tree(Box(0, 1, (2,), np.bool_), (1,), (2,), (0, 1)),
    "scalar": Tree(SCALAR, (1,), (1,)),
    "discrete": Tree(Discrete(4, start=2), (4,), (0, 0, 0, 0)),
    "alone": Tree(Tuple([Discrete(3)]), (3,), (0, 0, 0)),
    # Several components.
    "two discretes": Tree(Tuple([Discrete(2), Discrete(3, start=5)]), (2, 3), (0,) * 5),
    "discretes and a box": Tree(Tuple([Discrete(2), Discrete(3), PAIR]), (2, 3, 1), (0, 0, 0, 0, 0, 2)),
    "multi discrete": Tree(MultiDiscrete([2, 3, 2], start=[0, 1, -1]), (2, 3, 2), (0,) * 7),
    "matrix of discretes": Tree(MultiDiscrete([[2, 3], [4, 1]]), (2, 3, 4, 1), (0,) * 10),
    "multi binary": Tree(MultiBinary([2, 2]), (2, 2, 2, 2), (0,) * 8),
    "multi discrete and a box": Tree(Dict(a=MultiDiscrete([3, 2]), b=UNIT), (3, 2, 1), (0, 0, 0, 0, 0, 1)),
    "two choices": Tree(
        Dict(arm=Tuple([Discrete(2), Tuple([UNIT, NONE])]), leg=Tuple([Discrete(3), UNIT, PAIR, NONE])),
        (2, 3),
        (1, 0, 1, 2, 0),
    ),
    "choice beside a choice": Tree(
        Dict(van=Discrete(2), way=Tuple([Discrete(3), Tuple([UNIT, NONE, PAIR])])), (2, 3), (0, 0, 1, 0, 2)
    ),
    "two boxes": Tree(Dict(a=PAIR, b=COUNTS), (1, 1), (2, 2), (2, 3)),
    "choice and an order": Tree(
        Tuple([OneOf([UNIT, NONE]), Tuple([Discrete(2), Tuple([COUNTS, Discrete(7)])]), MultiBinary(1)]),
        (2, 2, 2),
        (1, 0, 2, 1, 0, 0),
        (1, 2, 3),
    ),
    "deep": Tree(
        Dict(a=Tuple([Dict(b=Discrete(2), c=Tuple([UNIT, UNIT, UNIT]))]), d=Tuple([Tuple([Discrete(5)])])),
        (2, 1, 1, 1, 5),
        (0, 0, 1, 1, 1, 0, 0, 0, 0, 0),
    ),
    "independent box": Tree(Tuple([Discrete(2), PAIR]), (2, 1), (0, 0, 2), form="components"),
    "many whole numbers": Tree(
        Tuple([Discrete(2), Box(-(2**30), 2**30, (1,), np.int64), UNIT, UNIT]), (2, 1, 1, 1), (0, 0, 1, 1, 1)
    ),
}


class Recorder(gymnasium.Env):
    """Refuse actions outside the space, and record the others; observe a random number.

    Args:
        tree: name of the action space, from TREES.
    """

    def __init__(self, tree: str = "nested"):
        self.action_space = TREES[tree].space
        self.observation_space = Box(-1.0, 1.0, (2,))
        self.actions: list[Any] = []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._observation(), {}

    def step(self, action):
        assert self.action_space.contains(action), action
        self.actions.append(action)
        return self._observation(), 0.0, False, False, {}

    def _observation(self):
        return self.np_random.uniform(-1.0, 1.0, 2).astype(np.float32)
