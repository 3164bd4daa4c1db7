"""Hard Move as a batched TorchRL environment: reach a target by choosing among 2^n sets of actuators.

Source: Li et al. 2022 (HyAR), arXiv:2109.05490; see `hpamdp.env.hard_move.rules`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

import torch
from torch import Tensor

from hpamdp.env import point_agent
from hpamdp.env.hard_move import kernel, rules
from hpamdp.env.hard_move.options import CARDS, HardMoveOptions
from hpamdp.env.hard_move.rules import HardMoveState
from hpamdp.env.point_env import PointEnv
from hpamdp.geometry import PlaneGeometry, Symmetries, make_symmetries, on_observations, plane_maps

# Highest success by `max_steps` and the number of actuators: from some starts the target is out of reach.
_CEILING = {
    30: {4: 0.962, 6: 0.989, 8: 0.993, 10: 0.996},
    25: {4: 0.852, 6: 0.928, 8: 0.948, 10: 0.956},
}
_SCRIPTED = {4: 0.963, 6: 0.990, 8: 0.993, 10: 0.995}  # success of the hand-written player within 30 steps


class HardMoveEnv(PointEnv[HardMoveState]):
    """Reach the target in `num_envs` planes at once.

    Action leaves: `("action", "discrete")` int64 `[N]`: the set of actuators, a number of n bits whose highest one is
    actuator 0; `("action", "parameters")` float32 `[N, 2^n]`: how strongly each set pushes, in [-1, 1], backwards below
    0. Only the parameter of the chosen set counts; outside its bounds it is clipped, NaN and infinity are refused.

    The reward is minus the squared distance after each step, plus 20 within 0.2 of the target, which ends the episode.

    Only the start is random. For the constructor's arguments and errors see `BatchedEnv`.
    """

    Options = HardMoveOptions
    card = CARDS["HardMoveEnv"]
    options: HardMoveOptions
    outcomes: ClassVar[tuple[str, ...]] = rules.OUTCOMES
    observation_names = point_agent.OBSERVATION_NAMES
    target_radius = point_agent.HIT_RADIUS
    row_kernel = staticmethod(kernel.advance)
    state_type = HardMoveState
    num_columns = (6, 3)

    def _prepare(self) -> None:
        n = self.options.n
        self.parameter_dims = (1,) * 2**n
        self.parameter_low, self.parameter_high = (-1.0,) * 2**n, (1.0,) * 2**n
        self.discrete_names = tuple(f"{number:0{n}b}" for number in range(2**n))
        motions = rules.motions(n, rounded=self.options.rounded_directions)
        self.motions = motions.to(self.device, torch.float32)
        self._script = rules.Script(self.motions)

    def kernel_settings(self) -> Sequence[float]:
        """Return the motions of all sets."""
        return self.motions.flatten().tolist()

    @property
    def observation_bounds(self) -> tuple[Sequence[float], Sequence[float]]:
        """The lowest and the highest observation, `[4]` each."""
        return point_agent.observation_bounds(self.max_steps)

    @property
    def symmetries(self) -> Symmetries:
        """Turns by the angle between two actuators and their mirrors.

        With 4 actuators, or without `rounded_directions`, they hold to rounding. Otherwise they hold to 1e-4 of the
        observation a step, because the published directions have three decimals.
        """
        n = self.options.n
        plane = plane_maps(n)
        weight, offset = on_observations(plane, len(self.observation_names), point_agent.VECTORS)
        actuator = torch.arange(n)
        turned = [(actuator + turn) % n for turn in range(n)]
        # The mirror x -> -x takes the angle a to half a turn - a.
        mirrored = [(n // 2 - actuator + turn) % n for turn in range(n)]
        bit = 1 << (n - 1 - actuator)  # actuator 0 is the highest
        is_in = (torch.arange(2**n).unsqueeze(-1) & bit) > 0
        sets = torch.stack([(is_in * bit[becomes]).sum(-1) for becomes in turned + mirrored])
        return make_symmetries(
            weight, offset=offset, discrete=sets, source=sets.argsort(-1), num_parameters=len(self.parameter_dims)
        )

    @property
    def geometry(self) -> PlaneGeometry:
        """Where each set pushes; sets that push equally strongly are of one kind, to the rounding of the directions."""
        strength = self.motions.norm(dim=-1, keepdim=True)
        directions = torch.where(strength > 1e-6, self.motions / strength.clamp(min=1e-6), 0.0)
        kinds = strength.squeeze(-1).round(decimals=2).unique(return_inverse=True)[1]
        return PlaneGeometry(
            vectors=point_agent.VECTORS,
            directions=directions.unsqueeze(0).cpu(),
            kinds=tuple(kinds.tolist()),
            has_mirror=True,
        )

    def scripted_action(self, state: HardMoveState) -> tuple[Tensor, Tensor]:
        """Return the action of the hand-written player and its parameter, `[N]` each."""
        return self._script(state)

    def references(self, measured: Mapping[str, float]) -> dict[str, dict[str, float]]:
        """Return the hand-written player's success, and the fraction of starts from which the target is in reach."""
        if self.max_steps not in _CEILING:
            return {}
        scripted = {"scripted": {"success": _SCRIPTED[self.options.n]}} if self.max_steps == 30 else {}
        return scripted | {"ceiling": {"success": _CEILING[self.max_steps][self.options.n]}}

    def picture_note(self, state: HardMoveState) -> str:
        """Return the number of actuators."""
        return f"{self.options.n} actuators"
