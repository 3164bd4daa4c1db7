"""A session of trips as pure functions on columns: how it starts, a press, the observation.

The package has these rules in a kernel alone. `tests/test_boatdock_unseen.py` compares the kernel with these functions.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from hpamdp.env import counter_rng
from hpamdp.env.batched_env import Action
from hpamdp.env.boatdock import harbour, physics
from hpamdp.env.boatdock.harbour import Layout
from hpamdp.env.boatdock.task import (
    DOCK_RADIUS,
    FAILURE_REWARD,
    HARBOUR_RADIUS,
    MAX_DURATION,
    MAX_PRESSES,
    NOT_CHOSEN,
    NUM_KEYS,
    SAILING,
    SPEED_SCALE,
    SUCCESS,
    SUCCESS_REWARD,
    TANK,
    TIME_LIMIT,
    RewardForm,
)
from hpamdp.env.boatdock_unseen import fleet
from hpamdp.env.boatdock_unseen.environment import UnseenBoatsEnv
from hpamdp.env.boatdock_unseen.options import FleetRules
from hpamdp.env.boatdock_unseen.rules import (
    _SHORTEST_AXIS,
    FINISHED,
    FIRST_BOAT,
    FLEET,
    GOING_ON,
    MOTOR,
    NUMBERS_PER_PRESS,
    SENSOR,
    SessionState,
)
from hpamdp.env.counter_rng import RngKey
from hpamdp.env.rng_streams import EVALUATION, TRAINING


class TensorSessions(UnseenBoatsEnv):
    """Sessions that the functions below move."""

    row_kernel = None

    def _prepare(self) -> None:
        super()._prepare()
        options = self.options
        self.rules = SessionRules(
            options.fleet,
            options.trips,
            options.reward,
            options.motor_noise,
            options.sensor_noise,
            options.frame == "first_press",
        )
        self._fleet_seed = counter_rng.seed_tensor(options.fleet_seed, self.device)

    def start(self, episode: Tensor, rng: RngKey) -> SessionState:
        """Return the states at the start of sessions."""
        layout = harbour.sample_layout(self._session_rng(episode, 0))
        return start(episode, layout, self._draw_boats(episode), has_choice=self._chooses)

    def act(self, state: SessionState, action: Action, rng: RngKey, is_idle: Tensor) -> tuple[SessionState, Tensor]:
        """Return the states after one press, and the rewards `[N]`."""
        next_layout = harbour.sample_layout(self._session_rng(state.episode, state.trip + 1))
        duration = action.parameters.squeeze(-1)
        return act(state, action.option, action.discrete, duration, next_layout=next_layout, rng=rng, rules=self.rules)

    def observe(self, state: SessionState) -> Tensor:
        """Return the observations, `[N, 22]`."""
        rng = self._noise_rng(state) if self.rules.sensor_noise > 0.0 else None
        return observe(state, rng, self.rules)

    def extras(self, state: SessionState) -> Sequence[Tensor]:
        """Return the entries `extra_names`."""
        trips = self.options.trips
        return state.trip_ended.to(torch.bool), state.total_score / trips, state.docked.to(torch.float32) / trips

    def _draw_boats(self, episode: Tensor) -> tuple[Tensor, Tensor]:
        """Return the bits of both boats of each session, int32 `[N]` each. Those of training are even, others odd."""
        first, second = (self._session_rng(episode, FIRST_BOAT + number) for number in range(2))
        if self._streams[0] == EVALUATION and self.options.scored_boats == "new":
            return first.bits | 1, second.bits | 1
        size = self.options.fleet_size
        if size is None:
            return first.bits & -2, second.bits & -2
        number = (counter_rng.uniform(first, 0) * size).to(torch.int32).clamp(max=size - 1)
        beside = (counter_rng.uniform(first, 1) * (size - 1)).to(torch.int32).clamp(max=max(size - 2, 0))
        other = (number + 1 + beside) % size
        fleet_key = torch.full_like(episode, FLEET)
        drawn = (counter_rng.rng_key(self._fleet_seed, TRAINING, each, fleet_key).bits & -2 for each in (number, other))
        return next(drawn), next(drawn)


class SessionRules(NamedTuple):
    """The rules of sessions. The settings of UnseenBoatsEnv explain the fields."""

    fleet: FleetRules = FleetRules()
    trips: int = 8
    reward: RewardForm = "paper"
    motor_noise: float = 0.0
    sensor_noise: float = 0.0
    has_own_frame: bool = False  # frame=first_press


def start(episode: Tensor, layout: Layout, boats: tuple[Tensor, Tensor], *, has_choice: bool) -> SessionState:
    """Return the states at the start of sessions.

    Args:
        episode: numbers of the sessions, int32 `[N]`.
        layout: layouts of their first trips.
        boats: bits of the first and of the second boat, int32 `[N]` each.
        has_choice: whether the agent chooses between the two.
    """
    zeros, none = torch.zeros_like(layout.start_x), torch.zeros_like(episode)
    return SessionState(
        *layout,
        x=layout.start_x,
        y=layout.start_y,
        velocity_x=zeros,
        velocity_y=zeros,
        fuel=zeros + TANK,
        moved_x=zeros,
        moved_y=zeros,
        last_duration=zeros,
        last_score=zeros,
        total_score=zeros,
        frame_x=zeros,
        frame_y=zeros,
        first_boat=boats[0],
        second_boat=boats[1],
        boat=none + (NOT_CHOSEN if has_choice else 0),
        last_boat=none + NOT_CHOSEN,
        last_key=none - 1,
        trip=none,
        presses=none,
        docked=none,
        trip_ended=none,
        steps=none,
        outcome=none + GOING_ON,
        episode=episode,
    )


def act(
    state: SessionState,
    option: Tensor | None,
    key: Tensor,
    duration: Tensor,
    *,
    next_layout: Layout,
    rng: RngKey,
    rules: SessionRules,
) -> tuple[SessionState, Tensor]:
    """Return the sessions after a press, as if none were over, and the rewards `[N]`.

    Args:
        state: states before the press.
        option: chosen boats, integers `[N]`, which count at a trip's first press. None if there is one boat.
        key: 0, 1 or 2, integers `[N]`.
        duration: seconds of the press, `[N]`.
        next_layout: layouts of the next trips.
        rng: random-number keys of the noise, `[N]`.
        rules: rules of the sessions.
    """
    key = key.to(torch.int32)
    boat = state.boat if option is None else torch.where(state.boat == NOT_CHOSEN, option.to(torch.int32), state.boat)
    if rules.motor_noise > 0.0:
        index = state.steps * (NUMBERS_PER_PRESS // 2) + MOTOR
        duration = (duration * (rules.motor_noise * counter_rng.normal(rng, index)).exp()).clamp(max=MAX_DURATION)
    bits = torch.where(boat == 1, state.second_boat, state.first_boat)
    dir_x, dir_y = fleet.direction(bits, key, rules.fleet)
    strength, glide = fleet.strength_and_glide(bits, rules.fleet)
    pressed = physics.press(
        state.x,
        state.y,
        state.fuel,
        state.goal_x,
        state.goal_y,
        dir_x,
        dir_y,
        duration,
        strength=strength,
        glide=glide,
    )
    is_late = (state.presses + 1 >= MAX_PRESSES) & (pressed.outcome == SAILING)
    outcome = torch.where(is_late, TIME_LIMIT, pressed.outcome)
    ends, docks = outcome != SAILING, outcome == SUCCESS
    score = harbour.score(outcome, pressed.fuel / TANK)
    at_start = harbour.separation(_layout(state))
    final = torch.where(docks, SUCCESS_REWARD * pressed.fuel / TANK, 0.0)
    if rules.reward == "sparse":
        reward = final
    else:
        failed = (outcome > SUCCESS) & (outcome < TIME_LIMIT)
        before = _distance(state.x, state.y, state)
        progress = (before - _distance(pressed.x, pressed.y, state)) / at_start
        reward = progress + torch.where(failed, FAILURE_REWARD, final)
    is_last = state.trip + 1 >= rules.trips
    begins = ends & ~is_last
    zeros = torch.zeros_like(state.x)
    moved_x, moved_y = pressed.x - state.x, pressed.y - state.y
    frame_x, frame_y = _seen_displacement(moved_x, moved_y, state.steps + 1, rng, rules)
    is_first = state.last_key < 0
    start_x, start_y, goal_x, goal_y = (
        torch.where(begins, new, old) for new, old in zip(next_layout, _layout(state), strict=True)
    )
    after = SessionState(
        start_x=start_x,
        start_y=start_y,
        goal_x=goal_x,
        goal_y=goal_y,
        x=torch.where(begins, next_layout.start_x, pressed.x),
        y=torch.where(begins, next_layout.start_y, pressed.y),
        velocity_x=pressed.speed * dir_x,
        velocity_y=pressed.speed * dir_y,
        fuel=torch.where(begins, TANK, pressed.fuel),
        moved_x=moved_x,
        moved_y=moved_y,
        last_duration=duration + zeros,
        last_score=torch.where(ends, score, state.last_score),
        total_score=state.total_score + torch.where(ends, score, 0.0),
        frame_x=torch.where(is_first, frame_x, state.frame_x),
        frame_y=torch.where(is_first, frame_y, state.frame_y),
        first_boat=state.first_boat,
        second_boat=state.second_boat,
        boat=boat if option is None else torch.where(begins, NOT_CHOSEN, boat),
        last_boat=boat,
        last_key=key,
        trip=state.trip + begins.to(torch.int32),
        presses=torch.where(begins, 0, state.presses + 1),
        docked=state.docked + docks.to(torch.int32),
        trip_ended=ends.to(torch.int32),
        steps=state.steps + 1,
        outcome=torch.where(ends & is_last, FINISHED, GOING_ON).to(torch.int32),
        episode=state.episode,
    )
    return after, reward


def observe(state: SessionState, rng: RngKey | None, rules: SessionRules) -> Tensor:
    """Return the observations, float32 `[N, 22]`, with the entries OBSERVATION_NAMES.

    Args:
        state: states of the sessions.
        rng: random-number keys of the noise, `[N]`. None if the sensors have no noise.
        rules: rules of the sessions.
    """
    seen = [state.start_x, state.start_y, state.goal_x, state.goal_y, state.x, state.y]
    moved = [state.moved_x, state.moved_y]
    if rng is not None:
        first = state.steps * (NUMBERS_PER_PRESS // 2) + SENSOR
        seen = [each + rules.sensor_noise * counter_rng.normal(rng, first + i) for i, each in enumerate(seen)]
        noisy = _seen_displacement(state.moved_x, state.moved_y, state.steps, rng, rules)
        moved = [torch.where(state.last_key >= 0, each, 0.0) for each in noisy]
    velocity_x, velocity_y = state.velocity_x * (1.0 / SPEED_SCALE), state.velocity_y * (1.0 / SPEED_SCALE)
    start_x, start_y, goal_x, goal_y, x, y, moved_x, moved_y = (each * (1.0 / HARBOUR_RADIUS) for each in seen + moved)
    if rules.has_own_frame:
        is_known = (state.frame_x != 0.0) | (state.frame_y != 0.0)
        axis_x = torch.where(is_known, state.frame_x, goal_x - start_x)
        axis_y = torch.where(is_known, state.frame_y, goal_y - start_y)
        length = (axis_x.square() + axis_y.square()).sqrt().clamp(min=_SHORTEST_AXIS)
        cosine, sine = axis_x / length, axis_y / length
        pairs = ((start_x, start_y), (goal_x, goal_y), (x, y), (moved_x, moved_y), (velocity_x, velocity_y))
        (start_x, start_y), (goal_x, goal_y), (x, y), (moved_x, moved_y), (velocity_x, velocity_y) = (
            (a * cosine + b * sine, b * cosine - a * sine) for a, b in pairs
        )
    to_goal_x, to_goal_y = goal_x - x, goal_y - y
    # The clamp is needed because sensor noise can bring start and goal together.
    at_start = (
        ((goal_x - start_x).square() + (goal_y - start_y).square()).sqrt().clamp(min=DOCK_RADIUS / HARBOUR_RADIUS)
    )
    columns = [
        start_x,
        start_y,
        goal_x,
        goal_y,
        x,
        y,
        to_goal_x,
        to_goal_y,
        state.fuel / TANK,
        (to_goal_x.square() + to_goal_y.square()).sqrt() / at_start,
        velocity_x,
        velocity_y,
        state.trip.to(torch.float32) / rules.trips,
        state.boat.to(torch.float32),
        state.last_boat.to(torch.float32),
        *((state.last_key == key).to(torch.float32) for key in range(NUM_KEYS)),
        state.last_duration / MAX_DURATION,
        moved_x,
        moved_y,
        state.last_score / SUCCESS_REWARD,
    ]
    return torch.stack(columns, -1)


def _seen_displacement(
    moved_x: Tensor, moved_y: Tensor, steps: Tensor, rng: RngKey, rules: SessionRules
) -> tuple[Tensor, Tensor]:
    """Return the displacement by a session's press number `steps` as it is seen, px `[N]` each."""
    if rules.sensor_noise == 0.0:
        return moved_x, moved_y
    first = steps * (NUMBERS_PER_PRESS // 2) + SENSOR + 6
    return (
        moved_x + rules.sensor_noise * counter_rng.normal(rng, first),
        moved_y + rules.sensor_noise * counter_rng.normal(rng, first + 1),
    )


def _layout(state: SessionState) -> Layout:
    return Layout(state.start_x, state.start_y, state.goal_x, state.goal_y)


def _distance(x: Tensor, y: Tensor, state: SessionState) -> Tensor:
    """Return the distance of a point from the goal, px `[N]`."""
    return ((state.goal_x - x).square() + (state.goal_y - y).square()).sqrt()
