"""Describe a problem for learners and selectors: sizes and bounds, masks and symmetries."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor
from torchrl.envs import EnvBase

from hpamdp import keys
from hpamdp.geometry import PlaneGeometry, Symmetries


@dataclass(frozen=True)
class PAMDPSpecs:
    """Sizes and bounds of one problem.

    Attributes:
        observation_dim: length of the observation.
        option_names: the options that the agent chooses from at a decision; empty if there is no choice.
        parameter_dims: number of parameters of each discrete action, `num_discrete` entries. The parameters of all
            actions lie side by side.
        parameter_low, parameter_high: bounds of all parameters, `sum(parameter_dims)` entries.
        initial_weight: rows `[num_parameters, observation_dim]` of the linear map from an observation to the published
            initial parameters in [-1, 1]; None if the problem has none.
        initial_bias: bias of this map, `num_parameters` entries.
        has_action_mask: whether the environment writes the allowed discrete actions, `action_mask`.
        has_option_mask: whether the environment writes the allowed options, `option_mask`.
        option_actions: whether each option allows each discrete action, `num_options` rows of `num_discrete` entries;
            None if options are not sets of discrete actions.
        held_option: number of the option that the learner serves; None if the observation ends in the one-hot option,
            or if there is no option.
        symmetries: maps under which neither dynamics nor reward change; None if the problem declares none.
        geometry: vectors of the plane in the observation and directions of the discrete actions; None if the problem
            declares none.
    """

    observation_dim: int
    option_names: tuple[str, ...]
    parameter_dims: tuple[int, ...]
    parameter_low: tuple[float, ...]
    parameter_high: tuple[float, ...]
    initial_weight: tuple[tuple[float, ...], ...] | None = None
    initial_bias: tuple[float, ...] | None = None
    has_action_mask: bool = False
    has_option_mask: bool = False
    option_actions: tuple[tuple[bool, ...], ...] | None = None
    held_option: int | None = None
    symmetries: Symmetries | None = field(default=None, compare=False, repr=False)
    geometry: PlaneGeometry | None = field(default=None, compare=False, repr=False)

    @property
    def num_options(self) -> int:
        """Number of options."""
        return len(self.option_names)

    @property
    def num_discrete(self) -> int:
        """Number of discrete actions."""
        return len(self.parameter_dims)

    @property
    def num_parameters(self) -> int:
        """Number of parameters of all discrete actions together."""
        return sum(self.parameter_dims)

    @property
    def parameter_owner(self) -> Tensor:
        """Return int64 `[num_parameters]`: the discrete action that each parameter belongs to."""
        return torch.repeat_interleave(torch.arange(self.num_discrete), torch.tensor(self.parameter_dims))

    @property
    def parameter_mask(self) -> Tensor:
        """Return bool `[num_discrete, num_parameters]`: which parameters are each discrete action's own."""
        return self.parameter_owner == torch.arange(self.num_discrete).unsqueeze(-1)

    @property
    def parameter_slots(self) -> Tensor:
        """Return int64 `[num_discrete, max(parameter_dims)]`: the indices of each discrete action's own parameters.

        If an action has fewer than the maximum, indices of other actions' parameters follow.
        """
        return (~self.parameter_mask).to(torch.int8).argsort(dim=-1, stable=True)[:, : max(self.parameter_dims)]

    def to_unit(self, parameters: Tensor) -> Tensor:
        """Map parameters `[*B, num_parameters]` from their bounds to [-1, 1]."""
        low, high = parameters.new_tensor(self.parameter_low), parameters.new_tensor(self.parameter_high)
        return 2.0 * (parameters - low) / (high - low) - 1.0

    def from_unit(self, unit_parameters: Tensor) -> Tensor:
        """Map parameters `[*B, num_parameters]` from [-1, 1] to their bounds."""
        low = unit_parameters.new_tensor(self.parameter_low)
        high = unit_parameters.new_tensor(self.parameter_high)
        return low + (unit_parameters + 1.0) * 0.5 * (high - low)

    def allowed(self, observation: Tensor, action_mask: Tensor | None = None) -> Tensor | None:
        """Return whether a learner may take each discrete action, bool `[*B, num_discrete]`; None if all are allowed.

        Args:
            observation: the learner's observation, `[*B, observation_dim]`.
            action_mask: the actions that the environment allows, `[*B, num_discrete]`; None if it allows all.
        """
        if self.option_actions is None:
            return action_mask
        of_options = torch.tensor(self.option_actions, device=observation.device)
        if self.held_option is None:
            own = of_options[observation[..., -self.num_options :].argmax(-1)]
        else:
            own = of_options[self.held_option].expand(*observation.shape[:-1], -1)
        return own if action_mask is None else own & action_mask

    def with_option_observed(self) -> PAMDPSpecs:
        """Return the specs of a learner whose observation ends in the one-hot option."""
        weight = self.initial_weight
        if weight is not None:
            weight = tuple((*row, *[0.0] * self.num_options) for row in weight)
        dim = self.observation_dim
        symmetries, geometry = self.symmetries, self.geometry
        return replace(
            self,
            observation_dim=dim + self.num_options,
            initial_weight=weight,
            symmetries=None if symmetries is None else symmetries.with_option_observed(dim, self.num_options),
            geometry=None if geometry is None else geometry.with_option_observed(dim),
        )

    def of_option(self, option: int) -> PAMDPSpecs:
        """Return the specs of a learner that serves one option."""
        symmetries, geometry = self.symmetries, self.geometry
        return replace(
            self,
            held_option=option,
            symmetries=None if symmetries is None else symmetries.of_option(option),
            geometry=None if geometry is None else geometry.of_option(option),
        )

    @property
    def telling_entries(self) -> list[int]:
        """The entries of the observation that are not redundant; all entries if the problem declares no geometry."""
        redundant = () if self.geometry is None else self.geometry.redundant
        return [entry for entry in range(self.observation_dim) if entry not in redundant]

    def with_telling_entries(self) -> PAMDPSpecs:
        """Return the specs of observations reduced to the `telling_entries`."""
        entries = self.telling_entries
        symmetries, geometry = self.symmetries, self.geometry
        weight = self.initial_weight
        return replace(
            self,
            observation_dim=len(entries),
            initial_weight=None if weight is None else tuple(tuple(row[entry] for entry in entries) for row in weight),
            symmetries=None if symmetries is None else symmetries.with_entries(entries),
            geometry=None if geometry is None else geometry.with_entries(entries),
        )

    @classmethod
    def from_env(cls, env: EnvBase) -> PAMDPSpecs:
        """Return the specs of a `PAMDPEnv`.

        Raises:
            ValueError: the initial parameters, symmetries or geometry do not fit the observation and the action.
        """
        action = env.full_action_spec_unbatched
        parameters = action[keys.PARAMETERS]
        observation_dim = env.observation_spec_unbatched[keys.OBSERVATION].shape[-1]
        num_parameters = sum(env.parameter_dims)
        initial = env.initial_parameters()
        weight = bias = None
        if initial is not None:
            shapes = [list(part.shape) for part in initial]
            expected = [[num_parameters, observation_dim], [num_parameters]]
            if shapes != expected:
                raise ValueError(f"initial_parameters: shapes {shapes}, but must be {expected}")
            weight = tuple(tuple(row) for row in initial[0].tolist())
            bias = tuple(initial[1].tolist())
        symmetries, geometry = env.symmetries, env.geometry
        num_discrete = len(env.parameter_dims)
        misfits: dict[str, str] = {}
        if symmetries is not None:
            misfits["symmetries"] = symmetries.fits(observation_dim, num_discrete, num_parameters)
        if geometry is not None:
            misfits["geometry"] = geometry.fits(observation_dim, env.parameter_dims)
        for name, misfit in misfits.items():
            if misfit:
                raise ValueError(f"{name}: {misfit}")
        has_action_mask = keys.ACTION_MASK in env.observation_spec_unbatched.keys()
        if has_action_mask or env.option_actions is not None:
            symmetries = None  # they do not say how masks, and options that are sets of actions, are mapped
        return cls(
            observation_dim=observation_dim,
            option_names=tuple(env.option_names) if keys.OPTION in action.keys() else (),
            parameter_dims=tuple(env.parameter_dims),
            parameter_low=tuple(parameters.space.low.flatten().tolist()),
            parameter_high=tuple(parameters.space.high.flatten().tolist()),
            initial_weight=weight,
            initial_bias=bias,
            has_action_mask=has_action_mask,
            has_option_mask=keys.OPTION_MASK in env.observation_spec_unbatched.keys(),
            option_actions=env.option_actions,
            symmetries=symmetries,
            geometry=geometry,
        )
