"""One episode of the boats' task as pure functions on columns: a press, a new episode, the observation.

The package has these rules in a kernel alone. `tests/test_boat_kernel.py` compares the kernel with these functions.
Positions are px from the harbour's centre.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from hpamdp.env import counter_rng
from hpamdp.env.batched_env import Action
from hpamdp.env.boatdock import harbour, physics
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.boatdock.options import BoatDockOptions
from hpamdp.env.boatdock.task import (
    CENTRE,
    DOCK_RADIUS,
    FAILURE_REWARD,
    HARBOUR_RADIUS,
    INDEX_CONTROLLER,
    INDEX_KEYMAP,
    MAX_DURATION,
    MOTOR,
    NOT_CHOSEN,
    NUM_KEYS,
    NUMBERS_PER_PRESS,
    SAILING,
    SENSOR,
    SLIP,
    SLIPPED_KEY,
    SPEED_SCALE,
    SUCCESS,
    SUCCESS_REWARD,
    TANK,
    TIME_LIMIT,
    BoatState,
)
from hpamdp.env.counter_rng import RngKey


class TensorBoats(BoatDockEnv):
    """Boats that the functions below move."""

    row_kernel = None

    def start(self, episode: Tensor, rng: RngKey) -> BoatState:
        """Return the states of environments with new layouts."""
        return start(episode, rng, self.options)

    def act(self, state: BoatState, action: Action, rng: RngKey, is_idle: Tensor) -> tuple[BoatState, Tensor]:
        """Return the states after one press, and the rewards `[N]`."""
        return act(state, action.option, action.discrete, action.parameters.squeeze(-1), rng, self.options)

    def observe(self, state: BoatState) -> Tensor:
        """Return the observations, `[N, 16]`, or `[N, 14]` in pixels."""
        return observe(state, self._noise_rng(state) if self.options.sensor_noise > 0.0 else None, self.options)

    def extras(self, state: BoatState) -> Sequence[Tensor]:
        """Return the fraction of fuel that is left."""
        return (state.fuel / TANK,)


def direction_of(rules: BoatDockOptions, controller: Tensor, keymap: Tensor, key: Tensor) -> tuple[Tensor, Tensor]:
    """Return the unit direction (x, y) of a key with the boats of these rules, each `[*B]` float32.

    The other arguments are those of `harbour.direction`.
    """
    own = rules.own_boats
    if own is None:
        return harbour.direction(controller, keymap, key)
    row = controller * NUM_KEYS + key
    every = [each for keys in own.directions for each in keys]
    x, y = (torch.full(row.shape, each, device=row.device, dtype=torch.float32) for each in every[0])
    # As in `harbour.direction`, there is no gather.
    for number, (key_x, key_y) in enumerate(every[1:], start=1):
        x, y = torch.where(row == number, key_x, x), torch.where(row == number, key_y, y)
    return x, y


def start(episode: Tensor, rng: counter_rng.RngKey, rules: BoatDockOptions) -> BoatState:
    """Return the boats at the start of episodes.

    Args:
        episode: numbers of the episodes, int32 `[N]`.
        rng: random-number keys `[N]`, for the layouts, and for a random controller and key map.
        rules: rules of the environment.
    """
    layout = harbour.sample_layout(rng)
    zeros = torch.zeros_like(layout.start_x)
    integer_zeros = torch.zeros_like(episode)
    if rules.controller == "random":
        num = len(rules.names)
        # The smallest numbers give the last boat. This keeps the draws of earlier versions, which had two boats and
        # gave the second one for numbers under a half.
        drawn = (counter_rng.uniform(rng, INDEX_CONTROLLER) * num).to(torch.int32)
        controller = (num - 1 - drawn).clamp(min=0)
    elif rules.controller == "choose":
        controller = integer_zeros + NOT_CHOSEN
    else:
        controller = integer_zeros + rules.names.index(rules.controller)
    if rules.keymap == "random":
        keymap = 1 + (counter_rng.uniform(rng, INDEX_KEYMAP) < 0.5).to(torch.int32)
    else:
        keymap = integer_zeros + rules.keymap
    return BoatState(
        *layout,
        x=layout.start_x,
        y=layout.start_y,
        velocity_x=zeros,
        velocity_y=zeros,
        fuel=zeros + TANK,
        controller=controller,
        keymap=keymap,
        presses=integer_zeros,
        outcome=integer_zeros + SAILING,
        episode=episode,
    )


def act(
    state: BoatState,
    option: Tensor | None,
    key: Tensor,
    duration: Tensor,
    rng: counter_rng.RngKey,
    rules: BoatDockOptions,
) -> tuple[BoatState, Tensor]:
    """Return the boats after a press, as if no episode were over, and the rewards `[N]`.

    Args:
        state: states before the press.
        option: chosen controllers, integers `[N]`. They count for boats without a controller or, with a `switch_cost`,
            for all boats. None if the agent does not choose.
        key: 0, 1 or 2, integers `[N]`.
        duration: seconds in [0, MAX_DURATION], `[N]`.
        rng: random-number keys of the noise, `[N]`.
        rules: rules of the environment.
    """
    key = key.to(torch.int32)
    first = state.presses * NUMBERS_PER_PRESS
    if rules.slip > 0.0:
        random_key = (counter_rng.uniform(rng, first + SLIPPED_KEY) * NUM_KEYS).to(torch.int32)
        key = torch.where(counter_rng.uniform(rng, first + SLIP) < rules.slip, random_key, key)
    fuel, controller = state.fuel, state.controller
    if option is not None:
        option = option.to(torch.int32)
        if rules.switch_cost is not None:
            is_other = (option != controller) & (controller != NOT_CHOSEN)
            fuel = torch.where(is_other, (fuel - rules.switch_cost).clamp(min=0.0), fuel)
            controller = option
        else:
            controller = torch.where(controller == NOT_CHOSEN, option, controller)
    if max(rules.noises) > 0.0:
        deviation = torch.full(controller.shape, rules.noises[0], device=controller.device, dtype=torch.float32)
        for boat, noise in enumerate(rules.noises[1:], start=1):
            deviation = torch.where(controller == boat, noise, deviation)
        duration = duration * (deviation * counter_rng.normal(rng, first // 2 + MOTOR)).exp()
        duration = duration.clamp(max=MAX_DURATION)
    dir_x, dir_y = direction_of(rules, controller, state.keymap, key)
    pressed = physics.press(state.x, state.y, fuel, state.goal_x, state.goal_y, dir_x, dir_y, duration)
    after = after_press(state, pressed, dir_x, dir_y, controller)
    return after, reward_of(state, after, rules)


def after_press(
    state: BoatState, pressed: physics.Press, dir_x: Tensor, dir_y: Tensor, controller: Tensor
) -> BoatState:
    """Return the boats after a press in a unit direction, with the controllers that they have now, `[N]` each."""
    return state._replace(
        x=pressed.x,
        y=pressed.y,
        velocity_x=pressed.speed * dir_x,
        velocity_y=pressed.speed * dir_y,
        fuel=pressed.fuel,
        controller=controller,
        presses=state.presses + 1,
        outcome=pressed.outcome,
    )


def reward_of(before: BoatState, after: BoatState, rules: BoatDockOptions) -> Tensor:
    """Return the rewards of a step between two states, `[N]`."""
    is_success = after.outcome == SUCCESS
    final = torch.where(is_success, SUCCESS_REWARD * after.fuel / TANK, 0.0)
    if rules.reward == "sparse":
        return final
    failed = (after.outcome > SUCCESS) & (after.outcome < TIME_LIMIT)
    progress = (_goal_distance(before) - _goal_distance(after)) / harbour.separation(_layout(before))
    return progress + torch.where(failed, FAILURE_REWARD, final)


def _goal_distance(state: BoatState) -> Tensor:
    return ((state.goal_x - state.x).square() + (state.goal_y - state.y).square()).sqrt()


def _layout(state: BoatState) -> harbour.Layout:
    return harbour.Layout(state.start_x, state.start_y, state.goal_x, state.goal_y)


def observe(state: BoatState, rng: counter_rng.RngKey | None, rules: BoatDockOptions) -> Tensor:
    """Return the observations: `[N, 16]` with the entries SCALED_NAMES, or `[N, 14]` with OBSERVATION_NAMES.

    Args:
        state: states of the boats.
        rng: random-number keys of the noise, `[N]`. None if the sensors have no noise.
        rules: rules of the environment. With `pixels` the observation has OBSERVATION_NAMES.
    """
    points = [state.start_x, state.start_y, state.goal_x, state.goal_y, state.x, state.y]
    if rng is not None:
        first = state.presses * (NUMBERS_PER_PRESS // 2) + SENSOR
        points = [p + rules.sensor_noise * counter_rng.normal(rng, first + i) for i, p in enumerate(points)]
    start_x, start_y, goal_x, goal_y, x, y = points
    distance = ((goal_x - x).square() + (goal_y - y).square()).sqrt()
    # The clamp is needed because sensor noise can bring start and goal together.
    at_start = harbour.separation(harbour.Layout(start_x, start_y, goal_x, goal_y)).clamp(min=DOCK_RADIUS)
    is_pixels = rules.observation == "pixels"
    centre_x, centre_y = CENTRE if is_pixels else (0.0, 0.0)
    length, speed = (1.0, 1.0) if is_pixels else (1.0 / HARBOUR_RADIUS, 1.0 / SPEED_SCALE)
    zeros = torch.zeros_like(x)
    columns = [
        start_x * length + centre_x,
        start_y * length + centre_y,
        goal_x * length + centre_x,
        goal_y * length + centre_y,
        zeros + centre_x,
        zeros + centre_y,
        zeros + HARBOUR_RADIUS * length,
        state.controller.to(torch.float32),
        x * length + centre_x,
        y * length + centre_y,
        state.velocity_x * speed,
        state.velocity_y * speed,
        state.fuel / TANK,
        distance / at_start,
    ]
    if not is_pixels:
        columns += [(goal_x - x) * length, (goal_y - y) * length]
    return torch.stack(columns, -1)
