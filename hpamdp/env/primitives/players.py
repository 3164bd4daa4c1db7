"""Hand-written players of primitives, one for each task, which see what the agent sees."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from hpamdp.env.primitives.manipulation import Manipulation
from hpamdp.env.primitives.options import Reward, Task

Choice = tuple[str, tuple[float, ...]]
"""A primitive's name and its arguments, in metres."""

# Mean returns by reward, and success, over the 20 episodes of the seeds 900 to 919, by `measure`.
MEASURED: dict[Task, dict[str, float]] = {
    "drawer_close": {"sparse": 4.25, "dense": 38.28, "success": 1.0},
    "soccer": {"sparse": 3.1, "dense": 34.14, "success": 1.0},
    "peg_unplug_side": {"sparse": 1.0, "dense": 11.03, "success": 1.0},
    "sweep_into": {"sparse": 3.5, "dense": 33.51, "success": 1.0},
    "assembly": {"sparse": 1.15, "dense": 16.95, "success": 1.0},
    "disassemble": {"sparse": 3.6, "dense": 34.22, "success": 0.9},
}

# The object is between the fingers if it is at most so far from its place there, along each axis.
_NEAR_M = np.array([0.05, 0.05, 0.08])
_ALIGNED_M = 0.02
_FAR_M = 0.3
# Where the hand is beside the object that it grasps, in metres.
_GRIPS = {
    "soccer": (0.0, 0.0, 0.03),
    "peg_unplug_side": (-0.02, 0.0, 0.035),
    "sweep_into": (-0.005, 0.0, 0.01),
    "assembly": (-0.02, 0.0, 0.03),
    "disassemble": (-0.02, 0.0, 0.02),
}
RING_FROM_HANDLE_M = (-0.13, 0.0, 0.0)
"""Offset of assembly's ring from the handle that the hand grasps, in metres."""


def choose(task: Task, observation: np.ndarray) -> Choice:
    """Return the primitive that the player of a task chooses after an observation float32 `[15]`."""
    held, goal = observation[4:7].astype(float), observation[11:14].astype(float)
    if task == "drawer_close":
        return _close_drawer(held)
    grip = np.array(_GRIPS[task])
    if (np.abs(held + grip) > _NEAR_M).any():
        return "grasp", tuple(held + grip)
    return _WITH_OBJECT[task](goal)


def _close_drawer(handle: np.ndarray) -> Choice:
    """Move in front of the handle, then push it."""
    right, forward, up = handle
    if abs(right) > _ALIGNED_M or forward < 0.0 or up < -_ALIGNED_M:
        return "move", (right, forward - 0.12, up - 0.02)
    return "forward", (_FAR_M,)


def _unplug(goal: np.ndarray) -> Choice:
    return "right", (_FAR_M,)


def _shoot(goal: np.ndarray) -> Choice:
    right, forward, _ = goal
    return _sideways(right) if abs(right) > _ALIGNED_M else _lengthways(forward)


def _sweep(goal: np.ndarray) -> Choice:
    right, forward, _ = goal
    return _lengthways(forward) if abs(forward) > 2.0 * _ALIGNED_M else _sideways(right)


def _assemble(goal: np.ndarray) -> Choice:
    right, forward, up = goal - np.array(RING_FROM_HANDLE_M)
    if max(abs(right), abs(forward)) <= _ALIGNED_M:
        return "drop", (_FAR_M,)
    if up > 0.0:
        return "lift", (0.2,)
    return _lengthways(forward) if abs(forward) > _ALIGNED_M else _sideways(right)


def _disassemble(goal: np.ndarray) -> Choice:
    return "lift", (_FAR_M,)


_WITH_OBJECT: dict[Task, Callable[[np.ndarray], Choice]] = {
    "soccer": _shoot,
    "peg_unplug_side": _unplug,
    "sweep_into": _sweep,
    "assembly": _assemble,
    "disassemble": _disassemble,
}


def _sideways(right: float) -> Choice:
    return ("right", (right,)) if right > 0.0 else ("left", (-right,))


def _lengthways(forward: float) -> Choice:
    return ("forward", (forward,)) if forward > 0.0 else ("backward", (-forward,))


def as_action(env: Manipulation, choice: Choice) -> tuple[np.int64, tuple[np.ndarray, ...]]:
    """Return a choice in the environment's action space; the arguments of other discrete actions are 0."""
    name, arguments = choice
    number = [action.name for action in env.actions].index(name)
    parameters = [np.zeros(action.num_arguments, np.float32) for action in env.actions]
    parameters[number] = np.array(arguments, np.float32)
    return np.int64(number), tuple(parameters)


def measure(task: Task, seeds: Iterable[int], reward: Reward = "sparse") -> dict[str, float]:
    """Play one episode for each seed and return the mean return, success and number of low-level steps."""
    env = Manipulation(task, reward=reward)
    episodes = []
    for seed in seeds:
        observation, _ = env.reset(seed=seed)
        is_over, total, num_steps = False, 0.0, 0
        while not is_over:
            observation, earned, is_over, _, info = env.step(as_action(env, choose(task, observation)))
            total += earned
            num_steps += info["low_level_steps"]
        episodes.append((total, info["is_success"], num_steps))
    env.close()
    score, success, low_level_steps = (float(mean) for mean in np.mean(episodes, axis=0))
    return {"score": score, "success": success, "low_level_steps": low_level_steps}
