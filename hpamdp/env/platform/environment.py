"""The Platform domain as a batched TorchRL environment: over two gaps and two enemies to the end of a course.

Source: Masson, Ranchod & Konidaris 2016, arXiv:1509.01644, section on the Platform domain. Constants, bounds and rules
as in gym-platform, the version that Bester, James & Konidaris 2019, arXiv:1905.04388, made for their experiments.
Differs from the source: observations are scaled to [-1, 1], as those authors do for their learners, and don't tell how
many ticks the last action took; the height and the length of a jump come in closed form, the same up to rounding.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Categorical, Composite, Unbounded

from hpamdp import keys
from hpamdp.env import counter_rng
from hpamdp.env.base import PAMDPEnv
from hpamdp.env.columns import taken_back, where

RUN, HOP, LEAP = range(3)
PARAMETER_HIGH = (30.0, 720.0, 430.0)
OUTCOMES = ("on the way", "arrived", "fell", "met an enemy", "time limit")
ON_THE_WAY, ARRIVED, FELL, MET_ENEMY, TIME_LIMIT = range(5)
OBSERVATION_NAMES = (
    *("x", "speed", "enemy_x", "enemy_speed"),
    *("platform_width", "next_width", "gap", "platform_left", "next_height"),
)

# Lengths in px, times in s. The three platforms are of one height; an agent or an enemy is where its left foot is.
LEFT, RIGHT = (0.0, 475.0, 985.0), (250.0, 750.0, 1035.0)
END = RIGHT[2]
_BODY_WIDTH, _BODY_HEIGHT = 20.0, 30.0
_TICK, _GRAVITY = 0.05, 9.8
_MAX_SPEED, _MAX_PUSH, _DECAY = 70.0, 30.0, 0.99  # px/s; a push is what an action changes the speed by in one tick
_RUN_TICKS = 20.0
_HOP_RISE, _LEAP_RISE = 35.0, 25.0  # vertical speed at the start of a jump
_ENEMY_SPEED = 30.0
_FIRST_START, _SECOND_START = RIGHT[0] - _BODY_WIDTH, RIGHT[1] - _BODY_WIDTH  # where the enemies start and turn
_JUMP_NOISE, _TICK_NOISE = 1.0, 0.5 * _TICK  # standard deviations, px/s: at the start of a jump, and at every tick
# Normal numbers that an action may take from its episode's: two for a jump, then two a tick. A hop takes 144 ticks.
_DRAWS_AN_ACTION = 512
# Of each platform, as observed: its width, the next one's, the gap and its left edge, in [0, 1]; the next one's height.
_PLATFORM_FEATURES = (
    (250 / 275, 275 / 275, 225 / 235, LEFT[0] / END, 0.0),
    (275 / 275, 50 / 275, 235 / 235, LEFT[1] / END, 0.0),
    (50 / 275, 0.0, 0.0, LEFT[2] / END, 0.0),
)


class PlatformState(NamedTuple):
    """Columns `[num_envs]`, px and px/s; the enemy is that of the platform last reached: the other is out of reach."""

    x: Tensor
    speed: Tensor
    enemy_x: Tensor
    enemy_speed: Tensor
    steps: Tensor
    outcome: Tensor
    episode: Tensor


class PlatformEnv(PAMDPEnv):
    """Cross the platforms in `num_envs` courses at once.

    Action leaves: `("action", "discrete")` int64 `[N]`: 0 run, 1 hop, 2 leap; `("action", "parameters")` float32 `[N, 3]`: the
    run's power in [0, 30] px/s a tick, the distance to hop in [0, 720] px and to leap in [0, 430] px, of which only the
    pressed key's counts (values outside are clipped, NaN and infinite ones refused). A run takes a second, a jump lasts
    until the agent lands. The reward is the distance covered as a share of the course, so 1 is the return of who
    arrives; an episode terminates at the end of the course, in a gap or at an enemy.

    Args:
        num_envs: how many courses.
        max_steps: actions after which an episode is truncated; gym-platform has 200.
        noise: factor on the published noise of jumps, of the agent's speed and of the enemies'; 0 is none.
        device: where the courses live.
        seed: of the noise; the global generators are neither read nor moved. Nothing else is random, so
            `fixed_episodes` is None: `set_seed` and `reset` fix an evaluation's episodes. With the seed of training
            they have the noise of training's first episodes, which no observation tells beforehand.
        first_env: number of the first course, where other processes have those before.

    Raises:
        ValueError: an argument or action that is out of range; the agents are left as they were.
    """

    discrete_names: ClassVar[tuple[str, ...]] = ("run", "hop", "leap")
    parameter_dims = (1, 1, 1)
    result_keys = (keys.OUTCOME,)

    def __init__(
        self,
        num_envs: int = 1,
        *,
        max_steps: int = 200,
        noise: float = 1.0,
        device: torch.device | str | None = "cpu",
        seed: int = 0,
        first_env: int = 0,
    ) -> None:
        for name, value in (("num_envs", num_envs), ("max_steps", max_steps)):
            if value < 1:
                raise ValueError(f"PlatformEnv: {name}={value}, but must be at least 1")
        if not 0.0 <= noise < float("inf"):
            raise ValueError(f"PlatformEnv: noise={noise}, but must be a finite number of at least 0")
        super().__init__(device=device, batch_size=[num_envs])
        self.num_envs, self.max_steps, self.noise = num_envs, max_steps, noise
        self._environment = torch.arange(first_env, first_env + num_envs, dtype=torch.int32, device=self.device)
        self._parameter_high = torch.tensor(PARAMETER_HIGH, device=self.device)
        self._make_specs()
        self._set_seed(seed)

    def results(self, last: TensorDictBase) -> dict[str, Tensor]:
        """Return whether episodes `[M]` ended with the agent's arrival."""
        return {"success": last.get(keys.OUTCOME) == ARRIVED}

    def measure(self, played: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Return the best possible return as `ceiling`."""
        return {"ceiling": 1.0}

    def env_state(self) -> dict[str, Tensor]:
        """Return the columns of the state, `[N]` each."""
        return self._state._asdict()

    def set_env_state(self, columns: Mapping[str, Tensor]) -> None:
        """Go on where `state_columns` were taken; with none, episodes start anew.

        Raises:
            ValueError: they are not the columns of a state of this many environments.
        """
        if not columns:
            self._reset()
            return
        self._state = taken_back(columns, self._state, "PlatformEnv")

    def _make_specs(self) -> None:
        n, device = self.num_envs, self.device
        self.observation_spec = Composite(
            observation=Unbounded(shape=(n, len(OBSERVATION_NAMES)), device=device),
            outcome=Categorical(len(OUTCOMES), shape=(n,), device=device),
            shape=(n,),
        )
        self.action_spec = self.make_action_spec(torch.zeros_like(self._parameter_high), self._parameter_high)
        self.reward_spec = Unbounded(shape=(n, 1), device=device)
        self.done_spec = self.make_done_spec()

    def _set_seed(self, seed: int | None) -> None:
        self._seed = counter_rng.seed_tensor(0 if seed is None else seed, self.device)
        self._state = _start(torch.full_like(self._environment, -1))

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        fresh = _start(self._state.episode + 1)
        self._state = fresh if mask is None else where(mask.reshape(self.num_envs), fresh, self._state)
        return self._read()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.check_action(tensordict)
        discrete = tensordict.get(keys.DISCRETE)
        parameter = self._checked_parameter(discrete, tensordict.get(keys.PARAMETERS))
        before = self._state
        over = before.outcome != ON_THE_WAY
        mask = tensordict.get("_step", None)
        if mask is not None:
            over = over | ~mask.reshape(self.num_envs)
        # Where nothing happens any more a short run is simulated, not to wait for a jump.
        rng = counter_rng.key_for(self._seed, counter_rng.NOISE, self._environment, before.episode)
        after = _act(before, torch.where(over, RUN, discrete), parameter, rng, self.noise)
        out_of_time = (after.steps >= self.max_steps) & (after.outcome == ON_THE_WAY)
        after = after._replace(outcome=torch.where(out_of_time, TIME_LIMIT, after.outcome))
        self._state = where(over, before, after)
        return self._read().set(keys.REWARD, ((self._state.x - before.x) / END).unsqueeze(-1))

    def _checked_parameter(self, discrete: Tensor, parameters: Tensor) -> Tensor:
        """Return the pressed keys' parameters `[N]`, clipped to their bounds."""
        allowed = discrete.clamp(0, len(self.discrete_names) - 1).long()
        parameter = parameters.gather(-1, allowed.unsqueeze(-1)).squeeze(-1)
        is_action = (discrete == allowed) & parameter.isfinite()
        if not is_action.all():
            row = int((~is_action).nonzero()[0])
            raise ValueError(
                f"step: environment {row} got discrete={discrete[row].item()} (allowed 0, 1, 2), parameters="
                f"{parameters[row].tolist()} (the pressed key's must be finite)"
            )
        return parameter.clamp(min=0.0).minimum(self._parameter_high[allowed])

    def _read(self) -> TensorDict:
        outcome = self._state.outcome.long()
        done, truncated = (outcome != ON_THE_WAY).unsqueeze(-1), (outcome == TIME_LIMIT).unsqueeze(-1)
        leaves = {
            keys.OBSERVATION: _observe(self._state),
            keys.OUTCOME: outcome,
            keys.DONE: done,
            keys.TERMINATED: done & ~truncated,
            keys.TRUNCATED: truncated,
        }
        return TensorDict(leaves, batch_size=self.batch_size, device=self.device)


def _start(episode: Tensor) -> PlatformState:
    """Return the states in which episodes `[N]` begin."""
    zeros, none = torch.zeros_like(episode, dtype=torch.float32), torch.zeros_like(episode)
    return PlatformState(
        x=zeros,
        speed=zeros,
        enemy_x=zeros + _FIRST_START,
        enemy_speed=zeros - _ENEMY_SPEED,
        steps=none,
        outcome=none + ON_THE_WAY,
        episode=episode,
    )


def _act(state: PlatformState, discrete: Tensor, parameter: Tensor, rng: Tensor, noise: float) -> PlatformState:
    """Carry out one action `[N]` in every environment; the keys `rng` `[N]` give the random numbers.

    The action is simulated at full length, `[T, N]`, and then cut off where something ends it.
    """
    edge = torch.where(state.x < LEFT[2] - _BODY_WIDTH, RIGHT[1], RIGHT[2])
    edge = torch.where(state.x < LEFT[1] - _BODY_WIDTH, RIGHT[0], edge)
    is_jump = (discrete != RUN) & (state.x <= edge)  # who has run over the edge falls, whatever the key
    first = state.steps * _DRAWS_AN_ACTION
    rise = torch.where(discrete == HOP, _HOP_RISE, _LEAP_RISE)
    push = parameter / (2.0 * rise / _GRAVITY + 1.0) - state.speed
    push = push - noise * _JUMP_NOISE * counter_rng.normal(rng, first).abs()
    rise = rise - noise * _JUMP_NOISE * counter_rng.normal(rng, first + 1).abs()
    speed = state.speed + torch.where(is_jump, push.clamp(-_MAX_PUSH, _MAX_PUSH), 0.0)
    # Tick k of a jump, from 0, ends at a height of (k + 1) (rise - k fall) tick.
    fall = 0.5 * _GRAVITY * _TICK
    length = torch.where(is_jump, (rise / fall).floor().clamp(min=-1.0) + 2.0, _RUN_TICKS)
    tick = torch.arange(int(length.max()), dtype=torch.int32, device=rng.device).unsqueeze(-1)
    draw = first + 2 + 2 * tick
    drag = noise * _TICK_NOISE * counter_rng.normal(rng, draw).abs()
    gust = noise * _TICK_NOISE * counter_rng.normal(rng, draw + 1)

    before, x, speed = _move(state.x, speed, edge, torch.where(is_jump, 0.0, parameter), drag)
    enemy_x, enemy_speed = _patrol(before, x, state.enemy_x, state.enemy_speed, gust)
    height = torch.where(is_jump, (tick + 1) * (rise - tick * fall) * _TICK, 0.0)
    has_met = ((x - enemy_x).abs() < _BODY_WIDTH) & (height < _BODY_HEIGHT)
    is_off = ~is_jump & (before > edge)
    is_end = has_met | is_off | (x >= END) | (tick == length - 1.0)
    end = torch.where(is_end, tick, len(tick)).amin(0, keepdim=True).long()
    x, speed, enemy_x, enemy_speed, height, has_met, is_off = (
        trace.gather(0, end).squeeze(0) for trace in (x, speed, enemy_x, enemy_speed, height, has_met, is_off)
    )

    is_down = height < 0.0
    landed_x, stands = _land(x, -height)
    is_still = is_down & (stands | (landed_x != x))
    x = torch.where(is_down, landed_x, x)
    outcome = torch.where(is_off | (is_down & ~stands), FELL, ON_THE_WAY)
    outcome = torch.where(has_met, MET_ENEMY, outcome)
    outcome = torch.where(x >= END, ARRIVED, outcome).to(torch.int32)
    speed = torch.where(is_still, 0.0, speed)
    return PlatformState(x, speed, enemy_x, enemy_speed, state.steps + 1, outcome, state.episode)


def _move(x: Tensor, speed: Tensor, edge: Tensor, power: Tensor, drag: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return where the agents `[N]` are before and after each tick, and their speeds after it, `[T, N]` each.

    The `power` of a run pushes while the agent is not beyond the `edge`; `drag` `[T, N]` is what a tick takes off.
    """
    xs, speeds, no_power = [x], [], torch.zeros_like(power)
    for loss in drag.unbind():
        speed = (speed + torch.where(x <= edge, power, no_power) - loss).clamp(0.0, _MAX_SPEED)
        x = torch.add(x, speed, alpha=_TICK)
        speed = speed * _DECAY
        xs.append(x)
        speeds.append(speed)
    trace = torch.stack(xs).clamp(max=END)
    return trace[:-1], trace[1:], torch.stack(speeds)


def _patrol(before: Tensor, after: Tensor, x: Tensor, speed: Tensor, gust: Tensor) -> tuple[Tensor, Tensor]:
    """Return the enemies' positions and speeds after each tick, `[T, N]` each, by where the agents are `[T, N]`.

    An enemy turns at the edges of its platform, and its speed changes by `gust` `[T, N]`.
    """
    is_second = before > LEFT[1]
    left = torch.where(is_second, LEFT[1], LEFT[0])
    right = torch.where(is_second, _SECOND_START, _FIRST_START)
    slowest, fastest = torch.full_like(gust, -_ENEMY_SPEED), torch.full_like(gust, _ENEMY_SPEED)
    # Where the second platform is reached its enemy takes over: bounds that leave nothing but its start.
    is_reached = (after > LEFT[1]) & ~is_second
    left, right = (bound.masked_fill(is_reached, _SECOND_START) for bound in (left, right))
    fastest = fastest.masked_fill(is_reached, -_ENEMY_SPEED)
    xs, speeds = [], []
    for low, high, slow, fast, change in zip(*map(Tensor.unbind, (left, right, slowest, fastest, gust)), strict=True):
        speed = torch.where((low < x) & (x < high), speed, -speed)
        speed = (speed + change).clamp(slow, fast)
        x = torch.add(x, speed, alpha=_TICK).clamp(low, high)
        xs.append(x)
        speeds.append(speed)
    return torch.stack(xs), torch.stack(speeds)


def _land(x: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
    """Return where agents `[N]` are who come down at `x`, `depth` px below the platforms' top, and whether they stand.

    A platform throws out what overlaps it on the shorter way: up, or over its edge.
    """
    landed, stands = x, torch.zeros_like(x, dtype=torch.bool)
    for left, right in zip(LEFT, RIGHT, strict=True):
        from_left, from_right = x - (left - _BODY_WIDTH), right - x
        inside = torch.minimum(from_left, from_right)
        stands = stands | (inside >= depth)
        aside = torch.where(from_left < from_right, left - _BODY_WIDTH, right)
        landed = torch.where((inside > 0.0) & (inside < depth), aside, landed)
    return landed, stands


def _observe(state: PlatformState) -> Tensor:
    """Return the observation `[N, 9]`, whose entries are OBSERVATION_NAMES."""
    basic = [
        (state.x + _BODY_WIDTH) / (END + _BODY_WIDTH),
        state.speed / 100.0,
        state.enemy_x / END,
        (state.enemy_speed + _ENEMY_SPEED) / (2.0 * _ENEMY_SPEED),
    ]
    platform = (state.x >= LEFT[1]).long() + (state.x >= LEFT[2])
    features = torch.tensor(_PLATFORM_FEATURES, device=state.x.device)[platform]
    return 2.0 * torch.cat([torch.stack(basic, -1), features], -1) - 1.0
