"""PETS for parameterised actions: an ensemble learns the problem, every action is the first one of a plan in it.

Members predict the next state, the reward and the end of an episode. A plan tries every sequence of discrete actions,
each with Gaussians of its own for their parameters. To explore, an environment follows the plans of a single member
until its episode ends; a greedy plan takes the mean of all members' returns. Meant for few steps: some hundreds.

Sources: Chua, Calandra, McAllister and Levine 2018, *Deep Reinforcement Learning in a Handful of Trials using
Probabilistic Dynamics Models*, arXiv 1805.12114: the ensemble, the probabilistic members, and a member for each
imagined trajectory (TS-infinity). Posterior sampling: Osband, Russo and Van Roy 2013, arXiv 1306.0940. Reward and
termination of parameterised actions: Zhang et al. 2024, arXiv 2404.03037. Symmetry: van der Pol et al. 2020, arXiv
2006.16908.

Differs from the sources:
- the model has two stages: a small network predicts the change of the state in a step that does not terminate, and a
  larger one, which sees where the step would lead by that prediction, whether it terminates and what it earns. An
  end, such as at a wall or in a target, is a matter of where a step leads;
- where the problem declares its geometry, states are turned until the discrete action points along +x before the
  networks see them, with the lengths of all vectors among the inputs; of other declared symmetries, the mapped steps
  are learned from as well (`augment`);
- where states are not turned, the change is a linear model, fitted by least squares, plus what the networks add to it
  (`linear_part`): some hundred steps tell networks alone little of such a problem;
- nor does an environment follow a single member there. Exploring plans are those of the mean of all members' returns
  plus their standard deviation (`posterior_sampling`, `optimism`): all members are sure that what has never earned
  anything never will, and agree best on actions that hardly do anything;
- with `epsilon` a share of the exploring actions is random, for rewards that members which never met them agree not to
  expect;
- entries of the state whose changes depend linearly on those of others, such as a target's offset on one's own place,
  are not predicted but derived from them;
- members share the data and differ in their initial weights and their minibatches; there is no bootstrap;
- weight decay falls as steps come in, as the weight of a prior does;
- the parameters of each sequence of discrete actions are searched by themselves (`policies.shared.planning`);
- with `end_values` a plan also counts what its last state is worth (`policies.shared.end_values`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import ClassVar, Literal

import torch
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.nn import functional as F

from hpamdp import keys
from hpamdp.policies.base import is_greedy
from hpamdp.policies.masks import random_choice
from hpamdp.policies.shared.end_values import EndValues
from hpamdp.policies.shared.exploration import with_exploring_noise
from hpamdp.policies.shared.frame import CanonicalFrame, joined
from hpamdp.policies.shared.networks import EnsembleLinear
from hpamdp.policies.shared.planning import Found, Prediction, Returns, SequenceSearch, SequenceStep, discounted_return
from hpamdp.policies.shared.replay import ReplayLearner, ReplayOptions
from hpamdp.policies.shared.scales import scale_of
from hpamdp.settings import Expectile, Fraction, LearningRate, PositiveFraction
from hpamdp.specs import PAMDPSpecs

MEMBER = "member"  # which member an environment follows, int64 [*B]

_CHUNK_ROWS = 8192  # states predicted at once when planning: fits the cache and bounds the memory
_LOG_VARIANCE_LOW, _LOG_VARIANCE_HIGH = -10.0, 1.0  # of a scaled change
_LARGEST_COPIES = 16  # of a stored step under the problem's symmetries
_RIDGE = 0.3  # of the linear part, whose inputs have a deviation of about 1


class MemberNet(nn.Module):
    """Independent networks with ReLU, one for each member, `[E, B, in]` -> `[E, B, out]`."""

    def __init__(self, num_members: int, in_dim: int, hidden_dims: list[int], out_dim: int) -> None:
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
            precision: of the layers.
            output_map: `[out, M]`, by which the output is multiplied; as part of the last layer, it costs nothing.
        """
        x = x.mT.to(precision)  # [E, in, B]: see `joined`
        for place, layer in enumerate(self.layers):
            assert isinstance(layer, EnsembleLinear)
            terms: tuple[Tensor, Tensor] = layer.bias, layer.weight
            if output_map is not None and place == len(self.layers) - 1:
                terms = terms[0] @ output_map, terms[1] @ output_map
            bias, weight = (term.to(precision) for term in terms)
            x = torch.baddbmm(bias.mT, weight.mT, x)
            if place < len(self.layers) - 1:
                x = x.relu_()
        return x.mT.float()


class PETSModel(nn.Module):
    """`num_members` models of a step: the change of the state, then its end and its reward.

    Args:
        specs: of the problem.
        num_members: how many.
        transition_dims: hidden layers of the networks that predict the change.
        outcome_dims: hidden layers of those that predict end and reward.
        is_probabilistic: whether the change has a variance for each entry.
        uses_geometry: whether to turn states and add lengths where the problem declares its geometry.
        linear_part: whether a linear model predicts the change first; auto: where states are not turned.
    """

    state_mean: Tensor
    state_scale: Tensor
    change_scale: Tensor
    is_predicted: Tensor
    is_changing: Tensor
    is_input: Tensor
    derivation: Tensor
    linear_weight: Tensor
    reward_mean: Tensor
    reward_scale: Tensor
    feature_mean: Tensor
    feature_scale: Tensor
    slot_kind: Tensor
    slot_number: Tensor

    def __init__(
        self,
        specs: PAMDPSpecs,
        num_members: int,
        transition_dims: list[int],
        outcome_dims: list[int],
        *,
        is_probabilistic: bool,
        uses_geometry: bool,
        linear_part: Literal["auto"] | bool,
    ) -> None:
        super().__init__()
        dim = specs.observation_dim
        self.num_members = num_members
        self.is_probabilistic = is_probabilistic
        self.frame = CanonicalFrame(specs, is_used=uses_geometry)
        self.has_linear_part = not self.frame.turns if linear_part == "auto" else linear_part
        kinds = self.frame.kind.tolist()
        of_kinds = zip(kinds, specs.parameter_dims, strict=True)
        slots = sorted({(kind, slot) for kind, num_slots in of_kinds for slot in range(num_slots)})
        places = torch.tensor(slots, dtype=torch.long).reshape(-1, 2)
        self.register_buffer("slot_kind", places[:, 0], persistent=False)
        self.register_buffer("slot_number", places[:, 1], persistent=False)
        self.has_kinds = self.frame.num_kinds > 1
        action_dim = 2 * len(slots) + (self.frame.num_kinds if self.has_kinds else 0)
        num_vectors = self.frame.num_vectors
        feature_dim = 4 * num_vectors if num_vectors else 2 * dim
        in_dim = dim + action_dim
        self.transition = MemberNet(num_members, in_dim, transition_dims, dim * (2 if is_probabilistic else 1))
        self.outcome = MemberNet(num_members, in_dim + dim + feature_dim, outcome_dims, 3)
        # What a context means for a turned state is its direction alone: one model serves all of them.
        is_input = torch.ones(dim, dtype=torch.float32)
        if self.frame.turns and self.frame.geometry is not None:
            is_input[self.frame.geometry.entries_of_contexts] = 0.0
        buffers = {
            "state_mean": torch.zeros(dim, dtype=torch.float32),
            "state_scale": torch.ones(dim, dtype=torch.float32),
            "change_scale": torch.ones(dim, dtype=torch.float32),
            "is_predicted": is_input.clone(),
            "is_changing": is_input.clone(),
            "derivation": torch.eye(dim, dtype=torch.float32),
            "reward_mean": torch.zeros(2, dtype=torch.float32),
            "reward_scale": torch.ones(2, dtype=torch.float32),
            "feature_mean": torch.zeros(feature_dim, dtype=torch.float32),
            "feature_scale": torch.ones(feature_dim, dtype=torch.float32),
        }
        if self.has_linear_part:
            buffers["linear_weight"] = torch.zeros(in_dim + len(slots) + 1, dim, dtype=torch.float32)
        for name, value in buffers.items():
            self.register_buffer(name, value)
        self.register_buffer("is_input", is_input, persistent=False)

    def forward(
        self, state: Tensor, discrete: Tensor, own: Tensor, precision: torch.dtype = torch.float32
    ) -> Prediction:
        """Predict one step with every member, each from states of its own.

        Args:
            state: `[E, B, observation_dim]`.
            discrete: `[E, B]`.
            own: parameters of the discrete actions, `[E, B, D]` in [-1, 1].
            precision: of the networks.
        """
        direction = self.frame.direction(state, discrete)
        turned = self.frame.turn(state, direction)
        x = self._inputs(turned, self.action_inputs(self.frame.kind[discrete], own))
        if self.is_probabilistic:
            change = self._sampled(self.transition(x, precision)) @ self._change_map()
        else:
            change = self.transition(x, precision, self._change_map())
        if self.has_linear_part:
            change = change + self._linear_part(x) @ self._change_map()
        outcome = self._outcome(x, turned, turned + change, precision)
        logit, terminating, continuing = outcome.unbind(-1)
        mean, scale = self.reward_mean, self.reward_scale
        return Prediction(
            self.frame.turn_back(turned + change, direction),
            continuing * scale[0] + mean[0],
            terminating * scale[1] + mean[1],
            logit,
        )

    def action_inputs(self, kind: Tensor, own: Tensor) -> Tensor:
        """Return what the networks see of actions of a kind `[*B]` with parameters `[*B, D]`.

        That is the kind, and each kind's own parameters and their squares, 0 for the other kinds.
        """
        if not self.has_kinds:
            return joined(own, own.square())
        value = own[..., self.slot_number] * (kind.unsqueeze(-1) == self.slot_kind)
        return joined(F.one_hot(kind, self.frame.num_kinds).to(own.dtype), value, value.square())

    def in_frame(self, turned: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Predict a step in the canonical frame, to learn from it.

        Args:
            turned: states `[E, B, observation_dim]`.
            action: of `action_inputs`, `[E, B, *]`.

        Returns:
            What the transition networks say, and what the outcome networks say: logit, scaled reward if the step
            terminates, and if it does not. The loss of the latter does not reach the former.
        """
        x = self._inputs(turned, action)
        transition = self.transition(x)
        scaled = transition.detach()
        if self.is_probabilistic:
            scaled = self._sampled(scaled)
        if self.has_linear_part:
            scaled = scaled + self._linear_part(x)
        return transition, self._outcome(x, turned, turned + scaled @ self._change_map(), torch.float32)

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
        return x @ weight + self._parameters_in(x) ** 3 @ of_cubes + bias

    def _parameters_in(self, x: Tensor) -> Tensor:
        """Return the parameters of all slots, of the networks' inputs."""
        end = x.shape[-1] - len(self.slot_kind)
        return x[..., end - len(self.slot_kind) : end]

    def _inputs(self, turned: Tensor, action: Tensor) -> Tensor:
        return joined(_scaled(turned, self.state_mean, self.state_scale, self.is_input), action)

    def _outcome(self, x: Tensor, turned: Tensor, next_turned: Tensor, precision: torch.dtype) -> Tensor:
        next_x = _scaled(next_turned, self.state_mean, self.state_scale, self.is_changing)
        features = _scaled(self.features(turned, next_turned), self.feature_mean, self.feature_scale)
        return self.outcome(joined(x, next_x, features), precision)

    def _change_map(self) -> Tensor:
        """Return what makes changes of the state of scaled changes, `[observation_dim, observation_dim]`."""
        return (self.is_predicted * self.change_scale).unsqueeze(-1) * self.derivation

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

        With vectors of the plane, their lengths before and after the step, the smallest length on the straight way
        between the two, and how far off the x axis they were, `[*B, 4 V]`; else the squares of all entries, of which
        lengths are made, `[*B, 2 observation_dim]`.
        """
        if not self.frame.num_vectors:
            mean, scale = self.state_mean, self.state_scale
            return joined(_scaled(turned, mean, scale), _scaled(next_turned, mean, scale, self.is_changing)).square()
        x, y = self.frame.vectors(turned)
        next_x, next_y = self.frame.vectors(next_turned)
        way_x, way_y = next_x - x, next_y - y
        along = -(x * way_x + y * way_y) / (way_x.square() + way_y.square()).clamp(min=1e-12)
        along = along.clamp(0.0, 1.0)
        lengths = [torch.hypot(x + share * way_x, y + share * way_y) for share in (0.0, 1.0, along)]
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


class PETSPolicy(TensorDictModuleBase):
    """The first action of a plan; exploring, of one with the member that the environment follows in this episode.

    Acts uniformly at random until the stored steps differ in their rewards or in whether they terminate: before, all
    plans have the same value. In finished episodes the action is random, too, and is ignored.
    """

    is_trained: Tensor

    def __init__(
        self,
        model: PETSModel,
        search: SequenceSearch,
        specs: PAMDPSpecs,
        entries: list[int],
        *,
        gamma: float,
        noise: float,
        epsilon: float,
        samples_posterior: bool,
        optimism: float,
        caution: float,
        precision: str,
        end_value: EndValues | None,
    ) -> None:
        super().__init__()
        self.in_keys = [keys.OBSERVATION, keys.DONE, keys.IS_DECISION, MEMBER]
        self.out_keys = [keys.DISCRETE, keys.PARAMETERS, MEMBER]
        self.entries = entries
        self.model = model
        self.search = search
        self.specs = specs
        self.gamma = gamma
        self.noise = noise
        self.epsilon = epsilon
        self.samples_posterior = samples_posterior
        self.optimism = optimism
        self.caution = caution
        self.precision: torch.dtype = getattr(torch, precision)
        self.end_value = end_value
        self.register_buffer("is_trained", torch.zeros((), dtype=torch.bool))
        self.register_buffer("slots", specs.parameter_slots, persistent=False)

    @torch.no_grad()
    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write the discrete action, the member `[*B]` and the parameters `[*B, num_parameters]`."""
        observation = td.get(keys.OBSERVATION).flatten(0, -2)
        state = observation[:, self.entries]
        num, device = len(state), state.device
        member = self._members(td, num, device)
        mask = td.get(keys.ACTION_MASK, None)
        allowed = self._allowed(observation, None if mask is None else mask.flatten(0, -2))
        allowed_now = None if allowed is None else allowed[:, 0]
        discrete = random_choice(torch.Size([num]), self.specs.num_discrete, allowed_now, device)
        unit = 2.0 * torch.rand(num, self.specs.num_parameters, device=device, dtype=torch.float32) - 1.0
        is_planned = self.is_trained.expand(num)
        done = td.get(keys.DONE, None)
        if done is not None:
            is_planned = is_planned & ~done.flatten()
        if self.epsilon > 0.0 and not is_greedy():
            is_planned = is_planned & (torch.rand(num, device=device, dtype=torch.float32) >= self.epsilon)
        if is_planned.any():
            allowed = None if allowed is None else allowed[is_planned]
            found = self.plan(state[is_planned], member[is_planned] if self._follows_member else None, allowed)
            own = found.own
            if not is_greedy():
                own = with_exploring_noise(own, self.noise)
            discrete[is_planned] = found.discrete
            unit[is_planned] = unit[is_planned].scatter(-1, self.slots[found.discrete], own)
        shape = td.batch_size
        parameters = self.specs.from_unit(unit).reshape(*shape, self.specs.num_parameters)
        td.update({keys.ACTION: {"discrete": discrete.reshape(shape), "parameters": parameters}})
        return td.set(MEMBER, member.reshape(shape))

    def _members(self, td: TensorDictBase, num: int, device: torch.device) -> Tensor:
        """Return the members that environments follow: a random one where an episode or an option begins."""
        fresh = torch.randint(self.model.num_members, (num,), device=device)
        held, begins = td.get(MEMBER, None), td.get(keys.IS_DECISION, None)
        if held is None:
            return fresh
        if begins is None:
            return held.flatten()
        return torch.where(begins.flatten(), fresh, held.flatten())

    @torch.no_grad()
    def value(self, observation: Tensor, action_mask: Tensor | None = None) -> Tensor:
        """Return the expected returns `[N]` of the plans from observations `[N, *]`, with what a mask allows.

        Greedily that is by the mean of all members, and `caution`; exploring by posterior sampling, by a random member
        for each observation, or else by the mean and `optimism`, so that what members disagree on is tried. Before
        the policy plans, the value assumes the only known reward at every step; while exploring, it is infinite.
        """
        num = len(observation)
        if not bool(self.is_trained):
            known = self.model.reward_mean[0] * sum(self.gamma**h for h in range(self.search.horizon))
            return known.expand(num) if is_greedy() else torch.full_like(observation[:, 0], torch.inf)
        member = torch.randint(self.model.num_members, (num,), device=observation.device)
        allowed = self._allowed(observation, action_mask)
        return self.plan(observation[:, self.entries], member if self._follows_member else None, allowed).value

    @property
    def _follows_member(self) -> bool:
        return self.samples_posterior and not is_greedy()

    def plan(self, state: Tensor, member: Tensor | None = None, allowed: Tensor | None = None) -> Found:
        """Plan from states `[N, observation_dim]`, each with its own member `[N]`; None: with the mean of all.

        Args:
            state: where the plans begin.
            member: of each of them.
            allowed: the discrete actions that each step may take, bool `[N, horizon, num_discrete]`; None: all.
        """
        num_members = self.model.num_members
        if member is None:
            return self._plan(state.expand(num_members, -1, -1), allowed, is_mean=True)
        # All members at once, each with as many states as the one with the most, some of them zeros.
        is_own = member.unsqueeze(-1) == torch.arange(num_members, device=member.device)
        place = (is_own.cumsum(0) - 1).gather(1, member.unsqueeze(-1)).squeeze(-1)
        num_places = int(place.max()) + 1
        stacked = state.new_zeros(num_members, num_places, state.shape[-1])
        stacked[member, place] = state
        if allowed is not None:
            of_members = allowed.new_ones(num_members, num_places, *allowed.shape[1:])
            of_members[member, place] = allowed
            allowed = of_members
        found = self._plan(stacked, allowed, is_mean=False)
        row = member * num_places + place
        return Found(*(part[row] for part in found))

    def _allowed(self, observation: Tensor, action_mask: Tensor | None) -> Tensor | None:
        """Return which actions each step of a plan may take, bool `[N, horizon, num_discrete]`; None: all.

        What the environment will allow in predicted states is unknown, and taken to be everything.
        """
        first = self.specs.allowed(observation, action_mask)
        if first is None:
            return None
        later = self.specs.allowed(observation)
        later = torch.ones_like(first) if later is None else later
        return torch.stack([first] + [later] * (self.search.horizon - 1), 1)

    def _plan(self, state: Tensor, allowed: Tensor | None, *, is_mean: bool) -> Found:
        """Plan from states `[E, N, observation_dim]`: N plans by the mean of all members, or one for each state.

        In a plan by the mean, single members choose the sequences that are refined, which takes a fraction of the time.
        `allowed` is bool `[N, horizon, num_discrete]`, or `[E, N, horizon, num_discrete]`.
        """
        search = self.search
        num_sequences = min(search.num_kept, search.num_sequences) if is_mean else search.num_sequences
        size = max(1, _CHUNK_ROWS // (num_sequences * search.samples_of_a_sequence(is_greedy())))
        found = []
        for begin in range(0, state.shape[1], size):
            piece = state[:, begin : begin + size]
            own = allowed
            if own is not None:
                own = own[begin : begin + size] if is_mean else own[:, begin : begin + size].flatten(0, 1)
            num_plans = piece.shape[1] if is_mean else piece.shape[:2].numel()
            first_returns = self._returns_of_single_members(piece[0]) if is_mean else None
            returns = self._returns(piece, is_mean)
            part = search(returns, num_plans, state.device, own, first_returns, is_greedy=is_greedy())
            found.append(part if is_mean else Found(*(each.unflatten(0, piece.shape[:2]) for each in part)))
        joined_found = Found(*(torch.cat(part, 0 if is_mean else 1) for part in zip(*found, strict=True)))
        return joined_found if is_mean else Found(*(part.flatten(0, 1) for part in joined_found))

    def _returns(self, state: Tensor, is_mean: bool) -> Returns:
        num_members, num_states = state.shape[:2]

        def for_members(part: Tensor) -> Tensor:
            """Return `[N, ...]` or `[E * N, ...]` as `[E, N, ...]`."""
            return part.expand(num_members, *part.shape) if is_mean else part.unflatten(0, (num_members, num_states))

        def returns(steps: Sequence[SequenceStep]) -> Tensor:
            num_sequences = steps[-1].discrete.shape[1]

            def predictions() -> Iterator[Prediction]:
                # [E, observation_dim, N, Q_h, S]: see `joined`
                rows = state.mT[..., None, None].expand(-1, -1, -1, 1, steps[0].own.shape[2])
                for step in steps:
                    shape = num_states, *step.own.shape[1:3]
                    rows = _each_repeated(rows, shape[1] // rows.shape[-2]).flatten(2)
                    discrete = for_members(step.discrete).unsqueeze(-1).expand(num_members, *shape).flatten(1)
                    own = for_members(step.own).flatten(1, 3)
                    ahead = self.model(rows.mT, discrete, own, self.precision)
                    rows = ahead.next_state.mT.unflatten(-1, shape)
                    parts = (part.unflatten(1, shape) for part in ahead[1:])
                    yield Prediction(rows, *(_each_repeated(part, num_sequences // shape[1]) for part in parts))

            end_value = None if self.end_value is None else self._end_value_of_joined
            total = discounted_return(predictions(), self.gamma, end_value)
            if not is_mean:
                return total.flatten(0, 1)
            weight = -self.caution if is_greedy() else self.optimism
            return total.mean(0) if weight == 0.0 else total.mean(0) + weight * total.std(0, correction=0)

        return returns

    def _end_value_of_joined(self, rows: Tensor) -> Tensor:
        """Return what states `[E, observation_dim, N, Q, S]` are worth at the end of a plan, `[E, N, Q, S]`."""
        assert self.end_value is not None
        value: Tensor = self.end_value(rows.movedim(1, -1))
        return value

    def _returns_of_single_members(self, state: Tensor) -> Returns:
        """Return what maps sequences to the returns that a single member expects, from states `[N, observation_dim]`.

        Each member serves as many of the states.
        """
        num_members, num_states = self.model.num_members, len(state)
        num_places = -(-num_states // num_members)

        def padded(part: Tensor) -> Tensor:
            last = part[-1:].expand(num_members * num_places - num_states, *part.shape[1:])
            return torch.cat([part, last])

        returns = self._returns(padded(state).unflatten(0, (num_members, num_places)), is_mean=False)
        return lambda steps: returns([SequenceStep(*map(padded, step)) for step in steps])[:num_states]


def _each_repeated(rows: Tensor, times: int) -> Tensor:
    """Return `[..., Q, S]` with each of Q repeated, `[..., Q * times, S]`."""
    return rows if times == 1 else rows.unsqueeze(-2).expand(*rows.shape[:-1], times, -1).flatten(-3, -2)


class PETS(ReplayLearner):
    """A PETSModel trained on all steps so far, and a SequenceSearch that plans in it."""

    modes: ClassVar[tuple[str, ...]] = ("train",)
    stores_own_parameters = True

    catches_up = True

    policy: PETSPolicy

    def __init__(
        self,
        specs: PAMDPSpecs,
        device: torch.device,
        *,
        augment: Literal["auto"] | bool,
        num_members: PositiveInt,
        transition_dims: list[PositiveInt],
        outcome_dims: list[PositiveInt],
        probabilistic: bool,
        linear_part: Literal["auto"] | bool,
        lr: LearningRate,
        weight_decay: NonNegativeFloat,
        weight_decay_steps: PositiveInt,
        transition_weight: PositiveFloat,
        warmup_steps: PositiveInt,
        updates_per_step: PositiveFloat,
        batch_size: PositiveInt,
        buffer_size: PositiveInt,
        posterior_sampling: Literal["auto"] | bool,
        optimism: NonNegativeFloat,
        caution: NonNegativeFloat,
        parameter_noise: NonNegativeFloat,
        epsilon: Fraction,
        gamma: PositiveFraction,
        horizon: PositiveInt,
        max_sequences: PositiveInt,
        num_kept: PositiveInt,
        num_samples: PositiveInt,
        greedy_samples: PositiveInt,
        num_elites: PositiveInt,
        num_iterations: PositiveInt,
        temperature: PositiveFloat,
        first_min_deviation: NonNegativeFloat,
        min_deviation: NonNegativeFloat,
        planning_precision: Literal["float32", "bfloat16"],
        end_values: bool,
        end_value_lr: LearningRate,
        end_value_tau: PositiveFraction,
        end_value_expectile: Expectile,
    ) -> None:
        uses_geometry = augment is not False
        self.entries = list(range(specs.observation_dim))
        if uses_geometry:
            self.entries, specs = specs.telling_entries, specs.with_telling_entries()
        options = ReplayOptions(
            gamma=gamma,
            warmup_steps=warmup_steps,
            buffer_size=buffer_size,
            batch_size=batch_size,
            updates_per_step=updates_per_step,
            augment=specs.symmetries is not None if augment == "auto" else augment,
        )
        super().__init__(specs, device, options)
        self.weight_decay = weight_decay
        self.weight_decay_steps = weight_decay_steps
        self.transition_weight = transition_weight
        self.model = PETSModel(
            specs,
            num_members,
            transition_dims,
            outcome_dims,
            is_probabilistic=probabilistic,
            uses_geometry=uses_geometry,
            linear_part=linear_part,
        )
        self.end_values = (
            EndValues(specs.observation_dim, outcome_dims, tau=end_value_tau, expectile=end_value_expectile)
            if end_values
            else None
        )
        search = SequenceSearch(
            specs.parameter_dims,
            horizon=horizon,
            max_sequences=max_sequences,
            num_kept=num_kept,
            num_samples=num_samples,
            greedy_samples=greedy_samples,
            num_elites=num_elites,
            num_iterations=num_iterations,
            temperature=temperature,
            first_min_deviation=first_min_deviation,
            min_deviation=min_deviation,
        )
        self.policy = PETSPolicy(
            self.model,
            search,
            specs,
            self.entries,
            gamma=gamma,
            noise=parameter_noise,
            epsilon=epsilon,
            samples_posterior=self.model.frame.turns if posterior_sampling == "auto" else posterior_sampling,
            optimism=optimism,
            caution=caution,
            precision=planning_precision,
            end_value=self.end_values,
        )
        self.to(device)
        self.optimizers = {
            "model": torch.optim.AdamW(self.model.parameters(), lr=lr, weight_decay=weight_decay, fused=True)
        }
        if self.end_values is not None:
            self.optimizers["end_values"] = torch.optim.Adam(self.end_values.learned(), lr=end_value_lr, fused=True)

    def transitions(self, batch: TensorDictBase) -> TensorDict:
        """Return the model's inputs and targets in a batch `[*B, T]`; a truncated step has not terminated.

        Where values are learned, `next_observation` has all entries of the next state.
        """
        rows = super().transitions(batch)
        if self.end_values is None:
            rows = rows.exclude("discount", "action_mask", "next_action_mask")
        else:
            rows.set("next_observation", rows["next_state"])
        for name in ("state", "next_state"):
            rows.set(name, rows[name][..., self.entries])
        return rows.set("terminated", batch["next", keys.TERMINATED].squeeze(-1))

    def value(self, observation: Tensor, action_mask: Tensor | None = None) -> Tensor:
        """Return the values `[N]` of observations `[N, *]`.

        With `end_values` they are what these have learned, whatever a mask allows; else see `PETSPolicy.value`.
        """
        if self.end_values is None:
            return self.policy.value(observation, action_mask)
        return self.end_values.of_own(observation[..., self.entries])

    def on_progress(self, steps: int) -> None:
        """Let the policy plan once stored rewards or terminations differ, or at once if there are end values."""
        if self.policy.is_trained:  # later steps may be the same because the plans are good
            return
        stored = self.buffer[:]
        differ = [(stored[name] != stored[name][0]).any() for name in ("reward", "terminated")]
        self.policy.is_trained.fill_(self.end_values is not None or bool(torch.stack(differ).any()))

    def sample_batches(self, num_batches: int) -> Iterator[TensorDictBase]:
        """Yield samples `[num_members, batch_size]` of all stored steps, each with all its mirror images or maps."""
        decay = self.weight_decay * min(1.0, self.weight_decay_steps / len(self.buffer))
        for group in self.optimizers["model"].param_groups:
            group["weight_decay"] = decay
        rows = self.prepared()
        shape = num_batches, self.model.num_members, self.options.batch_size
        for places in torch.randint(len(rows), shape, device=rows.device):
            yield rows[places]

    def prepared(self) -> TensorDict:
        """Fit the model's scales to all stored steps; return these in the canonical frame, as the model sees them."""
        stored = self.buffer[:].select("state", "discrete", "unit", "next_state", "reward", "terminated")
        frame = self.model.frame
        if self.symmetry is not None and not frame.turns:
            stored = self._with_all_maps(stored)
        direction = frame.direction(stored["state"], stored["discrete"])
        turned = [frame.turn(stored[name], direction) for name in ("state", "next_state")]
        kind, own = frame.kind[stored["discrete"]], stored["unit"] * self.policy.search.has_slot[stored["discrete"]]
        reward, terminated = stored["reward"], stored["terminated"]
        if frame.turns and frame.geometry is not None and frame.geometry.has_mirror:
            turned = [torch.cat([state, frame.mirror(state)]) for state in turned]
            kind, own, reward, terminated = (torch.cat([part, part]) for part in (kind, own, reward, terminated))
        action = self.model.action_inputs(kind, own)
        self.model.fit_scales(turned[0], action, turned[1], reward, terminated)
        mean, scale = self.model.reward_mean, self.model.reward_scale
        which = terminated.long()
        return TensorDict(
            {
                "turned": turned[0],
                "action": action,
                "change": self.model.target_change(turned[0], action, turned[1]),
                "reward": (reward - mean[which]) / scale[which],
                "terminated": terminated.float(),
            },
            batch_size=len(reward),
        )

    def _with_all_maps(self, stored: TensorDictBase) -> TensorDictBase:
        """Return stored steps under all symmetries, or of many of them each under some."""
        assert self.symmetry is not None
        num_maps = len(self.symmetry.maps)
        copies = min(num_maps, _LARGEST_COPIES)
        number = torch.arange(copies, device=stored.device).repeat_interleave(len(stored))
        if copies < num_maps:
            number = torch.randint(num_maps, number.shape, device=stored.device)
        rows = stored.repeat(copies)
        rows = rows.set("unit", self._all_parameters(rows["discrete"], rows["unit"]))
        rows = self.symmetry.mapped(number, rows)
        return rows.set("unit", rows["unit"].gather(-1, self.slots[rows["discrete"]]))

    def update_once(self, sample: TensorDictBase) -> dict[str, Tensor]:
        """Update every member from its own minibatch of a sample `[num_members, batch_size]`.

        Then update the values, if they are learned, from as many steps as they were, mapped by no symmetry.
        """
        scalars = self.gradient_step("model", self._loss, sample)
        if self.end_values is not None:
            rows = self.buffer.sample(sample.numel())
            state, next_state = rows["state"], rows["next_state"]
            rows.set("next_state", rows["next_observation"])
            scalars |= self.end_values.update(self, rows, state, next_state)
        return scalars

    def _loss(self, sample: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the sum of the members' losses, and the mean of each part of it."""
        ends = sample["terminated"]
        transition, outcome = self.model.in_frame(sample["turned"], sample["action"])
        change = sample["change"]
        if self.model.is_probabilistic:
            mean, log_variance = self.model.moments(transition)
            error = 0.5 * ((mean - change).square() * (-log_variance).exp() + log_variance)
        else:
            error = (transition - change).square()
        is_predicted = self.model.is_predicted
        error = (error * is_predicted).sum(-1) / is_predicted.sum().clamp(min=1.0)
        logit, terminating, continuing = outcome.unbind(-1)
        reward = torch.where(ends > 0.0, terminating, continuing)
        parts = {
            "change": (error * (1.0 - ends)).mean(),
            "termination": F.binary_cross_entropy_with_logits(logit, ends),
            "reward": (reward - sample["reward"]).square().mean(),
        }
        loss = self.transition_weight * parts["change"] + parts["termination"] + parts["reward"]
        return loss * self.model.num_members, parts
