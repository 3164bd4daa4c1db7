"""One episode of the task as pure functions on columns: a press, a new episode, the observation.

The functions know nothing of TorchRL: `step`, `reset` and `read` compile without graph breaks and can run alone
(`experiments/throughput`); BoatDockEnv wraps them. They are compiled separately, because the strided writes of the
observation would keep a physics fused with them from being vectorised. Positions are px from the harbour's centre.
"""

from __future__ import annotations

from typing import NamedTuple

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
from hpamdp.env.state_columns import where


class Reading(NamedTuple):
    """What an environment returns: outcome int64 `[N]`, the fraction of fuel and the flags `[N, 1]`, the observation.

    The observation is `[N, 16]` with the entries SCALED_NAMES, or `[N, 14]` with OBSERVATION_NAMES for `pixels`.
    """

    observation: Tensor
    outcome: Tensor
    fuel: Tensor
    done: Tensor
    terminated: Tensor
    truncated: Tensor


def step(
    state: BoatState, option: Tensor, key: Tensor, durations: Tensor, seed: Tensor, environment: Tensor, rules: Rules
) -> tuple[BoatState, Tensor, Tensor]:
    """Press one key in every environment.

    Args:
        state: of the boats; an episode that is over stays as it is and earns 0.
        option: integers `[N]`: the controller of boats that have none yet; with a `switch_cost`, of all.
        key: integers `[N]`.
        durations: seconds `[N, K]`, of which only the pressed key's counts; clipped to [0, MAX_DURATION].
        seed: int32 scalar.
        environment: int32 `[N]`, the numbers of the environments.
        rules: of the environment.

    Returns:
        The next states, the rewards `[N]` and whether the actions are valid `[N]`; the other results of an invalid
        action are meaningless.
    """
    allowed_key = key.clamp(0, harbour.NUM_KEYS - 1)
    duration = durations[:, 0]
    for k in range(1, harbour.NUM_KEYS):
        duration = torch.where(allowed_key == k, durations[:, k], duration)
    is_valid = (key == allowed_key) & duration.isfinite()
    if rules.controller == "choose":
        is_valid = is_valid & (option >= 0) & (option < len(rules.names))
    noise_rng = _noise_rng(state, seed, environment, rules)
    moved = _press(state, option.to(torch.int32), allowed_key.to(torch.int32), duration, noise_rng, rules)
    over = state.outcome != physics.SAILING
    reward = torch.where(over, 0.0, reward_of(state, moved, rules))
    return where(over, state, moved), reward, is_valid


def reset(state: BoatState, mask: Tensor, seed: Tensor, environment: Tensor, rules: Rules) -> BoatState:
    """Start a new episode in the rows of `mask` `[N]`; its layout is a function of (seed, environment, episode)."""
    episode = state.episode + 1
    stream = counter_rng.EVALUATION if rules.is_evaluation else counter_rng.TRAINING
    rng = counter_rng.rng_key(seed, stream, environment, episode)
    layout = harbour.sample_layout(rng)
    zeros = torch.zeros_like(layout.start_x)
    integer_zeros = torch.zeros_like(episode)
    if rules.controller == "random":
        num = len(rules.names)
        # The last boat for the smallest numbers, as there were two at first and the second for those under a half.
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
    fresh = BoatState(
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
    return where(mask, fresh, state)


def _noise_rng(state: BoatState, seed: Tensor, environment: Tensor, rules: Rules) -> counter_rng.RngKey:
    stream = counter_rng.EVALUATION_NOISE if rules.is_evaluation else counter_rng.NOISE
    return counter_rng.rng_key(seed, stream, environment, state.episode)


def _press(
    state: BoatState, option: Tensor, key: Tensor, duration: Tensor, noise_rng: counter_rng.RngKey, rules: Rules
) -> BoatState:
    """Return the states after a press of allowed keys with finite durations, as if no episode were over."""
    first = state.presses * NUMBERS_PER_PRESS
    if rules.slip > 0.0:
        random_key = (counter_rng.uniform(noise_rng, first + SLIPPED_KEY) * harbour.NUM_KEYS).to(torch.int32)
        key = torch.where(counter_rng.uniform(noise_rng, first + SLIP) < rules.slip, random_key, key)
    duration = duration.clamp(0.0, physics.MAX_DURATION)
    fuel = state.fuel
    if rules.switch_cost is None:
        controller = torch.where(state.controller == harbour.NOT_CHOSEN, option, state.controller)
    else:
        controller = option
        is_other = (option != state.controller) & (state.controller != harbour.NOT_CHOSEN)
        fuel = torch.where(is_other, (fuel - rules.switch_cost).clamp(min=0.0), fuel)
    if max(rules.motor_noise) > 0.0:
        deviation = torch.full(controller.shape, rules.motor_noise[0], device=controller.device, dtype=torch.float32)
        for boat, noise in enumerate(rules.motor_noise[1:], start=1):
            deviation = torch.where(controller == boat, noise, deviation)
        duration = duration * (deviation * counter_rng.normal(noise_rng, first // 2 + MOTOR)).exp()
        duration = duration.clamp(max=physics.MAX_DURATION)
    dir_x, dir_y = harbour.direction_of(rules, controller, state.keymap, key)
    pressed = physics.press(state.x, state.y, fuel, state.goal_x, state.goal_y, dir_x, dir_y, duration)
    presses = state.presses + 1
    out_of_time = (presses >= MAX_PRESSES) & (pressed.outcome == physics.SAILING)
    return state._replace(
        x=pressed.x,
        y=pressed.y,
        velocity_x=pressed.speed * dir_x,
        velocity_y=pressed.speed * dir_y,
        fuel=pressed.fuel,
        controller=controller,
        presses=presses,
        outcome=torch.where(out_of_time, physics.TIME_LIMIT, pressed.outcome),
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


def read(state: BoatState, seed: Tensor, environment: Tensor, rules: Rules) -> Reading:
    """Return what the environments observe in this state."""
    points = [state.start_x, state.start_y, state.goal_x, state.goal_y, state.x, state.y]
    if rules.sensor_noise > 0.0:
        noise_rng = _noise_rng(state, seed, environment, rules)
        first = state.presses * (NUMBERS_PER_PRESS // 2) + SENSOR
        points = [p + rules.sensor_noise * counter_rng.normal(noise_rng, first + i) for i, p in enumerate(points)]
    start_x, start_y, goal_x, goal_y, x, y = points
    distance = ((goal_x - x).square() + (goal_y - y).square()).sqrt()
    # Clamped, because sensor noise can bring start and goal together.
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
    done = (state.outcome != physics.SAILING).unsqueeze(-1)
    truncated = (state.outcome == physics.TIME_LIMIT).unsqueeze(-1)
    return Reading(
        observation=torch.stack(columns, -1),
        outcome=state.outcome.long(),
        fuel=(state.fuel / physics.TANK).unsqueeze(-1),
        done=done,
        terminated=done & ~truncated,
        truncated=truncated,
    )
