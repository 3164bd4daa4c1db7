"""One episode of the task as pure functions on columns: a press, a new episode, the observation.

The functions do not use TorchRL and compile without graph breaks. BoatDockEnv wraps them. The observation is compiled
apart from the press: if both were fused, the observation's strided writes would keep the physics from being vectorised.
Positions are px from the harbour's centre.
"""

from __future__ import annotations

import torch
from torch import Tensor

from hpamdp.env import counter_rng
from hpamdp.env.boatdock import harbour, physics
from hpamdp.env.boatdock.task import (
    FAILURE_REWARD,
    FUEL,
    MAX_PRESSES,
    MOTOR,
    NUMBERS_PER_PRESS,
    OBSERVATION_NAMES,
    SCALED_NAMES,
    SENSOR,
    SLIP,
    SLIPPED_KEY,
    SPEED_SCALE,
    SUCCESS_REWARD,
    BoatState,
    ObservationForm,
    RewardForm,
    Rules,
)


def start(episode: Tensor, rng: counter_rng.RngKey, rules: Rules) -> BoatState:
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
        drawn = (counter_rng.uniform(rng, harbour.INDEX_CONTROLLER) * num).to(torch.int32)
        controller = (num - 1 - drawn).clamp(min=0)
    elif rules.controller == "choose":
        controller = integer_zeros + harbour.NOT_CHOSEN
    else:
        controller = integer_zeros + rules.names.index(rules.controller)
    if rules.keymap == "random":
        keymap = 1 + (counter_rng.uniform(rng, harbour.INDEX_KEYMAP) < 0.5).to(torch.int32)
    else:
        keymap = integer_zeros + rules.keymap
    return BoatState(
        *layout,
        x=layout.start_x,
        y=layout.start_y,
        velocity_x=zeros,
        velocity_y=zeros,
        fuel=zeros + physics.TANK,
        controller=controller,
        keymap=keymap,
        presses=integer_zeros,
        outcome=integer_zeros + physics.SAILING,
        episode=episode,
    )


def act(
    state: BoatState, option: Tensor | None, key: Tensor, duration: Tensor, rng: counter_rng.RngKey, rules: Rules
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
        random_key = (counter_rng.uniform(rng, first + SLIPPED_KEY) * harbour.NUM_KEYS).to(torch.int32)
        key = torch.where(counter_rng.uniform(rng, first + SLIP) < rules.slip, random_key, key)
    fuel, controller = state.fuel, state.controller
    if option is not None:
        option = option.to(torch.int32)
        if rules.switch_cost is not None:
            is_other = (option != controller) & (controller != harbour.NOT_CHOSEN)
            fuel = torch.where(is_other, (fuel - rules.switch_cost).clamp(min=0.0), fuel)
            controller = option
        else:
            controller = torch.where(controller == harbour.NOT_CHOSEN, option, controller)
    if max(rules.motor_noise) > 0.0:
        deviation = torch.full(controller.shape, rules.motor_noise[0], device=controller.device, dtype=torch.float32)
        for boat, noise in enumerate(rules.motor_noise[1:], start=1):
            deviation = torch.where(controller == boat, noise, deviation)
        duration = duration * (deviation * counter_rng.normal(rng, first // 2 + MOTOR)).exp()
        duration = duration.clamp(max=physics.MAX_DURATION)
    dir_x, dir_y = harbour.direction_of(rules, controller, state.keymap, key)
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


def reward_of(before: BoatState, after: BoatState, rules: Rules) -> Tensor:
    """Return the rewards of a step between two states, `[N]`."""
    is_success = after.outcome == physics.SUCCESS
    final = torch.where(is_success, SUCCESS_REWARD * after.fuel / physics.TANK, 0.0)
    if rules.reward == "sparse":
        return final
    failed = (after.outcome > physics.SUCCESS) & (after.outcome < physics.TIME_LIMIT)
    progress = (_goal_distance(before) - _goal_distance(after)) / harbour.separation(_layout(before))
    return progress + torch.where(failed, FAILURE_REWARD, final)


def _goal_distance(state: BoatState) -> Tensor:
    return ((state.goal_x - state.x).square() + (state.goal_y - state.y).square()).sqrt()


def _layout(state: BoatState) -> harbour.Layout:
    return harbour.Layout(state.start_x, state.start_y, state.goal_x, state.goal_y)


def observe(state: BoatState, rng: counter_rng.RngKey | None, rules: Rules) -> Tensor:
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
    at_start = harbour.separation(harbour.Layout(start_x, start_y, goal_x, goal_y)).clamp(min=physics.DOCK_RADIUS)
    is_pixels = rules.observation == "pixels"
    centre_x, centre_y = harbour.CENTRE if is_pixels else (0.0, 0.0)
    length, speed = (1.0, 1.0) if is_pixels else (1.0 / physics.HARBOUR_RADIUS, 1.0 / SPEED_SCALE)
    zeros = torch.zeros_like(x)
    columns = [
        start_x * length + centre_x,
        start_y * length + centre_y,
        goal_x * length + centre_x,
        goal_y * length + centre_y,
        zeros + centre_x,
        zeros + centre_y,
        zeros + physics.HARBOUR_RADIUS * length,
        state.controller.to(torch.float32),
        x * length + centre_x,
        y * length + centre_y,
        state.velocity_x * speed,
        state.velocity_y * speed,
        state.fuel / physics.TANK,
        distance / at_start,
    ]
    if not is_pixels:
        columns += [(goal_x - x) * length, (goal_y - y) * length]
    return torch.stack(columns, -1)
