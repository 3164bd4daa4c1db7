"""Films of an episode. The boat moves between the states before and after a press by the task's own closed forms."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from hpamdp.env.boatdock import harbour, physics, rendering
from hpamdp.env.boatdock.rendering import Leg, Scene
from hpamdp.env.boatdock.task import MAX_PRESSES, Boats, BoatState


class Engine(NamedTuple):
    """How a boat moves, as multiples of people's boats; see `physics.press`."""

    strength: float = 1.0
    glide: float = 1.0


def film(
    track: Sequence[Mapping[str, Tensor]],
    fps: float,
    size: int,
    boats: Boats | None = None,
    switch_cost: float | None = None,
    engine: Engine | None = None,
) -> Iterator[np.ndarray]:
    """Yield the pictures of one episode, uint8 `[size, size, 3]` each, from its start to its end.

    Args:
        track: the states at the start and after every press, columns `[1]`. Columns outside `BoatState` are ignored.
        fps: pictures per second.
        size: width and height of a picture, px.
        boats: boats of the environment. If None, people's two.
        switch_cost: fuel (s) of a change of boats. If None, there is none.
        engine: how the boat moves. If None, as people's boats.
    """
    engine = Engine() if engine is None else engine
    states = [BoatState(*(columns[name].double() for name in BoatState._fields)) for columns in track]
    scene = _scene(states[0], states[min(1, len(states) - 1)], boats)
    yield rendering.draw(scene, size)
    late = 0.0  # seconds from the end of the last press to the next picture
    for before, after in itertools.pairwise(states):
        if before.outcome.item() != physics.SAILING:
            break
        before = before._replace(fuel=rendering.fuel_at_press(before, after, switch_cost))
        length = math.hypot((after.x - before.x).item(), (after.y - before.y).item())
        burnt = (before.fuel - after.fuel).clamp(min=0.0)  # how long the key was down
        seconds = physics.time_at(burnt, burnt.new_tensor([length]), *engine).item()
        times = np.arange(late, seconds, 1.0 / fps)
        for time in times.tolist():
            yield rendering.draw(_underway(scene, before, after, burnt, length, time, engine), size)
        late += len(times) / fps - seconds
        scene = _rested(scene, before, after, engine)
    yield rendering.draw(scene, size)


def _scene(first: BoatState, second: BoatState, boats: Boats | None) -> Scene:
    """Return the scene before the first press, with the controller of that press."""
    return Scene(
        start=(first.start_x.item(), first.start_y.item()),
        goal=(first.goal_x.item(), first.goal_y.item()),
        boat=(first.x.item(), first.y.item()),
        fuel=first.fuel.item() / physics.TANK,
        controller=int(second.controller),
        keymap=int(first.keymap),
        boats=boats,
    )


def _underway(
    scene: Scene,
    before: BoatState,
    after: BoatState,
    burnt: Tensor,
    length: float,
    seconds: float,
    engine: Engine,
) -> Scene:
    """Return the scene `seconds` after the beginning of a press."""
    elapsed = burnt.new_tensor([seconds])
    fraction = min(physics.distance_at(burnt, elapsed, *engine).item() / length, 1.0) if length > 0.0 else 0.0
    start = (before.x.item(), before.y.item())
    end = (after.x.item(), after.y.item())
    boat = (start[0] + fraction * (end[0] - start[0]), start[1] + fraction * (end[1] - start[1]))
    pressed = engine.strength * physics.pressed_distance(torch.minimum(burnt, elapsed)).item()
    made = fraction * length
    leg = Leg(start, boat, min(pressed / made, 1.0) if made > 0.0 else 1.0)
    return replace(
        scene,
        boat=boat,
        heading=(end[0] - start[0], end[1] - start[1]),
        legs=(*scene.legs, leg),
        fuel=(before.fuel.item() - min(seconds, burnt.item())) / physics.TANK,
        presses=scene.presses + 1,
        controller=int(after.controller),
    )


def _rested(scene: Scene, before: BoatState, after: BoatState, engine: Engine) -> Scene:
    """Return the scene at the end of a press."""
    leg = rendering.leg(before, after, strength=engine.strength)
    outcome = int(after.outcome)
    is_over = outcome != physics.SAILING
    return replace(
        scene,
        boat=leg.end,
        heading=(after.velocity_x.item(), after.velocity_y.item()) if leg.start != leg.end else scene.heading,
        legs=(*scene.legs, leg),
        fuel=after.fuel.item() / physics.TANK,
        presses=min(scene.presses + 1, MAX_PRESSES),
        controller=int(after.controller),
        outcome=physics.OUTCOMES[outcome],
        score=harbour.score(after.outcome, after.fuel / physics.TANK).item() if is_over else None,
    )
