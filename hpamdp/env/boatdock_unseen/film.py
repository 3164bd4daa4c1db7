"""Films of a session: its trips one after another, as the boats' task shows them. Viewers see where the keys push."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from hpamdp.env.boatdock import film as boat_film
from hpamdp.env.boatdock import physics, task
from hpamdp.env.boatdock.film import Engine
from hpamdp.env.boatdock_unseen import fleet
from hpamdp.env.boatdock_unseen.options import UnseenBoatsOptions
from hpamdp.env.boatdock_unseen.rules import SessionState


def film(
    track: Sequence[Mapping[str, Tensor]], fps: float, size: int, options: UnseenBoatsOptions
) -> Iterator[np.ndarray]:
    """Yield the pictures of one session, uint8 `[size, size, 3]` each.

    Args:
        track: the states at the start and after every press, columns `[1]`.
        fps: pictures per second.
        size: width and height of a picture, px.
        options: settings of the sessions.
    """
    states = [SessionState(*(columns[name] for name in SessionState._fields)) for columns in track]
    trip: list[SessionState] = [states[0]]
    for before, after in itertools.pairwise(states):
        if after.steps.item() == before.steps.item():
            break
        trip.append(after)
        if after.trip_ended.item():
            yield from _trip(trip, fps, size, options)
            trip = [after]
    if len(trip) > 1 or len(states) == 1:
        yield from _trip(trip, fps, size, options)


def _trip(states: Sequence[SessionState], fps: float, size: int, options: UnseenBoatsOptions) -> Iterator[np.ndarray]:
    """Yield the pictures of one trip, from the states at its start and after each of its presses."""
    boat = int(states[-1].last_boat) if len(states) > 1 else 0
    own = fleet.boats(states[0].second_boat if boat == 1 else states[0].first_boat, options.fleet)
    degrees = torch.rad2deg(torch.atan2(own.directions[0, :, 1], own.directions[0, :, 0])).tolist()
    name = f"trip {int(states[0].trip) + 1} of {options.trips}"
    name += f", boat {boat + 1}" if options.boats > 1 else ""
    shown = task.Boats((name,), (tuple(degrees),))
    track = [_as_boat(states[0])]
    for after in states[1:]:
        track.append(_pressed(track[-1], after, own))
    columns = [{key: column.double() for key, column in state._asdict().items()} for state in track]
    yield from boat_film.film(columns, fps, size, shown, engine=Engine(own.strength.item(), own.glide.item()))


def _as_boat(state: SessionState) -> task.BoatState:
    """Return the state of a trip's boat, as the task has it."""
    none = torch.zeros_like(state.boat)
    return task.BoatState(
        *(state.start_x, state.start_y, state.goal_x, state.goal_y, state.x, state.y, state.velocity_x),
        velocity_y=state.velocity_y,
        fuel=state.fuel,
        controller=none,
        keymap=none + 1,
        presses=state.presses,
        outcome=none + task.SAILING,
        episode=state.episode,
    )


def _pressed(before: task.BoatState, after: SessionState, boat: fleet.Boats) -> task.BoatState:
    """Return the boat after a press, which a session's state does not show if the press ended the trip."""
    direction = boat.directions[torch.arange(1), after.last_key.long()]
    press = physics.press(
        *(before.x, before.y, before.fuel, before.goal_x, before.goal_y, direction[:, 0], direction[:, 1]),
        after.last_duration,
        strength=boat.strength,
        glide=boat.glide,
    )
    presses = before.presses + 1
    is_late = (press.outcome == task.SAILING) & (presses >= task.MAX_PRESSES)
    return before._replace(
        x=press.x,
        y=press.y,
        velocity_x=press.speed * direction[:, 0],
        velocity_y=press.speed * direction[:, 1],
        fuel=press.fuel,
        presses=presses,
        outcome=torch.where(is_late, task.TIME_LIMIT, press.outcome),
    )
