"""The sizes and bounds of a parameterised-action problem: all that learners and selectors get to know of it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torchrl.envs import EnvBase

from hpamdp import keys


@dataclass(frozen=True)
class PAMDPSpecs:
    """Sizes and bounds of one problem.

    Attributes:
        observation_dim: length of the observation.
        option_names: the options that the agent chooses from at a decision; none where there is no choice.
        parameter_dims: how many parameters each key takes, `num_keys` entries; they lie side by side in the action.
        parameter_low, parameter_high: bounds of all parameters, `sum(parameter_dims)` entries.
    """

    observation_dim: int
    option_names: tuple[str, ...]
    parameter_dims: tuple[int, ...]
    parameter_low: tuple[float, ...]
    parameter_high: tuple[float, ...]

    @property
    def num_options(self) -> int:
        """How many options there are."""
        return len(self.option_names)

    @property
    def num_discrete(self) -> int:
        """How many keys (discrete actions) there are."""
        return len(self.parameter_dims)

    @property
    def num_parameters(self) -> int:
        """How many parameters all keys take together."""
        return sum(self.parameter_dims)

    @property
    def parameter_mask(self) -> Tensor:
        """Return bool `[num_keys, num_parameters]`: which parameters are each key's own."""
        owner = torch.repeat_interleave(torch.arange(self.num_discrete), torch.tensor(self.parameter_dims))
        return owner == torch.arange(self.num_discrete).unsqueeze(-1)

    def to_unit(self, parameters: Tensor) -> Tensor:
        """Map parameters `[*B, num_parameters]` from their bounds to [-1, 1]."""
        low, high = parameters.new_tensor(self.parameter_low), parameters.new_tensor(self.parameter_high)
        return 2.0 * (parameters - low) / (high - low) - 1.0

    def from_unit(self, unit: Tensor) -> Tensor:
        """Map `[*B, num_parameters]` in [-1, 1] to the parameters' bounds."""
        low, high = unit.new_tensor(self.parameter_low), unit.new_tensor(self.parameter_high)
        return low + (unit + 1.0) * 0.5 * (high - low)

    def with_option_observed(self) -> PAMDPSpecs:
        """Return the specs of a learner whose observation ends in the one-hot option."""
        return replace(self, observation_dim=self.observation_dim + self.num_options)

    @classmethod
    def from_env(cls, env: EnvBase) -> PAMDPSpecs:
        """Read the sizes off an environment whose action has the leaves `keys.KEY` and `keys.DURATION`."""
        action = env.full_action_spec_unbatched
        duration = action[keys.PARAMETERS]
        return cls(
            observation_dim=env.observation_spec_unbatched[keys.OBSERVATION].shape[-1],
            option_names=tuple(env.option_names) if keys.OPTION in action.keys() else (),
            parameter_dims=tuple(env.parameter_dims),
            parameter_low=tuple(duration.space.low.flatten().tolist()),
            parameter_high=tuple(duration.space.high.flatten().tolist()),
        )
