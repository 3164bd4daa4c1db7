"""One episode of the task as pure functions on columns: a press, a new episode, what is seen.

No TorchRL here: `step`, `reset` and `read` compile without graph breaks and run alone (`experiments/throughput`);
BoatDockEnv wraps them. Compiled together they run slower than apart, because the strided writes of the observation
keep what is fused with them from being vectorised. Positions are px from the harbour's centre.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from hpamdp.env import counter_rng
from hpamdp.env.boatdock import harbour, physics
from hpamdp.env.columns import where

MAX_PRESSES = 25
SUCCESS_REWARD, FAILURE_REWARD = 5.0, -1.0
# The scaled observation divides by these, so that entries lie in about [-1, 1].
_SPEED_SCALE = float(physics.speed(torch.tensor(physics.MAX_DURATION)))

FUEL = "fuel"  # the tensordict entry: the fraction of the tank that is left

OBSERVATION_NAMES = (
    *("start_x", "start_y", "goal_x", "goal_y", "centre_x", "centre_y", "radius", "controller"),
    *("boat_x", "boat_y", "velocity_x", "velocity_y", "fuel", "distance"),
)
SCALED_NAMES = (*OBSERVATION_NAMES, "to_goal_x", "to_goal_y")

# How to compile the functions of this file. Every step of the random numbers' hash reads its input twice, so inlining
# the steps into one another, as the compiler does by default, takes it two minutes. Measured at 16,384 boats: these
# thresholds take 4 s and make 50 million presses/s of step and reset, (8, 2) and (20, 4) make 21 million.
COMPILE_ARGUMENTS = {
    "fullgraph": True,
    "dynamic": False,
    "options": {"realize_opcount_threshold": 16, "realize_reads_threshold": 4},
}

# A press takes 16 draws of its episode's noise key; Gaussian number i takes draws 2i and 2i + 1.
_DRAWS_A_PRESS = 16
_SLIP, _SLIPPED_KEY, _MOTOR, _SENSOR = 0, 1, 1, 2


class Rules(NamedTuple):
    """What stays fixed over an environment's life; see BoatDockEnv for the meanings."""

    controller: str = "choose"
    keymap: int | str = 1
    reward: str = "paper"
    observation: str = "scaled"
    motor_noise: tuple[float, float] = (0.0, 0.0)  # of the incongruent and of the congruent boat
    sensor_noise: float = 0.0
    slip: float = 0.0


class BoatState(NamedTuple):
    """One column `[num_envs]` a field; px from the harbour's centre, fuel in seconds, integers int32."""

    start_x: Tensor
    start_y: Tensor
    goal_x: Tensor
    goal_y: Tensor
    x: Tensor
    y: Tensor
    velocity_x: Tensor
    velocity_y: Tensor
    fuel: Tensor
    controller: Tensor
    keymap: Tensor
    presses: Tensor
    outcome: Tensor
    episode: Tensor


class Reading(NamedTuple):
    """What is seen: observation `[N, 16]` (`scaled`) or `[N, 14]` (`pixels`), outcome int64 `[N]`, the rest `[N, 1]`.

    The observation's entries are SCALED_NAMES and OBSERVATION_NAMES; fuel is a fraction of the tank.
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
        state: the boats; an episode that is over stays as it is and earns 0.
        option: integers `[N]`, taken as the controller where none is chosen yet.
        key: integers `[N]`; durations: seconds `[N, K]`, clipped to [0, MAX_DURATION]; the pressed key's
            counts.
        seed: int32 scalar; environment: int32 `[N]`, the rows' indices.

    Returns:
        The next states, the rewards `[N]`, and whether each row's action was one at all `[N]` (where not, the row's
        other results mean nothing).
    """
    allowed_key = key.clamp(0, harbour.NUM_KEYS - 1)
    duration = durations[:, 0]
    for k in range(1, harbour.NUM_KEYS):
        duration = torch.where(allowed_key == k, durations[:, k], duration)
    is_action = (key == allowed_key) & duration.isfinite()
    if rules.controller == "choose":
        is_action = is_action & (option >= 0) & (option < len(harbour.CONTROLLERS))
    noise_key = counter_rng.key_for(seed, counter_rng.NOISE, environment, state.episode)
    moved = _press(state, option.to(torch.int32), allowed_key.to(torch.int32), duration, noise_key, rules)
    over = state.outcome != physics.SAILING
    reward = torch.where(over, 0.0, reward_of(state, moved, rules))
    return where(over, state, moved), reward, is_action


def reset(state: BoatState, mask: Tensor, seed: Tensor, environment: Tensor, rules: Rules) -> BoatState:
    """Start a new episode in the rows of `mask` `[N]`, its layout a function of (seed, row, episode)."""
    episode = state.episode + 1
    key = counter_rng.key_for(seed, counter_rng.TRAINING, environment, episode)
    layout = harbour.draw_layout(key)
    zeros, none = torch.zeros_like(layout.start_x), torch.zeros_like(episode)
    if rules.controller == "random":
        controller = (counter_rng.uniform(key, harbour.DRAW_CONTROLLER) < 0.5).to(torch.int32)
    elif rules.controller == "choose":
        controller = none + harbour.NOT_CHOSEN
    else:
        controller = none + harbour.CONTROLLERS.index(rules.controller)
    if rules.keymap == "random":
        keymap = 1 + (counter_rng.uniform(key, harbour.DRAW_KEYMAP) < 0.5).to(torch.int32)
    else:
        keymap = none + rules.keymap
    fresh = BoatState(
        *layout,
        x=layout.start_x,
        y=layout.start_y,
        velocity_x=zeros,
        velocity_y=zeros,
        fuel=zeros + physics.TANK,
        controller=controller,
        keymap=keymap,
        presses=none,
        outcome=none + physics.SAILING,
        episode=episode,
    )
    return where(mask, fresh, state)


def _press(
    state: BoatState, option: Tensor, key: Tensor, duration: Tensor, noise_key: Tensor, rules: Rules
) -> BoatState:
    draw = state.presses * _DRAWS_A_PRESS
    if rules.slip > 0.0:
        any_key = (counter_rng.uniform(noise_key, draw + _SLIPPED_KEY) * harbour.NUM_KEYS).to(torch.int32)
        key = torch.where(counter_rng.uniform(noise_key, draw + _SLIP) < rules.slip, any_key, key)
    duration = duration.clamp(0.0, physics.MAX_DURATION)
    controller = torch.where(state.controller == harbour.NOT_CHOSEN, option, state.controller)
    if max(rules.motor_noise) > 0.0:
        deviation = torch.where(controller == 0, *rules.motor_noise)
        duration = duration * (deviation * counter_rng.normal(noise_key, draw // 2 + _MOTOR)).exp()
        duration = duration.clamp(max=physics.MAX_DURATION)
    dir_x, dir_y = harbour.direction(controller, state.keymap, key)
    pressed = physics.press(state.x, state.y, state.fuel, state.goal_x, state.goal_y, dir_x, dir_y, duration)
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
    """Return what the step from one state to another earns, `[N]`."""
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
    """Read the boats as they are."""
    points = [state.start_x, state.start_y, state.goal_x, state.goal_y, state.x, state.y]
    if rules.sensor_noise > 0.0:
        noise_key = counter_rng.key_for(seed, counter_rng.NOISE, environment, state.episode)
        first = state.presses * (_DRAWS_A_PRESS // 2) + _SENSOR
        points = [p + rules.sensor_noise * counter_rng.normal(noise_key, first + i) for i, p in enumerate(points)]
    start_x, start_y, goal_x, goal_y, x, y = points
    distance = ((goal_x - x).square() + (goal_y - y).square()).sqrt()
    # Sensor noise can bring start and goal together, hence the bound.
    at_start = harbour.separation(harbour.Layout(start_x, start_y, goal_x, goal_y)).clamp(min=physics.DOCK_RADIUS)
    pixels = rules.observation == "pixels"
    centre_x, centre_y = harbour.CENTRE if pixels else (0.0, 0.0)
    length, speed = (1.0, 1.0) if pixels else (1.0 / physics.HARBOUR_RADIUS, 1.0 / _SPEED_SCALE)
    zeros = torch.zeros_like(x)
    columns = [
        *(start_x * length + centre_x, start_y * length + centre_y),
        *(goal_x * length + centre_x, goal_y * length + centre_y),
        *(zeros + centre_x, zeros + centre_y, zeros + physics.HARBOUR_RADIUS * length),
        state.controller.to(torch.float32),
        *(x * length + centre_x, y * length + centre_y),
        *(state.velocity_x * speed, state.velocity_y * speed),
        *(state.fuel / physics.TANK, distance / at_start),
    ]
    if not pixels:
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
