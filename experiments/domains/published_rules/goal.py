"""The rules of Goal and Hard Goal, for columns."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from hpamdp.env import counter_rng
from hpamdp.env.counter_rng import RngKey
from hpamdp.env.goal.rules import (
    _BALL_DECAY,
    _BALL_NOISE,
    _BALL_RATE,
    _BALL_SPEED,
    _COAST,
    _DASH,
    _FACING,
    _FLOAT32_GOAL,
    _FOLLOW,
    _GOING,
    _KEEPER_MARGIN,
    _KEEPER_START,
    _MAX_POWER,
    _NUMBERS_PER_ACTION,
    _PLAYER_DECAY,
    _PLAYER_NOISE,
    _PLAYER_SPEED,
    _REACH_SLACK,
    _SAVE,
    _SHOT_DEPTH,
    _STILL,
    BALL_SIZE,
    CATCH,
    CAUGHT,
    COLUMNS,
    GOAL,
    GOAL_DEPTH,
    GOAL_HALF_WIDTH,
    GOAL_REWARD,
    HALF_WIDTH,
    KEEPER_SIZE,
    KICK_TO,
    LENGTH,
    NUMBERS_PER_TICK,
    OBSERVATION_HIGH,
    OBSERVATION_LOW,
    OBSERVATION_NAMES,
    OUT,
    PLAYER_SIZE,
    PLAYING,
    REACH,
    REPAIRED_MIDDLE,
    STRETCHES,
    TIME_LIMIT,
    GoalState,
)

# Ticks between two checks of which actions are over. More ticks need fewer checks but simulate more finished actions.
_TICKS_AT_ONCE = 8
_MIDDLE = 2  # of the stretches
_FEW_ROWS = 64  # with this few rows, dropping finished ones saves nothing

Vector = tuple[Tensor, Tensor]  # x and y, `[M]` each
Bodies = tuple[Tensor, ...]  # the COLUMNS, `[M]` each
# Maps ticks `[K]` and rows `[M]` to random numbers in (-1, 1) `[K, 6, M]`.
Numbers = Callable[[Tensor, Tensor], Tensor]


class Aim(NamedTuple):
    """The point that each player kicks to, and whether it is a kick rather than a shot, `[N]` each.

    A kick is over when the ball lies still.
    """

    x: Tensor
    y: Tensor
    is_kick: Tensor


class Motion(NamedTuple):
    """Actions in progress, columns `[M]`: the bodies, the players' aims, the outcome and the number of ticks.

    `end` is -1 until the action is over. Then it is an outcome: PLAYING if the episode goes on.
    """

    player_x: Tensor
    player_y: Tensor
    keeper_x: Tensor
    keeper_y: Tensor
    ball_x: Tensor
    ball_y: Tensor
    player_vx: Tensor
    player_vy: Tensor
    keeper_vx: Tensor
    keeper_vy: Tensor
    ball_vx: Tensor
    ball_vy: Tensor
    player_angle: Tensor
    keeper_angle: Tensor
    aim_x: Tensor
    aim_y: Tensor
    is_kick: Tensor
    end: Tensor
    ticks: Tensor


def start(episode: Tensor, rng: RngKey, dtype: torch.dtype = torch.float32) -> GoalState:
    """Return the initial states of episodes.

    Args:
        episode: numbers of the episodes, int32 `[N]`.
        rng: random-number keys `[N]` from `counter_rng.rng_key`.
        dtype: dtype of positions, velocities and orientations.
    """
    zeros = torch.zeros_like(episode, dtype=dtype)
    integer_zeros = torch.zeros_like(episode)
    player_y = HALF_WIDTH * (2.0 * counter_rng.uniform(rng, 0).to(dtype) - 1.0)
    player_angle = torch.atan2(-player_y, zeros + LENGTH)
    ball_x = REACH * player_angle.cos()
    ball_y = player_y + REACH * player_angle.sin()
    keeper_x = zeros + _KEEPER_START
    keeper_y = ball_y * (LENGTH - _KEEPER_START) / (LENGTH - ball_x)
    return GoalState(
        player_x=zeros,
        player_y=player_y,
        keeper_x=keeper_x,
        keeper_y=keeper_y,
        ball_x=ball_x,
        ball_y=ball_y,
        player_vx=zeros,
        player_vy=zeros,
        keeper_vx=zeros,
        keeper_vy=zeros,
        ball_vx=zeros,
        ball_vy=zeros,
        player_angle=player_angle,
        keeper_angle=torch.atan2(ball_y - keeper_y, ball_x - keeper_x),
        steps=integer_zeros,
        outcome=integer_zeros + PLAYING,
        episode=episode,
    )


def goal_aim(discrete: Tensor, parameters: Tensor, *, kicks_to_point: bool = False) -> Aim:
    """Return the aims of Goal's actions.

    Args:
        discrete: KICK_TO, SHOOT_LEFT or SHOOT_RIGHT, `[N]`.
        parameters: parameters of the chosen action, `[N, 2]`, clipped to their bounds. For a kick, the point to kick
            to. For a shot, y on the goal line and an unused number.
        kicks_to_point: whether a kick goes to (x, y). In the published code it goes to (x, x).
    """
    return _aim(discrete == KICK_TO, parameters[:, 0], parameters[:, 1], parameters[:, 0], kicks_to_point)


def hard_goal_aim(
    discrete: Tensor, parameters: Tensor, *, kicks_to_point: bool = False, has_middle: bool = False
) -> Aim:
    """Return the aims of Hard Goal's actions.

    Args:
        discrete: 0 to kick, 1 to 5 and 6 to 10 to shoot at the STRETCHES of the goal line, `[N]`.
        parameters: parameters of the chosen action, `[N, 2]` in [-1, 1]. A kick has two. A shot has one, with reversed
            sign (1 is the lower end of the stretch), and an unused number.
        kicks_to_point: as for `goal_aim`.
        has_middle: whether the middle shot covers its whole stretch. In the published code it is a single point beside
            the middle.
    """
    stretches = list(STRETCHES)
    if has_middle:
        stretches[_MIDDLE] = REPAIRED_MIDDLE
    low, high = parameters.new_tensor(stretches).unbind(-1)
    stretch = (discrete - 1).clamp(min=0).remainder(len(stretches))
    first, second = parameters.unbind(-1)
    fraction = 0.5 * (low + high)[stretch] - first * (0.5 * (high - low))[stretch]
    return _aim(discrete == 0, LENGTH * (first + 1.0), HALF_WIDTH * second, _FLOAT32_GOAL * fraction, kicks_to_point)


def _aim(is_kick: Tensor, kick_x: Tensor, kick_y: Tensor, shot: Tensor, kicks_to_point: bool) -> Aim:
    kick_x = kick_x.clamp(0.0, 2.0 * LENGTH)
    kick_y = kick_y.clamp(-HALF_WIDTH, HALF_WIDTH) if kicks_to_point else kick_x
    return Aim(
        x=torch.where(is_kick, kick_x, LENGTH + _SHOT_DEPTH),
        y=torch.where(is_kick, kick_y, shot.clamp(-GOAL_HALF_WIDTH, GOAL_HALF_WIDTH)),
        is_kick=is_kick,
    )


def random_numbers(rng: RngKey, steps: Tensor, ticks: Tensor) -> Tensor:
    """Return random numbers in (-1, 1), float32 `[K, 6, M]`, for ticks of the next action.

    Args:
        rng: random-number keys `[M]` from `counter_rng.rng_key`.
        steps: number of actions so far in the episode, int32 `[M]`.
        ticks: numbers of the ticks, int32 `[K]`.
    """
    place = torch.arange(NUMBERS_PER_TICK, dtype=torch.int32, device=ticks.device)
    index = (ticks.unsqueeze(-1) * NUMBERS_PER_TICK + place).unsqueeze(-1) + steps * _NUMBERS_PER_ACTION
    return 2.0 * counter_rng.uniform(rng, index) - 1.0


def act(
    state: GoalState,
    aim: Aim,
    moves: Tensor,
    numbers: Numbers,
    *,
    noise: float = 1.0,
    max_steps: int = 100,
) -> tuple[GoalState, Tensor]:
    """Return the states after one action, and the number of ticks that it took, int32 `[N]`.

    The ticks of all environments run side by side. Most finished rows are dropped from the later ticks.

    Args:
        state: states before the action.
        aim: aims of the players.
        moves: which rows act, bool `[N]`. The other rows stay unchanged.
        numbers: source of the random numbers.
        noise: factor on the published noise.
        max_steps: number of the action that ends the episode. As in the published code, it ends at once and that
            action is not simulated.
    """
    steps = torch.where(moves, state.steps + 1, state.steps)
    is_late = moves & (steps >= max_steps)
    is_played = moves & ~is_late
    outcome = torch.where(is_late, TIME_LIMIT, state.outcome)
    end = torch.where(is_played, _GOING, outcome)
    motion = Motion._make((*state[: len(COLUMNS)], *aim, end, torch.zeros_like(steps)))
    rows = torch.arange(len(steps), device=steps.device)
    motion = _run(motion, rows, 0, numbers, noise)
    return GoalState._make((*motion[: len(COLUMNS)], steps, motion.end, state.episode)), motion.ticks


def _run(motion: Motion, rows: Tensor, first: int, numbers: Numbers, noise: float) -> Motion:
    """Return the motion of these rows `[M]` at the end of their actions, from tick number `first` on."""
    while True:
        going = (motion.end == _GOING).nonzero().squeeze(-1)
        if not len(going):
            return motion
        # Never shrink to one row: the compiler would specialise and compile the tick again.
        if len(rows) > _FEW_ROWS and 1 < len(going) <= len(rows) // 2:
            rest = Motion(*(column[going] for column in motion))
            rest = _run(rest, rows[going], first, numbers, noise)
            return Motion(*(old.index_copy(0, going, new) for old, new in zip(motion, rest, strict=True)))
        ticks = torch.arange(first, first + _TICKS_AT_ONCE, dtype=torch.int32, device=rows.device)
        for drawn in numbers(ticks, rows).to(motion.ball_x.dtype).unbind():
            motion = masked_tick(motion, drawn, noise)
        first += _TICKS_AT_ONCE


def masked_tick(motion: Motion, numbers: Tensor, noise: float) -> Motion:
    """Return the motion after one tick of the actions that are not over.

    Args:
        motion: motion before the tick.
        numbers: random numbers in (-1, 1), `[6, M]`.
        noise: factor on the published noise.
    """
    bodies = tick(motion[: len(COLUMNS)], motion.aim_x, motion.aim_y, numbers, noise)
    is_going = motion.end == _GOING
    end = torch.where(is_going, _end(bodies, motion.is_kick), motion.end)
    kept = [torch.where(is_going, new, old) for new, old in zip(bodies, motion, strict=False)]
    ticks = motion.ticks + is_going.to(torch.int32)
    return Motion._make((*kept, motion.aim_x, motion.aim_y, motion.is_kick, end, ticks))


def _end(bodies: Bodies, is_kick: Tensor) -> Tensor:
    """Return the outcome after a tick, int32 `[M]`.

    It is _GOING while the action goes on, and PLAYING if the action is over but the episode is not.
    """
    player_x, player_y, keeper_x, keeper_y, ball_x, ball_y, _, _, _, _, ball_vx, ball_vy, _, _ = bodies
    is_still = _length(ball_vx, ball_vy) <= _STILL
    in_reach = _length(player_x - ball_x, player_y - ball_y) <= REACH + _REACH_SLACK
    end = torch.where(is_kick & is_still & in_reach, PLAYING, _GOING)
    beside = ball_y.abs()
    # Written as a positive test, so that NaN and infinite positions end the episode.
    is_inside = (ball_x >= 0.0) & (ball_x <= LENGTH) & (beside <= HALF_WIDTH)
    end = torch.where(is_inside, end, OUT)
    end = torch.where(_length(keeper_x - ball_x, keeper_y - ball_y) < CATCH, CAUGHT, end)
    is_goal = (ball_x >= LENGTH) & (ball_x <= LENGTH + GOAL_DEPTH) & (beside <= GOAL_HALF_WIDTH)
    return torch.where(is_goal, GOAL, end).to(torch.int32)


def tick(bodies: Bodies, aim_x: Tensor, aim_y: Tensor, numbers: Tensor, noise: float = 1.0) -> Bodies:
    """Return the bodies after one tick of their actions.

    Args:
        bodies: the COLUMNS, `[M]` each.
        aim_x, aim_y: point that the players kick to, `[M]`.
        numbers: random numbers in (-1, 1), `[6, M]`. The first three are for the player or the ball: its angle, and its
            push in x and in y. The last three are for the keeper.
        noise: factor on the published noise.
    """
    player_x, player_y, keeper_x, keeper_y, ball_x, ball_y, *velocities, player_angle, keeper_angle = bodies
    player, keeper, ball = (player_x, player_y), (keeper_x, keeper_y), (ball_x, ball_y)
    player_v, keeper_v, ball_v = ((velocities[i], velocities[i + 1]) for i in (0, 2, 4))
    of_player, of_keeper = numbers[:3].unbind(), numbers[3:].unbind()
    player_v, ball_v, player_angle = _play(
        player, ball, player_v, ball_v, player_angle, (aim_x, aim_y), of_player, noise
    )
    keeper_v, keeper_angle = _keep(keeper, ball, keeper_v, ball_v, of_keeper, noise)
    player, player_v = _roll(player, player_v, _PLAYER_DECAY)
    keeper, keeper_v = _roll(keeper, keeper_v, _PLAYER_DECAY)
    ball, ball_v = _roll(ball, ball_v, _BALL_DECAY)
    player, keeper, player_v, keeper_v = _collide(player, keeper, player_v, keeper_v, PLAYER_SIZE + KEEPER_SIZE)
    player, ball, player_v, ball_v = _collide(player, ball, player_v, ball_v, PLAYER_SIZE + BALL_SIZE)
    keeper, ball, keeper_v, ball_v = _collide(keeper, ball, keeper_v, ball_v, KEEPER_SIZE + BALL_SIZE)
    return (*player, *keeper, *ball, *player_v, *keeper_v, *ball_v, player_angle, keeper_angle)


def _play(
    player: Vector,
    ball: Vector,
    player_v: Vector,
    ball_v: Vector,
    angle: Tensor,
    aim: Vector,
    numbers: Sequence[Tensor],
    noise: float,
) -> tuple[Vector, Vector, Tensor]:
    """Return the velocities of player and ball, and the player's orientation, after the player's move.

    If the ball is in reach, the player kicks it. Otherwise the player dashes if it faces the ball, or else turns
    towards it.
    """
    to_ball_x, to_ball_y = ball[0] - player[0], ball[1] - player[1]
    distance = _length(to_ball_x, to_ball_y)
    turn = torch.atan2(to_ball_y, to_ball_x) - angle
    turn = turn - 2.0 * math.pi * (turn / (2.0 * math.pi)).round()
    off = turn.abs()
    in_reach = distance <= REACH + _REACH_SLACK
    is_facing = off < _FACING
    is_dash = is_facing & ~in_reach
    wish_x = _COAST * (aim[0] - player[0]) - ball_v[0]
    wish_y = _COAST * (aim[1] - player[1]) - ball_v[1]
    # Kicks sideways or from afar lose power.
    efficiency = 1.0 - 0.25 / math.pi * off - 0.25 / REACH * distance
    kick = _length(wish_x, wish_y).minimum(_MAX_POWER * _BALL_RATE * efficiency)
    # Blended by multiplication, because `torch.where` between two Python numbers returns float32.
    of_ball = in_reach.to(angle.dtype)
    pushed_x, pushed_y = _accelerate(
        (torch.where(in_reach, ball_v[0], player_v[0]), torch.where(in_reach, ball_v[1], player_v[1])),
        torch.where(in_reach, kick, _DASH),
        torch.where(in_reach, torch.atan2(wish_y, wish_x), angle),
        numbers,
        of_ball * (noise * (_BALL_NOISE - _PLAYER_NOISE)) + noise * _PLAYER_NOISE,
        of_ball * (_BALL_SPEED - _PLAYER_SPEED) + _PLAYER_SPEED,
    )
    turned = angle + turn / (1.0 + 5.0 * _length(*player_v))
    return (
        (torch.where(is_dash, pushed_x, player_v[0]), torch.where(is_dash, pushed_y, player_v[1])),
        (torch.where(in_reach, pushed_x, ball_v[0]), torch.where(in_reach, pushed_y, ball_v[1])),
        torch.where(in_reach | is_facing, angle, turned),
    )


def _keep(
    keeper: Vector, ball: Vector, keeper_v: Vector, ball_v: Vector, numbers: Sequence[Tensor], noise: float
) -> tuple[Vector, Tensor]:
    """Return the velocity and the orientation of the keeper after its move.

    If the ball will come near the goal, the keeper rushes to block its line. Otherwise it walks to where the ball will
    come to rest.
    """
    roll_x, roll_y = ball_v[0] / _COAST, ball_v[1] / _COAST
    end_x, end_y = ball[0] + roll_x, ball[1] + roll_y
    slope = torch.where(roll_x == 0.0, 0.0, roll_y / roll_x)
    height = ball[1] + slope * (LENGTH - ball[0])
    is_shot = (end_x > LENGTH) & (height.abs() <= GOAL_HALF_WIDTH + _KEEPER_MARGIN) & (slope != 0.0)
    # The shortest way to the ball's line is perpendicular to it. Only the direction matters.
    side = roll_x * (ball[1] - keeper[1]) - roll_y * (ball[0] - keeper[0])
    way_x = torch.where(is_shot, -side * roll_y, end_x - keeper[0])
    way_y = torch.where(is_shot, side * roll_x, end_y - keeper[1])
    angle = torch.atan2(way_y, way_x)
    effort = is_shot.to(angle.dtype) * (_SAVE - _FOLLOW) + _FOLLOW
    return _accelerate(keeper_v, effort, angle, numbers, noise * _PLAYER_NOISE, _PLAYER_SPEED), angle


def _accelerate(
    velocity: Vector,
    effort: Tensor,
    angle: Tensor,
    numbers: Sequence[Tensor],
    noise: Tensor | float,
    limit: Any,
) -> Vector:
    """Return the velocities after a push.

    Args:
        velocity: velocities before the push.
        effort: intended change of velocity, `[M]`.
        angle: direction of the push, `[M]`, to which multiplicative noise is added.
        numbers: random numbers in (-1, 1), three of `[M]`, for the angle and for the push in x and in y.
        noise: amplitude of the noise as a fraction of the angle and of the speed, a number or `[M]`.
        limit: bound in x and in y of the velocity and of its change, a number or `[M]`.
    """
    angle = angle + angle * noise * numbers[0]
    jolt = noise * _length(*velocity)
    push_x = (effort * angle.cos() + jolt * numbers[1]).clamp(-limit, limit)
    push_y = (effort * angle.sin() + jolt * numbers[2]).clamp(-limit, limit)
    return (velocity[0] + push_x).clamp(-limit, limit), (velocity[1] + push_y).clamp(-limit, limit)


def _roll(place: Vector, velocity: Vector, decay: float) -> tuple[Vector, Vector]:
    """Return the position and the velocity of a body after a tick."""
    return (place[0] + velocity[0], place[1] + velocity[1]), (velocity[0] * decay, velocity[1] * decay)


def _collide(
    one: Vector, other: Vector, one_v: Vector, other_v: Vector, touch: float
) -> tuple[Vector, Vector, Vector, Vector]:
    """Return positions and velocities of two bodies. If they overlap, they bounce off each other.

    Args:
        one, other: positions.
        one_v, other_v: velocities.
        touch: distance below which the bodies overlap.
    """
    apart_x, apart_y = one[0] - other[0], one[1] - other[1]
    distance = _length(apart_x, apart_y)
    fraction = (0.5 * (touch - distance)).clamp(min=0.0) / distance.clamp(min=1e-12)
    shift_x, shift_y = apart_x * fraction, apart_y * fraction
    sign = 1.0 - 2.0 * (distance < touch).to(distance.dtype)
    return (
        (one[0] + shift_x, one[1] + shift_y),
        (other[0] - shift_x, other[1] - shift_y),
        (one_v[0] * sign, one_v[1] * sign),
        (other_v[0] * sign, other_v[1] * sign),
    )


def _length(x: Tensor, y: Tensor) -> Tensor:
    """Return the lengths of vectors, `[M]`."""
    return torch.hypot(x, y)


def goal_distance(state: GoalState, *, is_repaired: bool = False) -> Tensor:
    """Return the distance of the ball from the goal, `[N]`.

    Args:
        state: states of the episodes.
        is_repaired: whether to correct an error of the published code. For a ball behind the goal line and below the
            goal, that code's distance is 2 x 7.01 too large.
    """
    beside = state.ball_y.abs() - GOAL_HALF_WIDTH
    depth = LENGTH - state.ball_x
    before = torch.where(beside > 0.0, torch.hypot(depth, beside), depth)
    behind = beside.clamp(min=0.0)
    if not is_repaired:
        behind = torch.where(state.ball_y < -GOAL_HALF_WIDTH, GOAL_HALF_WIDTH - state.ball_y, behind)
    return torch.where(depth > 0.0, before, behind)


def reward(before: GoalState, after: GoalState, *, repairs_distance: bool = False) -> Tensor:
    """Return the reward of an action `[N]`.

    A goal gives 50. Any other end of the episode gives minus the ball's distance from the goal.

    Args:
        before, after: states before and after the action.
        repairs_distance: as `is_repaired` of `goal_distance`.
    """
    ended = (after.outcome != PLAYING) & (before.outcome == PLAYING)
    final = torch.where(after.outcome == GOAL, GOAL_REWARD, -goal_distance(after, is_repaired=repairs_distance))
    return torch.where(ended, final, 0.0)


def observe(state: GoalState, *, is_scaled: bool = True, repairs_projection: bool = False) -> Tensor:
    """Return the observation `[N, 17]` with the entries OBSERVATION_NAMES.

    Args:
        state: states of the episodes.
        is_scaled: whether to scale OBSERVATION_LOW and OBSERVATION_HIGH to [-1, 1]. Orientations and the ball can leave
            these bounds.
        repairs_projection: whether to clip `keeper_projection` to the goal's width. This entry is the point where the
            line from the ball through the keeper meets the goal line. In the published code it reaches twice as far on
            the upper side. The scaling bounds are the same in both cases.
    """
    across, along = state.ball_y - state.keeper_y, state.ball_x - state.keeper_x
    distance = torch.hypot(along, across).clamp(min=1e-12)
    shadow = state.ball_y + across / along * (LENGTH - state.ball_x)
    shadow = shadow.clamp(-GOAL_HALF_WIDTH, (1.0 if repairs_projection else 2.0) * GOAL_HALF_WIDTH)
    level = GOAL_HALF_WIDTH * (1.0 - 2.0 * (across > 0.0).to(across.dtype))
    named = state._asdict() | {
        "keeper_to_ball_x": along / distance,
        "keeper_to_ball_y": across / distance,
        "keeper_projection": torch.where(along == 0.0, level, shadow),
    }
    observation = torch.stack([named[name] for name in OBSERVATION_NAMES], -1)
    if not is_scaled:
        return observation
    low, high = observation.new_tensor(OBSERVATION_LOW), observation.new_tensor(OBSERVATION_HIGH)
    return 2.0 * (observation - low) / (high - low) - 1.0
