"""Checks of layouts that a user passes to `reset`."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hpamdp.env.boatdock.options import BoatDockOptions
from hpamdp.env.boatdock.task import CENTRE, DOCK_RADIUS, HARBOUR_RADIUS


def layout_columns(given: Mapping[str, np.ndarray], num_envs: int, rules: BoatDockOptions) -> dict[str, np.ndarray]:
    """Check a layout and return the columns `[N]` of the state that it sets.

    Args:
        given: `start` and `goal` `[N, 2]` in screen px and, optionally, `controller` and `keymap` `[N]`.
        num_envs: number of environments N.
        rules: rules of the environment. If the agent chooses the controller, the layout must not contain one.

    Raises:
        ValueError: an entry has the wrong shape or an invalid value.
    """
    points = {}
    for name in ("start", "goal"):
        point = given.get(name)
        if point is None or point.shape != (num_envs, 2):
            shape = None if point is None else list(point.shape)
            raise ValueError(f"reset: {name} has shape {shape}, but must be [{num_envs}, 2] (screen px)")
        points[name] = point.astype(np.float32) - np.array(CENTRE, np.float32)
        if not (np.linalg.norm(points[name], axis=-1) < HARBOUR_RADIUS).all():
            radius = f"{HARBOUR_RADIUS:g} px"
            raise ValueError(f"reset: a {name} lies outside the harbour: centre {CENTRE}, radius {radius}")
    start, goal = points["start"], points["goal"]
    if not (np.linalg.norm(start - goal, axis=-1) > DOCK_RADIUS).all():
        raise ValueError(f"reset: a start lies within the dock's {DOCK_RADIUS:g} px of its goal")
    columns = {"start_x": start[:, 0], "start_y": start[:, 1], "goal_x": goal[:, 0], "goal_y": goal[:, 1]}
    columns |= {"x": start[:, 0], "y": start[:, 1]}
    for name, first, last in (("controller", 0, len(rules.names) - 1), ("keymap", 1, 2)):
        value = given.get(name)
        if value is None:
            continue
        if name == "controller" and rules.controller == "choose":
            raise ValueError('reset: controller is given, but with controller="choose" it comes from the option')
        if name == "keymap" and rules.boats is not None:
            raise ValueError("reset: keymap is given, but with boats=... each boat has its keys")
        if value.shape != (num_envs,) or not np.isin(value, range(first, last + 1)).all():
            between = "or" if last == first + 1 else "to"
            raise ValueError(f"reset: {name} must be {first} {between} {last} in shape [{num_envs}]")
        columns[name] = value.astype(np.int32)
    return columns
