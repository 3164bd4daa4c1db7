"""The model of PETS: an ensemble that predicts the change of the state, the end and the reward of a step.

Source: Chua, Calandra, McAllister and Levine 2018, arXiv 1805.12114. See `learner.py` for what differs.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from hpamdp.policies.low_level.pets.options import PETSOptions
from hpamdp.policies.shared.canonical_frame import CanonicalFrame, joined
from hpamdp.policies.shared.joint_choice import JointChoice
from hpamdp.policies.shared.networks import EnsembleLinear, in_float32
from hpamdp.policies.shared.planning import Prediction
from hpamdp.policies.shared.scales import scale_of
from hpamdp.specs import PAMDPSpecs

_LOG_VARIANCE_LOW, _LOG_VARIANCE_HIGH = -10.0, 1.0  # of a scaled change
_RIDGE = 0.3  # of the linear part, whose inputs have a deviation of about 1


class MemberNet(nn.Module):
    """Independent networks with ReLU, one for each member, `[E, B, in]` -> `[E, B, out]`."""

    def __init__(self, num_members: int, in_dim: int, hidden_dims: Sequence[int], out_dim: int) -> None:
        super().__init__()
        dims = [in_dim, *hidden_dims, out_dim]
        layers = [EnsembleLinear(num_members, size, next_size) for size, next_size in pairwise(dims)]
        for layer in layers:
            nn.init.normal_(layer.weight, 0.0, 0.7 * (2.0 / layer.weight.shape[1]) ** 0.5)
            nn.init.zeros_(layer.bias)
        self.layers = nn.ModuleList(layers)

    def forward(self, x: Tensor, precision: torch.dtype = torch.float32, output_map: Tensor | None = None) -> Tensor:
        """Apply each member to its own slice of `x`.

        Args:
            x: `[E, B, in]`.
            precision: of the inputs and the hidden layers; the last layer is computed in float32 (see `in_float32`).
            output_map: `[out, M]`, by which the output is multiplied; as part of the last layer, it costs nothing.
        """
        x = x.mT.to(precision)  # [E, in, B]: see `joined`
        *hidden, last = (layer for layer in self.layers if isinstance(layer, EnsembleLinear))
        for layer in hidden:
            x = torch.baddbmm(layer.bias.to(precision).mT, layer.weight.to(precision).mT, x).relu_()

        def output(x: Tensor) -> Tensor:
            terms: tuple[Tensor, Tensor] = last.bias, last.weight
            if output_map is not None:
                terms = terms[0] @ output_map, terms[1] @ output_map
            return torch.baddbmm(terms[0].mT, terms[1].mT, x)

        return in_float32(output, x.float()).mT


class PETSModel(nn.Module):
    """`num_members` models of a step: the change of the state, then its end and its reward.

    With a memory, the networks also see a context: what is remembered of the observations before the state. The context
    is not predicted. If directions are revealed, the context is their table, of which the networks only see how certain
    the action's own direction is.

    Args:
        specs: of the problem.
        options: the settings.
        context_dim: entries of the context; 0 without a memory.
        is_revealed: whether the context is a table of `KnownDirections`.
    """

    def __init__(
        self, specs: PAMDPSpecs, options: PETSOptions, context_dim: int = 0, *, is_revealed: bool = False
    ) -> None:
        super().__init__()
        dim = specs.observation_dim
        self.context_dim = context_dim
        self.num_members = options.num_members
        self.is_probabilistic = options.probabilistic
        self.frame = CanonicalFrame(specs, is_used=options.augment is not False, is_revealed=is_revealed)
        self.has_linear_part = not self.frame.turns if options.linear_part == "auto" else options.linear_part
        self.joint = None if specs.components.is_single else JointChoice(specs)
        kinds = self.frame.kind.tolist()
        of_kinds = zip(kinds, specs.parameter_dims, strict=True)
        slots = sorted({(kind, slot) for kind, num_slots in of_kinds for slot in range(num_slots)})
        places = torch.tensor(slots, dtype=torch.long).reshape(-1, 2)
        self.slot_kind = nn.Buffer(places[:, 0], persistent=False)
        self.slot_number = nn.Buffer(places[:, 1], persistent=False)
        self.has_kinds = self.frame.num_kinds > 1
        action_dim = 2 * len(slots) + (self.frame.num_kinds if self.has_kinds else 0) + int(is_revealed)
        seen_context_dim = 0 if is_revealed else context_dim
        num_vectors = self.frame.num_vectors
        feature_dim = 4 * num_vectors if num_vectors else 2 * dim
        in_dim = dim + action_dim
        out_dim = dim * (2 if options.probabilistic else 1)
        self.transition = MemberNet(options.num_members, seen_context_dim + in_dim, options.transition_dims, out_dim)
        outcome_in_dim = seen_context_dim + in_dim + dim + feature_dim
        self.outcome = MemberNet(options.num_members, outcome_in_dim, options.outcome_dims, 3)
        # What a context means for a turned state is its direction alone: one model serves all of them.
        is_input = torch.ones(dim, dtype=torch.float32)
        if self.frame.turns and self.frame.geometry is not None:
            is_input[self.frame.geometry.entries_of_contexts] = 0.0
        self.state_mean = nn.Buffer(torch.zeros(dim, dtype=torch.float32))
        self.state_scale = nn.Buffer(torch.ones(dim, dtype=torch.float32))
        self.change_scale = nn.Buffer(torch.ones(dim, dtype=torch.float32))
        self.is_predicted = nn.Buffer(is_input.clone())
        self.is_changing = nn.Buffer(is_input.clone())
        self.derivation = nn.Buffer(torch.eye(dim, dtype=torch.float32))
        self.reward_mean = nn.Buffer(torch.zeros(2, dtype=torch.float32))
        self.reward_scale = nn.Buffer(torch.ones(2, dtype=torch.float32))
        self.feature_mean = nn.Buffer(torch.zeros(feature_dim, dtype=torch.float32))
        self.feature_scale = nn.Buffer(torch.ones(feature_dim, dtype=torch.float32))
        if seen_context_dim > 0:
            self.context_mean = nn.Buffer(torch.zeros(context_dim, dtype=torch.float32))
            self.context_scale = nn.Buffer(torch.ones(context_dim, dtype=torch.float32))
        if self.has_linear_part:
            self.linear_weight = nn.Buffer(torch.zeros(in_dim + len(slots) + 1, dim, dtype=torch.float32))
        self.is_input = nn.Buffer(is_input, persistent=False)

    def forward(
        self, state: Tensor, discrete: Tensor, own: Tensor, precision: torch.dtype = torch.float32
    ) -> Prediction:
        """Predict one step with every member, each from states of its own.

        Args:
            state: `[E, B, context_dim + observation_dim]`, the context first.
            discrete: discrete actions, or with several components numbered choices (`JointChoice`), `[E, B]`.
            own: parameters of the discrete actions, `[E, B, D]` in [-1, 1].
            precision: of the networks.
        """
        context, state = self.split(state)
        turned, direction, x = self._turned(context, state, discrete, own)
        if self.frame.is_revealed:
            context = None
        seen = self._with_context(context, x)
        if self.is_probabilistic:
            change = self._changed(self._sampled(self.transition(seen, precision)))
        else:
            change = self.transition(seen, precision, self._change_map())
        if self.has_linear_part:
            change = change + self._changed(self._linear_part(x))
        outcome = self._outcome(seen, turned, turned + change, precision)
        logit, terminating, continuing = outcome.unbind(-1)
        mean, scale = self.reward_mean, self.reward_scale
        return Prediction(
            turned + change if direction is None else self.frame.turn_back(turned + change, direction),
            continuing * scale[0] + mean[0],
            terminating * scale[1] + mean[1],
            logit,
        )

    def _turned(
        self, context: Tensor | None, state: Tensor, discrete: Tensor, own: Tensor
    ) -> tuple[Tensor, Tensor | None, Tensor]:
        """Return turned states, the directions that they were turned by, if any, and the networks' inputs."""
        direction, certainty = self._pointing(context, state, discrete)
        turned = state if direction is None else self.frame.turn(state, direction)
        kind = discrete if direction is None else self.frame.kind[discrete]
        return turned, direction, self._inputs(turned, self.action_inputs(kind, own, certainty))

    def inputs(self, state: Tensor, discrete: Tensor, own: Tensor) -> Tensor:
        """Return what the networks see of states and actions in the canonical frame, `[*B, in]`, without a memory.

        The arguments are those of `forward`, of any batch.
        """
        return self._turned(None, state, discrete, own)[2]

    def scaled_change(self, state: Tensor, discrete: Tensor, next_state: Tensor) -> Tensor:
        """Return predicted changes in the canonical frame and in units of the usual change, `[E, B, observation_dim]`.

        Args:
            state: `[E, B, context_dim + observation_dim]`, the context first.
            discrete: discrete actions, or numbered choices, `[E, B]`.
            next_state: what `forward` predicts, `[E, B, observation_dim]`.
        """
        context, before = self.split(state.float())
        after = next_state.float()
        direction, _ = self._pointing(context, before, discrete)
        if direction is not None:
            before, after = self.frame.turn(before, direction), self.frame.turn(after, direction)
        return (after - before) / self.change_scale

    def _pointing(self, context: Tensor | None, state: Tensor, discrete: Tensor) -> tuple[Tensor | None, Tensor | None]:
        """Return where actions point, `[E, B, 2]`, and how certain a revealed direction is, `[E, B, 1]`; else None."""
        if self.frame.is_revealed:
            assert context is not None
            return self.frame.revealed_direction(context, discrete)
        return (self.frame.direction(state, discrete) if self.joint is None else None), None

    def split(self, state: Tensor) -> tuple[Tensor | None, Tensor]:
        """Return contexts and observations, of `[*B, context_dim + observation_dim]`; no contexts without a memory."""
        if self.context_dim == 0:
            return None, state
        return state[..., : self.context_dim], state[..., self.context_dim :]

    def _with_context(self, context: Tensor | None, x: Tensor) -> Tensor:
        """Return what the networks see: a scaled context, and inputs `[*B, in]`."""
        return x if context is None else joined(_scaled(context, self.context_mean, self.context_scale), x)

    def action_inputs(self, kind: Tensor, own: Tensor, certainty: Tensor | None = None) -> Tensor:
        """Return what the networks see of actions of a kind `[*B]` with parameters `[*B, D]`.

        That is the kind, and each kind's own parameters and their squares, 0 for the other kinds. With several
        components, a kind is a numbered choice, of which the networks see what each component chose. If directions are
        revealed, the certainty `[*B, 1]` of the action's direction comes first.
        """
        if certainty is not None:
            return joined(certainty, self.action_inputs(kind, own))
        if self.joint is not None:
            value = self.joint.spread(kind, own)
            return joined(self.joint.is_chosen[kind].to(own.dtype), value, value.square())
        if not self.has_kinds:
            return joined(own, own.square())
        value = own[..., self.slot_number] * (kind.unsqueeze(-1) == self.slot_kind)
        return joined(F.one_hot(kind, self.frame.num_kinds).to(own.dtype), value, value.square())

    def in_frame(self, turned: Tensor, action: Tensor, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Predict a step in the canonical frame, to learn from it.

        Args:
            turned: states `[E, B, observation_dim]`.
            action: of `action_inputs`, `[E, B, *]`.
            context: `[E, B, context_dim]`; None without a memory.

        Returns:
            What the transition networks say, and what the outcome networks say: logit, scaled reward if the step
            terminates, and if it does not. The loss of the latter does not reach the former.
        """
        x = self._inputs(turned, action)
        seen = self._with_context(context, x)
        transition = self.transition(seen)
        scaled = transition.detach()
        if self.is_probabilistic:
            scaled = self._sampled(scaled)
        if self.has_linear_part:
            scaled = scaled + self._linear_part(x)
        return transition, self._outcome(seen, turned, turned + self._changed(scaled), torch.float32)

    def target_change(self, turned: Tensor, action: Tensor, next_turned: Tensor) -> Tensor:
        """Return the scaled change that is left to the transition networks, `[B, observation_dim]`.

        Args:
            turned, next_turned: states `[B, observation_dim]` in the canonical frame.
            action: of `action_inputs`, `[B, *]`.
        """
        change = (next_turned - turned) / self.change_scale
        return change - self._linear_part(self._inputs(turned, action)) if self.has_linear_part else change

    def _linear_part(self, x: Tensor) -> Tensor:
        """Return the scaled change by the linear model, of the networks' inputs `[*B, in]`."""
        weight, of_cubes, bias = self.linear_weight.split([x.shape[-1], len(self.slot_kind), 1])
        return in_float32(lambda x: x @ weight + self._parameters_in(x) ** 3 @ of_cubes + bias, x)

    def _parameters_in(self, x: Tensor) -> Tensor:
        """Return the parameters of all slots, of the networks' inputs."""
        end = x.shape[-1] - len(self.slot_kind)
        return x[..., end - len(self.slot_kind) : end]

    def _inputs(self, turned: Tensor, action: Tensor) -> Tensor:
        return joined(_scaled(turned, self.state_mean, self.state_scale, self.is_input), action)

    def _outcome(self, seen: Tensor, turned: Tensor, next_turned: Tensor, precision: torch.dtype) -> Tensor:
        next_x = _scaled(next_turned, self.state_mean, self.state_scale, self.is_changing)
        features = _scaled(self.features(turned, next_turned), self.feature_mean, self.feature_scale)
        return self.outcome(joined(seen, next_x, features), precision)

    def _change_map(self) -> Tensor:
        """Return the map `[observation_dim, observation_dim]` from scaled changes to changes of the state."""
        return (self.is_predicted * self.change_scale).unsqueeze(-1) * self.derivation

    def _changed(self, scaled: Tensor) -> Tensor:
        """Return the changes of the state, given scaled changes."""
        return in_float32(lambda scaled: scaled @ self._change_map(), scaled)

    def _sampled(self, transition: Tensor) -> Tensor:
        """Return scaled changes, sampled from what the transition networks say."""
        mean, log_variance = self.moments(transition)
        return mean + (0.5 * log_variance).exp() * torch.randn_like(mean)

    def moments(self, transition: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and log-variance of the scaled change, from what the transition networks say."""
        mean, raw = transition.chunk(2, -1)
        return mean, _LOG_VARIANCE_LOW + (_LOG_VARIANCE_HIGH - _LOG_VARIANCE_LOW) * raw.sigmoid()

    def features(self, turned: Tensor, next_turned: Tensor) -> Tensor:
        """Return what helps to tell where a step ends, of states before and after it in the canonical frame.

        With V vectors of the plane, the features are `[*B, 4 V]`: the lengths before and after the step, the smallest
        length on the straight way between, and how far off the x axis each vector was. Else they are the squares of all
        entries before and after the step, `[*B, 2 observation_dim]`, of which lengths are made.
        """
        if not self.frame.num_vectors:
            mean, scale = self.state_mean, self.state_scale
            return joined(_scaled(turned, mean, scale), _scaled(next_turned, mean, scale, self.is_changing)).square()
        x, y = self.frame.vectors(turned)
        next_x, next_y = self.frame.vectors(next_turned)
        way_x, way_y = next_x - x, next_y - y
        along = -(x * way_x + y * way_y) / (way_x.square() + way_y.square()).clamp(min=1e-12)
        along = along.clamp(0.0, 1.0)
        lengths = [torch.hypot(x + part * way_x, y + part * way_y) for part in (0.0, 1.0, along)]
        return joined(*lengths, y.abs())

    @torch.no_grad()
    def fit_scales(
        self, turned: Tensor, action: Tensor, next_turned: Tensor, reward: Tensor, terminated: Tensor
    ) -> None:
        """Set the scales of inputs and targets, which changes are derived from others, and the linear part.

        Args:
            turned, next_turned: states `[B, observation_dim]` in the canonical frame.
            action: of `action_inputs`, `[B, *]`.
            reward: `[B]`.
            terminated: bool `[B]`.
        """
        self.state_mean.copy_(turned.mean(0))
        self.state_scale.copy_(scale_of(turned))
        change = (next_turned - turned)[~terminated]
        if len(change) > 1:
            self.change_scale.copy_(scale_of(change))
            self.is_changing.copy_((change.abs().amax(0) > 1e-6).float() * self.is_input)
            self._derive(change / self.change_scale)
            if self.has_linear_part:
                self._fit_linear_part(self._inputs(turned, action)[~terminated], change / self.change_scale)
        for place, rows in enumerate((reward[~terminated], reward[terminated])):
            if len(rows) > 1:
                self.reward_mean[place] = rows.mean()
                self.reward_scale[place] = scale_of(rows)
        features = self.features(turned, next_turned)
        self.feature_mean.copy_(features.mean(0))
        self.feature_scale.copy_(scale_of(features))

    @torch.no_grad()
    def fit_context_scales(self, context: Tensor) -> None:
        """Set the scales of contexts, `[B, context_dim]`."""
        self.context_mean.copy_(context.mean(0))
        self.context_scale.copy_(scale_of(context))

    def _derive(self, change: Tensor) -> None:
        """Find the entries whose scaled changes `[B, observation_dim]` are linear in those of entries before them."""
        dim = change.shape[-1]
        is_predicted = [False] * dim
        derivation = torch.zeros(dim, dim, dtype=torch.float64, device=change.device)
        columns = change.double()
        if len(columns) < 4 * dim:  # too few to tell
            self.is_predicted.copy_(self.is_input)
            return
        for entry in range(dim):
            if self.is_changing[entry] == 0.0:
                continue
            column = columns[:, entry]
            basis = [place for place in range(dim) if is_predicted[place]]
            if basis:
                solved = torch.linalg.lstsq(columns[:, basis], column.unsqueeze(-1), driver="gelsd")
                weight = solved.solution.squeeze(-1)
                if (columns[:, basis] @ weight - column).abs().amax() < 1e-3:
                    derivation[basis, entry] = weight
                    continue
            is_predicted[entry] = True
            derivation[entry, entry] = 1.0
        scale = self.change_scale.double()
        self.derivation.copy_(derivation * scale / scale.unsqueeze(-1))
        self.is_predicted.copy_(torch.tensor(is_predicted, device=change.device).float())

    def _fit_linear_part(self, x: Tensor, change: Tensor) -> None:
        """Fit the linear model to the networks' inputs `[B, in]` and the scaled changes `[B, observation_dim]`.

        It is ridge regression on the inputs and the cubes of the parameters. Entries whose changes it predicts worse
        than no change does, each step by the fit to all others, are left to the networks.
        """
        inputs = torch.cat([x, self._parameters_in(x) ** 3, torch.ones_like(x[:, :1])], -1).double()
        ridge = torch.full_like(inputs[0], _RIDGE)
        ridge[-1] = 1e-6
        solver = torch.linalg.solve(inputs.mT @ inputs + ridge.diag(), inputs.mT)
        weight = solver @ change.double()
        leverage = (inputs * solver.mT).sum(-1, keepdim=True)
        error = (change - inputs @ weight) / (1.0 - leverage).clamp(min=0.05)
        self.linear_weight.copy_(weight * (error.square().mean(0) < change.square().mean(0)))


def _scaled(rows: Tensor, mean: Tensor, scale: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return `(rows - mean) / scale * mask` in one pass."""
    factor = 1.0 / scale if mask is None else mask / scale
    return torch.addcmul(-mean * factor, rows, factor)
