"""Moving and Sliding as batched TorchRL environments: drive to a target and stop there.

Source: Xiong et al. 2018, arXiv:1810.06394, in the version of gym-hybrid; see `hpamdp.env.gym_hybrid.rules`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal

import torch
from torch import Tensor

from hpamdp.env.counter_rng import Key
from hpamdp.env.gym_hybrid import kernel, rules
from hpamdp.env.gym_hybrid.rules import VehicleState
from hpamdp.env.point_env import PointEnv
from hpamdp.geometry import PlaneGeometry, Symmetries, make_symmetries, on_observations, plane_maps


class _VehicleEnv(PointEnv[VehicleState]):
    """What Moving and Sliding have in common; see `MovingEnv`."""

    discrete_names = rules.ACTIONS
    outcomes: ClassVar[tuple[str, ...]] = rules.OUTCOMES
    observation_names = rules.OBSERVATION_NAMES
    parameter_dims = (1, 1, 0)
    target_radius = rules.TARGET_RADIUS
    has_walls = True
    slides: ClassVar[bool]
    scripted_figures: ClassVar[dict[str, float]]  # of the hand-written player

    def __init__(
        self,
        num_envs: int = 1,
        *,
        max_steps: int = rules.PUBLISHED_STEPS,
        limit: Literal["truncated", "terminated"] = "truncated",
        compile_rules: bool = False,
        oracle: bool = False,
        device: torch.device | str | None = "cpu",
        seed: int = 0,
        first_env: int = 0,
    ) -> None:
        if limit not in ("truncated", "terminated"):
            raise ValueError(f"{type(self).__name__}: {limit=}, but must be truncated or terminated")
        super().__init__(
            num_envs,
            max_steps=max_steps,
            parameter_low=rules.PARAMETER_LOW,
            parameter_high=rules.PARAMETER_HIGH,
            device=device,
            seed=seed,
            first_env=first_env,
            oracle=oracle,
            compile_rules=compile_rules,
        )
        self.limit_terminates = limit == "terminated"
        self._use_kernel(kernel.advance, _VehicleEnv, [self.slides])

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

    def start(self, episode: Tensor, rng: Key) -> VehicleState:
        """Return states with vehicle and target anywhere in the field, at rest."""
        return rules.start(episode, rng)

    def act(
        self, state: VehicleState, discrete: Tensor, parameters: Tensor, rng: Key, is_idle: Tensor
    ) -> tuple[VehicleState, Tensor]:
        """Return the states after one action and the rewards `[N]`."""
        return rules.act(state, discrete, parameters.squeeze(-1), slides=self.slides, max_steps=self.max_steps)

    def observe(self, state: VehicleState) -> Tensor:
        """Return the observations `[N, 10]`."""
        return rules.observe(state, self.max_steps)

    def scripted_action(self, state: VehicleState) -> tuple[Tensor, Tensor]:
        """Return the action of the hand-written player and its parameter, `[N]` each."""
        return rules.scripted_action(state)

    def references(self, measured: Mapping[str, float]) -> dict[str, dict[str, float]]:
        """Return the figures of the hand-written player, who nearly always succeeds."""
        if self.max_steps != rules.PUBLISHED_STEPS:
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
    float32 `[N, 2]`: the acceleration in [0, 1] and the turn in [-1, 1], a share of a right angle. Outside its bounds a
    parameter is clipped, NaN and infinity are refused; braking has none.

    The reward is the way made towards the target, less 0.001 a step, plus 1 for stopping within 0.1 of it. Who leaves
    the field or runs out of time gets -1 instead. An episode terminates at rest in the target and outside the field.

    Args:
        num_envs: number of fields.
        max_steps: actions after which an episode ends; gym-hybrid has 201.
        limit: what this end counts as. `truncated`: values go on past it. `terminated`: they stop there.
        compile_rules: compile the tensor functions (takes about half a minute) instead of using the kernel.
        oracle: also write the action of a hand-written player under `oracle` (`discrete`, `parameters` `[N, 1]`).
        device: of the tensors.
        seed: of the starts; the global generators are neither read nor moved. Nothing else is random.
        first_env: number of the first field, where other processes have the fields before it.

    Raises:
        ValueError: an argument or an action is invalid; the state is unchanged.
    """

    slides = False
    scripted_figures: ClassVar[dict[str, float]] = {"score": 1.874, "success": 0.9987, "steps": 96.0}


class SlidingEnv(_VehicleEnv):
    """`MovingEnv` on ice: a turn changes the heading alone, and an acceleration adds to the velocity as a vector.

    The course is not observed. For actions, arguments and errors see `MovingEnv`.
    """

    slides = True
    scripted_figures: ClassVar[dict[str, float]] = {"score": 1.874, "success": 0.9988, "steps": 95.0}
