"""Moving and Sliding as batched TorchRL environments: drive to a target and stop there.

Source: Xiong et al. 2018, arXiv:1810.06394, and Fan et al. 2019, arXiv:1903.01344, in the version of gym-hybrid; see
`hpamdp.env.gym_hybrid.rules`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

import torch
from torch import Tensor

from hpamdp.env.gym_hybrid import kernel, rules
from hpamdp.env.gym_hybrid.options import CARDS, PUBLISHED_STEPS, VehicleOptions
from hpamdp.env.gym_hybrid.rules import VehicleState
from hpamdp.env.point_env import PointEnv
from hpamdp.geometry import PlaneGeometry, Symmetries, make_symmetries, on_observations, plane_maps


class _VehicleEnv(PointEnv[VehicleState]):
    """What Moving and Sliding have in common; see `MovingEnv`."""

    Options = VehicleOptions
    options: VehicleOptions
    discrete_names = rules.ACTIONS
    outcomes: ClassVar[tuple[str, ...]] = rules.OUTCOMES
    observation_names = rules.OBSERVATION_NAMES
    parameter_dims = (1, 1, 0)
    parameter_low = rules.PARAMETER_LOW
    parameter_high = rules.PARAMETER_HIGH
    row_kernel = staticmethod(kernel.advance)
    state_type = VehicleState
    num_columns = (7, 3)
    target_radius = rules.TARGET_RADIUS
    has_walls = True
    slides: ClassVar[bool]
    scripted_figures: ClassVar[dict[str, float]]  # of the hand-written player

    def _prepare(self) -> None:
        self.limit_terminates = self.options.limit == "terminated"

    def kernel_settings(self) -> Sequence[float]:
        """Return whether the vehicle slides."""
        return [self.slides]

    @property
    def observation_bounds(self) -> tuple[Sequence[float], Sequence[float]]:
        """The lowest and the highest observation, `[10]` each."""
        return rules.observation_bounds(self.max_steps)

    @property
    def symmetries(self) -> Symmetries:
        """The turns of the square field and their mirrors, which also mirror a turn of the vehicle."""
        plane = plane_maps(4)
        weight, offset = on_observations(plane, len(self.observation_names), rules.VECTORS)
        is_mirrored = torch.arange(len(plane)) >= 4
        turn_sign = torch.where(is_mirrored, -1.0, 1.0)
        # Unit parameters: the acceleration stays, the turn changes its sign.
        return make_symmetries(
            weight,
            offset=offset,
            discrete=torch.arange(len(rules.ACTIONS)).expand(len(plane), -1),
            sign=torch.stack([torch.ones_like(turn_sign), turn_sign], -1),
            num_parameters=2,
        )

    @property
    def geometry(self) -> PlaneGeometry:
        """The places of vehicle and target, and the heading."""
        return PlaneGeometry(vectors=rules.VECTORS)

    def scripted_action(self, state: VehicleState) -> tuple[Tensor, Tensor]:
        """Return the action of the hand-written player and its parameter, `[N]` each."""
        return rules.scripted_action(state)

    def references(self, measured: Mapping[str, float]) -> dict[str, dict[str, float]]:
        """Return the figures of the hand-written player, which nearly always succeeds."""
        if self.max_steps != PUBLISHED_STEPS:
            return {}
        return {"scripted": self.scripted_figures, "ceiling": {"success": 1.0}}

    def picture_note(self, state: VehicleState) -> str:
        """Return the speed."""
        return f"speed {float(state.speed):.2f}"

    def heading(self, state: VehicleState) -> float:
        """Return where the vehicle looks, rad."""
        return float(state.heading)


class MovingEnv(_VehicleEnv):
    """Drive to the target and stop there, in `num_envs` fields at once.

    Action leaves: `("action", "discrete")` int64 `[N]`: 0 accelerate, 1 turn, 2 brake; `("action", "parameters")`
    float32 `[N, 2]`: the acceleration in [0, 1] and the turn in [-1, 1], a fraction of a right angle. Parameters
    outside are clipped; NaN and infinity are refused. Braking has none.

    The reward is the way made towards the target, less 0.001 a step, plus 1 for stopping within 0.1 of it. Any other
    step that leaves the field or reaches the time limit has the reward -1 instead. An episode terminates at rest in the
    target and outside the field.

    Only the start is random. For the constructor's arguments and errors see `BatchedEnv`.
    """

    card = CARDS["MovingEnv"]
    slides = False
    scripted_figures: ClassVar[dict[str, float]] = {"score": 1.874, "success": 0.9987, "steps": 96.0}


class SlidingEnv(_VehicleEnv):
    """`MovingEnv` on ice: a turn changes the heading alone, and an acceleration adds to the velocity as a vector.

    The course is not observed. For actions, arguments and errors see `MovingEnv`.
    """

    card = CARDS["SlidingEnv"]
    slides = True
    scripted_figures: ClassVar[dict[str, float]] = {"score": 1.874, "success": 0.9988, "steps": 95.0}
