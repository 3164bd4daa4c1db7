"""Small environments of every kind that GymnasiumEnv accepts; importing this module registers Toy-v0."""

from __future__ import annotations

import os
import signal
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces

# Three discrete actions with two, no and one parameter. Some bounds are not exact in float32; shapes and dtypes differ.
TWO = spaces.Box(np.array([-1.0, 10.0]), np.array([1.0, 30.0]), dtype=np.float64)
NONE = spaces.Box(0.0, 1.0, (0,))
ONE = spaces.Box(0.1, 0.3, (1, 1), dtype=np.float64)
ALL = spaces.Box(np.float32([-1.0, 10.0, 0.1]), np.float32([1.0, 30.0, 0.3]))
PAIR = spaces.Box(np.float32([[-1.0, 10.0]]), np.float32([[1.0, 30.0]]))

# Each form of action space, and the `parameter_dims` that it needs.
FORMS: dict[str, tuple[spaces.Space, list[int] | None]] = {
    "nested": (spaces.Tuple([spaces.Discrete(3), spaces.Tuple([TWO, NONE, ONE])]), None),
    "flat": (spaces.Tuple([spaces.Discrete(3, start=4), TWO, NONE, ONE]), None),
    "dict of tuple": (spaces.Dict(move=spaces.Discrete(3, start=-1), by=spaces.Tuple([TWO, NONE, ONE])), None),
    "dict of dict": (spaces.Dict(key=spaces.Discrete(3), of=spaces.Dict(a=TWO, b=NONE, c=ONE)), None),
    "flat dict": (spaces.Dict(key=spaces.Discrete(3), a=TWO, m=NONE, z=ONE), None),
    "numbered": (spaces.Dict(key=spaces.Discrete(3), of=spaces.Dict(turn1=NONE, wait10=ONE, xgo0=TWO)), None),
    "split": (spaces.Tuple([spaces.Discrete(3), ALL]), [2, 0, 1]),
    "split dict": (spaces.Dict(how=ALL, what=spaces.Discrete(3, start=7)), [2, 0, 1]),
    "shared": (spaces.Tuple([spaces.Discrete(3), PAIR]), None),
}


def native_action(form: str, discrete: int, values: np.ndarray):
    """Return the action in the space's own format, written out for each form.

    Args:
        form: of the action space, from FORMS.
        discrete: the discrete action, 0 to 2.
        values: the parameters of all discrete actions.
    """
    two = values[:2].astype(np.float64)
    none = np.zeros(0, np.float32)
    one = values[2:3, None].astype(np.float64)
    boxes = (two, none, one)
    k = np.int64(discrete)
    return {
        "nested": (k, boxes),
        "flat": (k + 4, *boxes),
        "dict of tuple": {"move": k - 1, "by": boxes},
        "dict of dict": {"key": k, "of": {"a": two, "b": none, "c": one}},
        "flat dict": {"key": k, "a": two, "m": none, "z": one},
        "numbered": {"key": k, "of": {"xgo0": two, "turn1": none, "wait10": one}},
        "split": (k, values),
        "split dict": {"how": values, "what": k + 7},
        "shared": (k, values[2 * discrete : 2 * discrete + 2][None]),
    }[form]


class Toy(gymnasium.Env):
    """Record every action; observe a random number and the number of steps.

    Args:
        form: of the action space, from FORMS.
        length: steps to the end; 0: it never ends.
        success: `is_success` of the last info; None: the info does not have it.
    """

    def __init__(self, form: str = "nested", length: int = 0, success: bool | None = None):
        self.action_space = FORMS[form][0]
        self.observation_space = spaces.Box(np.array([-3.0, 0.0]), np.array([5.0, np.inf]), dtype=np.float64)
        self.length = length
        self.success = success
        self.actions: list[Any] = []
        self.is_open = True

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self._observation(), {}

    def step(self, action):
        assert self.action_space.contains(action), action
        self.actions.append(action)
        self.steps += 1
        is_over = self.steps == self.length
        info = {"is_success": self.success} if is_over and self.success is not None else {}
        return self._observation(), np.float64(self.steps), is_over, False, info

    def close(self):
        self.is_open = False

    def _observation(self):
        return np.array([self.np_random.uniform(-3.0, 5.0), self.steps])


# The observations of Mixed: seven numbers when flattened.
MIXED = spaces.Tuple([spaces.Box(-2, 2, (2, 1)), spaces.Discrete(3, start=1), spaces.Dict(a=spaces.MultiBinary(2))])


class Mixed(Toy):
    """Observe samples of MIXED."""

    def __init__(self):
        super().__init__()
        self.observation_space = MIXED

    def _observation(self):
        return self.observation_space.sample()


class Texting(Toy):
    """Asks for a text in its actions."""

    def __init__(self):
        super().__init__()
        self.action_space = spaces.Tuple([spaces.Discrete(2), spaces.Text(5)])


class Drawn(Toy):
    """Draws a grey picture that grows lighter with every step; with `varies`, also larger by 40 px."""

    metadata: ClassVar = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, render_mode: str | None = None, is_wrong: bool = False, varies: bool = False):
        super().__init__()
        self.render_mode = render_mode
        self.is_wrong = is_wrong
        self.varies = varies

    def render(self):
        if self.is_wrong:
            return np.zeros((2, 2))
        width = 40 * (1 + self.steps) if self.varies else 600
        return np.full((width // 2, width, 3), 100 * self.steps % 256, np.uint8)


class Faulty(Toy):
    """Raises an error of its own somewhere, two calls deep."""

    def __init__(self, where: str):
        super().__init__()
        self.where = where
        self.perhaps("constructor")

    def perhaps(self, where: str) -> None:
        if self.where == where:
            self.fail()

    def fail(self) -> None:
        np.zeros(2).reshape(3)

    def reset(self, **arguments):
        self.perhaps("reset")
        return super().reset(**arguments)

    def step(self, action):
        self.perhaps("step")
        return super().step(action)

    def close(self):
        self.perhaps("close")


class Killed(Toy):
    """Is killed in its second step."""

    def step(self, action):
        if self.steps == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().step(action)


class TickingGoal(gymnasium.Env):
    """Has the spaces of gym-goal, and its counter of ticks, which leaves the space after 200 of them.

    Args:
        tick: of an episode's start.
    """

    def __init__(self, tick: int = 0):
        boxes = [spaces.Box(-np.ones(size, np.float32), np.ones(size, np.float32)) for size in (2, 1, 1)]
        self.action_space = spaces.Tuple([spaces.Discrete(3), spaces.Tuple(boxes)])
        state = spaces.Box(-np.ones(17), np.ones(17), dtype=np.float32)
        self.observation_space = spaces.Tuple([state, spaces.Discrete(200)])
        self.first = tick
        self.tick = tick

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Any, dict]:
        self.tick = self.first
        return (np.zeros(17, np.float32), self.tick), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict]:
        discrete, parameters = action
        self.tick += 1
        state = np.full(17, parameters[discrete][0] / 2.0, np.float32)
        return (state, self.tick), float(state[0]), self.tick >= self.first + 5, False, {}


def make_toy(**kwargs: Any) -> gymnasium.Env:
    return gymnasium.make("Toy-v0", **kwargs)


gymnasium.register("Toy-v0", entry_point=Toy, max_episode_steps=6)
gymnasium.register("Endless-v0", entry_point="toy_environments:Toy")
