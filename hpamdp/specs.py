"""Describe a problem for learners and selectors: sizes and bounds, masks and symmetries."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeAlias

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase

from hpamdp import keys
from hpamdp.components import Components
from hpamdp.geometry import PlaneGeometry, Symmetries
from hpamdp.messages import ProblemError, as_code
from hpamdp.observation_entries import ObservationEntry, observation_dtype

# A step or a batch of steps, by name.
Rows: TypeAlias = TensorDictBase | Mapping[str, Tensor]


@dataclass(frozen=True)
class PAMDPSpecs:
    """Sizes and bounds of one problem.

    Attributes:
        observation_dim: length of the observation.
        option_names: the options that the agent chooses from at a decision; empty if there is no choice.
        parameter_dims: number of parameters of each discrete action, `num_discrete` entries. The parameters of all
            actions lie side by side.
        parameter_low, parameter_high: bounds of all parameters, `sum(parameter_dims)` entries.
        component_sizes: number of discrete actions of each component of the action, see `hpamdp.components`; empty if
            the action is a single choice among all discrete actions.
        integer_parameters: whether each parameter is a whole number; empty if none is.
        has_parameter_bounds: whether the environment writes bounds of the current state, `parameter_low` and
            `parameter_high`.
        bounds_place: place in the observation where the lower bounds of all parameters begin, followed by the upper
            bounds on the same scale. None if the observation does not hold them.
        initial_weight: rows `[num_parameters, observation_dim]` of the linear map from an observation to the published
            initial parameters in [-1, 1]; None if the problem has none.
        initial_bias: bias of this map, `num_parameters` entries.
        has_action_mask: whether the environment writes the allowed discrete actions, `action_mask`.
        has_pair_mask: whether the environment writes which discrete actions go together, `pair_mask`.
        has_option_mask: whether the environment writes the allowed options, `option_mask`.
        option_actions: whether each option allows each discrete action, `num_options` rows of `num_discrete` entries;
            None if options are not sets of discrete actions.
        held_option: number of the option that the learner serves; None if the observation ends in the one-hot option,
            or if there is no option.
        symmetries: maps under which neither dynamics nor reward change; None if the problem declares none.
        geometry: vectors of the plane in the observation and directions of the discrete actions; None if the problem
            declares none.
        entries: the entries of the observation if any of them is a picture; empty if the observation is a vector.
        encoder: makes the module that encodes an entry; None for the default. See `hpamdp.policies.encoders.base`.
    """

    observation_dim: int
    option_names: tuple[str, ...]
    parameter_dims: tuple[int, ...]
    parameter_low: tuple[float, ...]
    parameter_high: tuple[float, ...]
    initial_weight: tuple[tuple[float, ...], ...] | None = field(default=None, compare=False)
    initial_bias: tuple[float, ...] | None = field(default=None, compare=False)
    has_action_mask: bool = False
    has_option_mask: bool = False
    option_actions: tuple[tuple[bool, ...], ...] | None = None
    held_option: int | None = None
    component_sizes: tuple[int, ...] = ()
    integer_parameters: tuple[bool, ...] = ()
    has_parameter_bounds: bool = False
    bounds_place: int | None = None
    has_pair_mask: bool = False
    symmetries: Symmetries | None = field(default=None, compare=False, repr=False)
    geometry: PlaneGeometry | None = field(default=None, compare=False, repr=False)
    entries: tuple[ObservationEntry, ...] = ()
    encoder: Callable[[ObservationEntry], nn.Module] | None = field(default=None, compare=False, repr=False)

    @property
    def has_pictures(self) -> bool:
        """Whether an entry of the observation is a picture."""
        return any(entry.is_picture for entry in self.entries)

    @property
    def observation_dtype(self) -> torch.dtype:
        """Dtype of the observation: uint8 if all entries are pictures, otherwise float32."""
        return observation_dtype(self.entries)

    @property
    def num_options(self) -> int:
        """Number of options."""
        return len(self.option_names)

    @property
    def num_discrete(self) -> int:
        """Number of discrete actions, of all components together."""
        return len(self.parameter_dims)

    @cached_property
    def components(self) -> Components:
        """The components of the action."""
        return Components(self.component_sizes or (self.num_discrete,))

    @property
    def num_components(self) -> int:
        """Number of components of the action."""
        return len(self.components.sizes)

    @property
    def has_integers(self) -> bool:
        """Whether a parameter is a whole number."""
        return any(self.integer_parameters)

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

    def to_unit(self, parameters: Tensor, step: Rows | None = None) -> Tensor:
        """Map parameters `[*B, num_parameters]` from their bounds to [-1, 1]; see `from_unit`.

        A parameter whose bounds are equal is mapped to 0.

        Args:
            parameters: the parameters.
            step: holds the bounds of the state if `has_parameter_bounds`.
        """
        low, high = self._cell_bounds(parameters, step)
        if not self.has_parameter_bounds:
            return 2.0 * (parameters - low) / (high - low) - 1.0
        is_free = high > low
        width = torch.where(is_free, high - low, 1.0)
        return torch.where(is_free, 2.0 * (parameters - low) / width - 1.0, 0.0).clamp(-1.0, 1.0)

    def from_unit(self, unit_parameters: Tensor, step: Rows | None = None) -> Tensor:
        """Map parameters `[*B, num_parameters]` from [-1, 1] to their bounds.

        Whole numbers share [-1, 1] in cells of equal width, so that the smallest and the largest are as frequent as the
        others; `to_unit` gives the middle of a cell.

        Args:
            unit_parameters: the parameters in [-1, 1].
            step: holds the bounds of the state, `parameter_low` and `parameter_high`, if `has_parameter_bounds`. All
                results lie within them.
        """
        low, high = self._cell_bounds(unit_parameters, step)
        parameters = low + (unit_parameters + 1.0) * 0.5 * (high - low)
        if not self.has_integers and not self.has_parameter_bounds:
            return parameters
        if self.has_integers:
            parameters = torch.where(self._is_integer(parameters.device), parameters.round(), parameters)
        return parameters.clamp(*self.bounds(unit_parameters, step))

    def bounds(self, like: Tensor, step: Rows | None = None) -> tuple[Tensor, Tensor]:
        """Return the smallest and the largest value of each parameter, `[num_parameters]`, or of a step, `[*B, ...]`.

        Args:
            like: a tensor of the type and on the device to use.
            step: holds the bounds of the state if `has_parameter_bounds`.
        """
        if not self.has_parameter_bounds:
            return like.new_tensor(self.parameter_low), like.new_tensor(self.parameter_high)
        if step is None:
            raise ValueError("the bounds of the parameters depend on the state: pass the step that holds them")
        low, high = (step[name].to(like.dtype) for name in (keys.PARAMETER_LOW, keys.PARAMETER_HIGH))
        return low, high

    def is_fixed(self, observation: Tensor) -> Tensor | None:
        """Return which parameters have equal bounds in a state, and so a single value, bool `[*B, num_parameters]`.

        `to_unit` maps them to 0. If None, the observation does not tell.

        Args:
            observation: `[*B, observation_dim]`.
        """
        if self.bounds_place is None:
            return None
        seen = observation[..., self.bounds_place : self.bounds_place + 2 * self.num_parameters]
        low, high = seen.chunk(2, -1)
        return low >= high

    def in_cells(self, unit_parameters: Tensor) -> Tensor:
        """Return parameters `[*B, num_parameters]` in [-1, 1] with whole numbers in the middle of their cells.

        The gradient passes as if nothing was changed (straight-through: Bengio, Leonard and Courville 2013, arXiv
        1308.3432). If bounds depend on the state, the number of cells does, too, and nothing is changed.
        """
        if not self.has_integers or self.has_parameter_bounds:
            return unit_parameters
        centred = self.to_unit(self.from_unit(unit_parameters.detach()))
        moved = torch.where(self._is_integer(centred.device), centred - unit_parameters.detach(), 0.0)
        return unit_parameters + moved

    def _cell_bounds(self, like: Tensor, step: Rows | None) -> tuple[Tensor, Tensor]:
        """Return the bounds of the parameters, half a cell further apart on both sides for whole numbers."""
        low, high = self.bounds(like, step)
        if not self.has_integers:
            return low, high
        half = torch.where(self._is_integer(like.device), 0.5, 0.0).to(like.dtype)
        return low - half, high + half

    def _is_integer(self, device: torch.device) -> Tensor:
        return torch.tensor(self.integer_parameters, device=device)

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
            entries=(*self.entries, ObservationEntry(keys.OPTION, dim, (self.num_options,))) if self.entries else (),
        )

    def with_option_lengths(self, lengths: Sequence[int]) -> PAMDPSpecs:
        """Return the specs of a selector whose options are pairs of an option and its length in steps.

        The pairs of an option are neighbours. What the problem declares of its options alone is left out.
        """
        return replace(
            self,
            option_names=tuple(f"{name}_{length}" for name in self.option_names for length in lengths),
            option_actions=None,
            symmetries=None,
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
            bounds_place=self.bounds_place if len(entries) == self.observation_dim else None,
            initial_weight=None if weight is None else tuple(tuple(row[entry] for entry in entries) for row in weight),
            symmetries=None if symmetries is None else symmetries.with_entries(entries),
            geometry=None if geometry is None else geometry.with_entries(entries),
        )

    @classmethod
    def from_env(cls, env: EnvBase) -> PAMDPSpecs:
        """Return the specs of a `PAMDPEnv`.

        Raises:
            ValueError: it is no `PAMDPEnv`, or the initial parameters, symmetries or geometry do not fit the
                observation and the action.
            ProblemError: the bounds of a parameter are equal, crossed or not finite, and no state gives others.
        """
        if not hasattr(env, "parameter_dims"):
            raise ValueError(f"from_env: {as_code(env)} is no PAMDPEnv; hpamdp.make makes one")
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
        observed = env.observation_spec_unbatched.keys()
        has_action_mask = keys.ACTION_MASK in observed
        has_parameter_bounds = keys.PARAMETER_LOW in observed
        low, high = parameters.space.low.flatten(), parameters.space.high.flatten()
        _check_bounds(env, low, high, have_others=has_parameter_bounds)
        if has_action_mask or has_parameter_bounds or env.option_actions is not None or len(env.component_sizes) > 1:
            symmetries = None  # they do not say how masks, bounds, components and sets of actions are mapped
        if len(env.component_sizes) > 1:
            geometry = None  # nor does it say where several discrete actions at once point
        return cls(
            observation_dim=observation_dim,
            option_names=tuple(env.option_names) if keys.OPTION in action.keys() else (),
            parameter_dims=tuple(env.parameter_dims),
            parameter_low=tuple(low.tolist()),
            parameter_high=tuple(high.tolist()),
            component_sizes=tuple(env.component_sizes) if len(env.component_sizes) > 1 else (),
            integer_parameters=tuple(env.integer_parameters) if any(env.integer_parameters) else (),
            has_parameter_bounds=has_parameter_bounds,
            bounds_place=env.bounds_place if has_parameter_bounds else None,
            initial_weight=weight,
            initial_bias=bias,
            has_action_mask=has_action_mask,
            has_pair_mask=keys.PAIR_MASK in observed,
            has_option_mask=keys.OPTION_MASK in observed,
            option_actions=env.option_actions,
            symmetries=symmetries,
            geometry=geometry,
            entries=env.observation_entries,
        )


def _check_bounds(env: EnvBase, low: Tensor, high: Tensor, *, have_others: bool) -> None:
    """Refuse bounds `[num_parameters]` of an environment's parameters between which nothing can be scaled.

    Args:
        env: the environment.
        low, high: the bounds.
        have_others: whether states give bounds of their own.

    Raises:
        ProblemError: the message names the first parameter with such bounds.
    """
    is_whole = torch.tensor(env.integer_parameters or [False] * len(low), dtype=torch.bool, device=low.device)
    is_wrong = ~(low.isfinite() & high.isfinite() & ((low < high) | (is_whole & (low == high))))
    if is_wrong.any() and not have_others:
        place = int(is_wrong.nonzero()[0])
        given = f"{type(env).__name__}: parameter {place}: bounds {low[place]:.6g} and {high[place]:.6g}"
        raise ProblemError(f"{given}, but the lower must be less than the upper, both finite")
