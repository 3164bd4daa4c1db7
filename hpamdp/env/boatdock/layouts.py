"""Layouts that a user gives."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hpamdp.env.boatdock.task import CENTRE, DOCK_RADIUS, HARBOUR_RADIUS


def layout_columns(given: Mapping[str, np.ndarray], num_envs: int, *, has_choice: bool) -> dict[str, np.ndarray]:
    """Check a layout and return the columns `[N]` of the state that it sets.

    Args:
        given: `start` and `goal` `[N, 2]` in screen px and, optionally, `controller` and `keymap` `[N]`.
        num_envs: N.
        has_choice: whether the agent chooses the controller, so that the layout may not.

    Raises:
        ValueError: an entry has another shape or a value that is not allowed.
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
    for name, allowed in (("controller", (0, 1)), ("keymap", (1, 2))):
        value = given.get(name)
        if value is None:
            continue
        if name == "controller" and has_choice:
            raise ValueError('reset: controller is given, but with controller="choose" it comes from the option')
        if value.shape != (num_envs,) or not np.isin(value, allowed).all():
            raise ValueError(f"reset: {name} must be {allowed[0]} or {allowed[1]} in shape [{num_envs}]")
        columns[name] = value.astype(np.int32)
    return columns
