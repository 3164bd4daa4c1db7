"""Platform, with the recorded random numbers.

The package has the rules in its kernel alone, which draws its own numbers. So they are written down here again, for one
agent. `tests/test_platform_rules.py` compares the kernel with them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from adapters import limited
from hpamdp.env.platform import rules
from hpamdp.env.platform.rules import ARRIVED, FELL, HOP, MET_ENEMY, ON_THE_WAY, RUN

DOMAINS = ("platform",)
_SECOND_PLATFORM = 475.0  # beyond it, the second enemy is the active one
# Of each platform: its width, the next one's, the gap, its left edge, and the next one's height.
_FEATURES = torch.tensor(
    [
        [250 / 275, 275 / 275, 225 / 235, 0.0, 0.0],
        [275 / 275, 50 / 275, 235 / 235, 475 / 1035, 0.0],
        [50 / 275, 0.0, 0.0, 985 / 1035, 0.0],
    ],
    dtype=torch.float64,
)


class ScalarCourse:
    """The published rules for one agent, tick by tick and in double precision."""

    PLATFORMS = ((0.0, 250.0), (475.0, 750.0), (985.0, 1035.0))
    TOP, WIDTH, HEIGHT, TICK = 40.0, 20.0, 30.0, 0.05

    def __init__(self, x: float, speed: float, enemy_x: float, enemy_speed: float) -> None:
        self.x = x
        self.y = self.TOP
        self.speed = speed
        self.rise = 0.0
        self.enemies = [[230.0, -30.0], [730.0, -30.0]]
        self.enemies[x > 475.0] = [enemy_x, enemy_speed]

    @property
    def enemy(self) -> list[float]:
        return self.enemies[self.x > 475.0]

    def stands(self) -> bool:
        return self.y == self.TOP and any(left - self.WIDTH <= self.x <= right for left, right in self.PLATFORMS)

    def act(self, discrete: int, parameter: float, numbers: list[float]) -> tuple[float, int]:
        """Return reward and outcome.

        `numbers` are normal: two for a jump, then one for the agent and one for the enemy each tick.
        """
        start = self.x
        tick = 0
        time_left = 1.0
        while True:
            self._choose(discrete, parameter, numbers, tick)
            self._patrol(numbers[3 + 2 * tick])
            self._move()
            outcome = self._outcome()
            tick = tick + 1
            time_left = time_left - self.TICK
            if outcome != ON_THE_WAY or (time_left <= 0.0 if discrete == RUN else self.stands()):
                return (self.x - start) / rules.END, outcome

    def _choose(self, discrete: int, parameter: float, numbers: list[float], tick: int) -> None:
        on_ground = self.stands()
        across, up = 0.0, -9.8
        if on_ground and discrete == RUN:
            across = parameter / self.TICK
            up = 0.0
        elif on_ground:
            rise = 35.0 if discrete == HOP else 25.0
            change = min(max(parameter / (2.0 * rise / 9.8 + 1.0) - self.speed, -600.0), 200.0 - rise)
            across = (change - abs(numbers[0])) / self.TICK
            up = (rise - abs(numbers[1])) / self.TICK
        self.speed += min(max(across, -600.0), 600.0) * self.TICK - abs(0.025 * numbers[2 + 2 * tick])
        self.speed = min(max(self.speed, 0.0), 70.0 if on_ground else 100.0)
        self.rise = min(max(self.rise + min(max(up, -4000.0), 4000.0) * self.TICK, -200.0), 200.0)

    def _patrol(self, number: float) -> None:
        enemy = self.enemy
        left = self.PLATFORMS[self.x > 475.0][0]
        right = self.PLATFORMS[self.x > 475.0][1] - self.WIDTH
        if not left < enemy[0] < right:
            enemy[1] = -enemy[1]
        enemy[1] = min(max(enemy[1] + 0.025 * number, -30.0), 30.0)
        enemy[0] = min(max(enemy[0] + enemy[1] * self.TICK, left), right)

    def _move(self) -> None:
        self.x = min(max(self.x + self.speed * self.TICK, 0.0), rules.END)
        self.y += self.rise * self.TICK
        self.speed *= 0.99
        for left, right in self.PLATFORMS:
            if left - self.WIDTH < self.x < right and -self.HEIGHT < self.y < self.TOP:
                self.speed = 0.0
                aside = left - self.WIDTH if self.x < left else right if self.x > right - self.WIDTH else None
                if aside is not None and abs(self.x - aside) < self.TOP - self.y:
                    self.x = aside
                else:
                    self.y = self.TOP
                    self.rise = 0.0

    def _outcome(self) -> int:
        if self.x >= rules.END:
            return ARRIVED
        if any(abs(self.x - x) < self.WIDTH and abs(self.y - self.TOP) < self.HEIGHT for x, _ in self.enemies):
            return MET_ENEMY
        return FELL if self.y < self.TOP else ON_THE_WAY


class DomainAdapter:
    """Platform by its rules.

    Our state has only the active enemy, since the other stands still. It has no heights, since after an action the
    agent stands or the episode is over.
    """

    outcomes = ("", "arrived", "fell", "enemy", "limit")
    angles = ()
    float32_tolerance = 1e-3

    def __init__(self, recording: dict[str, Any]) -> None:
        self.state_names: list[str] = recording["state_names"]

    def columns(self, rows: Sequence[Sequence[float]]) -> dict[str, Tensor]:
        """Return the columns of our state, float64 `[N]`."""
        table = torch.tensor(rows, dtype=torch.float64)
        recorded = dict(zip(self.state_names, table.unbind(-1), strict=True))
        is_second = recorded["x"] > _SECOND_PLATFORM
        return {
            "x": recorded["x"],
            "speed": recorded["vx"],
            "enemy_x": torch.where(is_second, recorded["enemy2_x"], recorded["enemy1_x"]),
            "enemy_speed": torch.where(is_second, recorded["enemy2_dx"], recorded["enemy1_dx"]),
        }

    def states(self, rows: Sequence[Sequence[float]], taken: Sequence[int], dtype: torch.dtype) -> rules.PlatformState:
        columns = self.columns(rows).values()
        none = torch.zeros(len(rows), dtype=torch.int32)
        steps = torch.tensor(taken, dtype=torch.int32)
        return rules.PlatformState(*(column.to(dtype) for column in columns), steps, none, none)

    def named(self, state: rules.PlatformState) -> dict[str, Tensor]:
        return {name: getattr(state, name) for name in ("x", "speed", "enemy_x", "enemy_speed")}

    def act(
        self, state: rules.PlatformState, steps: Sequence[dict[str, Any]]
    ) -> tuple[rules.PlatformState, dict[str, Tensor]]:
        rows, rewards = [], []
        for before, step in zip(zip(*(column.tolist() for column in state[:4]), strict=True), steps, strict=True):
            course = ScalarCourse(*before)
            numbers = [*(step["jump"] or (0.0, 0.0)), *(drawn for tick in step["draws"] for drawn in tick)]
            highest = rules.PARAMETER_HIGH[step["action"]]
            reward, outcome = course.act(step["action"], min(max(step["parameters"][0], 0.0), highest), numbers)
            rows.append((course.x, course.speed, *course.enemy, outcome))
            rewards.append(reward)
        *columns, outcome = torch.tensor(rows, dtype=torch.float64).unbind(-1)
        after = rules.PlatformState(*columns, state.steps + 1, outcome.int(), state.episode)
        return limited(after, 200, rules.TIME_LIMIT), {"reward": torch.tensor(rewards, dtype=torch.float64)}

    def observe(self, state: rules.PlatformState) -> Tensor:
        """Return the observations in [0, 1], as in gym-platform."""
        x, speed, enemy_x, enemy_speed = (column.double() for column in state[:4])
        columns = [(x + 20.0) / 1055.0, speed / 100.0, enemy_x / 1035.0, (enemy_speed + 30.0) / 60.0]
        platform = (x >= rules.LEFT[1]).long() + (x >= rules.LEFT[2])
        return torch.cat([torch.stack(columns, -1), _FEATURES[platform]], -1)
