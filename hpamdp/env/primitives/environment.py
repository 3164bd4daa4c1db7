"""Manipulation by primitives as a batched TorchRL environment."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from hpamdp import keys
from hpamdp.env.gymnasium.environment import SimulatorEnv
from hpamdp.env.primitives.manipulation import HIGHEST, LOWEST, OBSERVED, Manipulation
from hpamdp.env.primitives.options import ACTIONS, CARDS, ManipulationRules, PrimitivesOptions
from hpamdp.env.primitives.players import MEASURED, RING_FROM_HANDLE_M
from hpamdp.env.primitives.primitives import AXES, PRIMITIVES

# In assembly the hand holds a handle, and the ring beside it has to go over a peg. Lifts and drops end so far past it.
_CLEARANCE_M = 0.05
# Places of these vectors in the observation.
_OBJECT, _GOAL = (slice(first, first + 3) for first in map(OBSERVED.index, ("object_x", "goal_x")))


class PrimitivesEnv(SimulatorEnv):
    """Let `num_envs` arms manipulate objects at once.

    Action leaves, with the ten primitives:

    - `("action", "discrete")` int64 `[N]`: move, grasp, lift, drop, left, right, forward, backward, open, close;
    - `("action", "parameters")` float32 `[N, 12]`: three distances for each of the first two, one for each of the next
      six, in metres.

    `observation` float32 `[N, 15]`: see `manipulation.OBSERVED`, scaled to [-1, 1]. Options, if `env.grouping=default`:
    `move`, `grasp` and `pull`; with `actions=all` instead `small_steps`, `large_steps` and `primitives`, so that an
    option that holds for an episode is the choice of how to steer. See `Manipulation`, and `GymnasiumEnv` for the
    arguments and the errors.
    """

    Options = PrimitivesOptions
    card = CARDS["PrimitivesEnv"]
    options: PrimitivesOptions
    simulator = Manipulation
    simulator_options = ManipulationRules
    observation_names = OBSERVED

    def _prepare(self) -> None:
        self.discrete_names = tuple(action.name for action in ACTIONS[self.options.actions])

    def initial_parameters(self) -> tuple[Tensor, Tensor]:
        """Return the linear map from observations to initial arguments: to the object, and as far as the goal.

        Returns:
            Weights `[num_parameters, 15]` and bias `[num_parameters]`, all scaled to [-1, 1]. A vector is the object's
            offset from the hand, a distance is the goal's offset from the object along its axis. In assembly it is the
            goal's offset from the ring, and lifts and drops are 5 cm longer. Position steps have the vector 0.
        """
        weights = torch.zeros(sum(self.parameter_dims), len(OBSERVED), dtype=torch.float32)
        bias = torch.zeros(sum(self.parameter_dims), dtype=torch.float32)
        ring = torch.tensor(RING_FROM_HANDLE_M, dtype=torch.float32)
        row = 0
        for action in ACTIONS[self.options.actions]:
            if action in PRIMITIVES and action.num_arguments == 3:
                weights[row : row + 3, _OBJECT] = torch.eye(3, dtype=torch.float32)
            elif action.num_arguments == 1:
                axis = torch.tensor(AXES[action.name], dtype=torch.float32)
                weights[row, _GOAL] = axis
                if self.options.task == "assembly":
                    bias[row] = _CLEARANCE_M * axis[2].abs() - axis @ ring
            row += action.num_arguments
        # Offsets are observed in [-1, 1], with 0 in the middle, so they need no bias.
        weights *= torch.as_tensor((HIGHEST - LOWEST) / 2.0)
        bounds = self.full_action_spec_unbatched[keys.PARAMETERS].space
        low, high = bounds.low.flatten().cpu(), bounds.high.flatten().cpu()
        half = (high - low) / 2.0
        return weights / half.unsqueeze(-1), (bias - (high + low) / 2.0) / half

    def references(self, measured: Mapping[str, float]) -> dict[str, dict[str, float]]:
        """Return what the hand-written player of the task reaches in an episode of five primitives."""
        if self.options.decisions != PrimitivesOptions().decisions:
            return {}
        reached = MEASURED[self.options.task]
        return {"player of primitives": {"score": reached[self.options.reward], "success": reached["success"]}}
