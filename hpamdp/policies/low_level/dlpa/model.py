"""The learned model of DLPA: transition, reward and termination under parameterised actions.

Source: Zhang, Fu, Miao and Konidaris, 2024, arXiv 2404.03037, section 4. See `learner.py` for what differs.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from hpamdp.policies.shared.networks import EnsembleMLP
from hpamdp.policies.shared.planning import Prediction
from hpamdp.policies.shared.scales import scale_of
from hpamdp.specs import PAMDPSpecs


class Predictor(nn.Module):
    """`num_members` independent networks of a state and an action, output `[E, B, out_dim]`.

    `form` says how the networks take the action:

    - `parallel`: the state, the one-hot discrete action and its own parameters, all at once;
    - `masking`: as `parallel`, but with the parameters of all actions, those of the others set to 0;
    - `sequential`: the state and the discrete action first, then their embedding and the action's own parameters.

    With several components, the networks see what each component chose, and the parameters of all discrete actions,
    those of the others set to 0.

    Shapes: states `[B, observation_dim]`, discrete actions `[B]`, parameters `[B, num_parameters]` in [-1, 1].
    """

    def __init__(
        self, specs: PAMDPSpecs, form: str, num_members: int, hidden_dims: Sequence[int], out_dim: int
    ) -> None:
        super().__init__()
        self.form = form
        self.num_discrete = specs.num_discrete
        max_parameters = max(specs.parameter_dims)
        first_dim = specs.observation_dim + specs.num_discrete
        self.components = specs.components
        shows_all = form == "masking" or not self.components.is_single
        parameters_dim = specs.num_parameters if shows_all else max_parameters
        self.first = nn.Linear(first_dim, hidden_dims[0], dtype=torch.float32) if form == "sequential" else None
        in_dim = hidden_dims[0] if form == "sequential" else first_dim
        self.net = EnsembleMLP(num_members, in_dim + parameters_dim, hidden_dims, out_dim)
        self.mask = nn.Buffer(specs.parameter_mask.float())
        self.slots = nn.Buffer(specs.parameter_slots)
        self.owner = nn.Buffer(specs.parameter_owner, persistent=False)

    def forward(self, state: Tensor, discrete: Tensor, unit_parameters: Tensor) -> Tensor:
        """Apply all members."""
        if self.components.is_single:
            own, is_chosen = unit_parameters * self.mask[discrete], F.one_hot(discrete, self.num_discrete)
            if self.form != "masking":
                own = own.gather(-1, self.slots[discrete])
        else:
            is_chosen = self.components.is_chosen(discrete)
            own = unit_parameters * is_chosen.index_select(-1, self.owner)
        x = torch.cat([state, is_chosen.to(state.dtype)], -1)
        if self.first is not None:
            x = self.first(x).relu()
        return self.net(torch.cat([x, own], -1))


class PAMDPModel(nn.Module):
    """One transition predictor, and an ensemble of `num_members` predictors of reward and termination.

    With a memory, the networks see features, which are a context and the observation: what is remembered, and the
    state. The context is not predicted.

    Args:
        specs: of the problem, with the features as observation.
        form: how the networks take an action, see `Predictor`.
        hidden_dims: of the networks.
        num_members: of the ensemble.
        context_dim: entries of the context; 0 without a memory.
    """

    def __init__(
        self, specs: PAMDPSpecs, form: str, hidden_dims: Sequence[int], num_members: int, context_dim: int = 0
    ) -> None:
        super().__init__()
        self.context_dim = context_dim
        predicted_dim = specs.observation_dim - context_dim
        self.transition = Predictor(specs, form, 1, hidden_dims, predicted_dim)
        self.outcome = Predictor(specs, form, num_members, hidden_dims, 3)
        self.state_mean = nn.Buffer(torch.zeros(specs.observation_dim, dtype=torch.float32))
        self.state_scale = nn.Buffer(torch.ones(specs.observation_dim, dtype=torch.float32))
        self.change_scale = nn.Buffer(torch.ones(predicted_dim, dtype=torch.float32))

    def fit_scales(self, state: Tensor, next_state: Tensor, context: Tensor | None = None) -> None:
        """Set the scales of inputs and targets from transitions `[B, *]`.

        Args:
            state: observations.
            next_state: those that follow.
            context: what was remembered, `[B, context_dim]`. If None, contexts are not scaled: the state of a GRU lies
                in [-1, 1] by itself.
        """
        self.state_mean[self.context_dim :] = state.mean(0)
        self.state_scale[self.context_dim :] = scale_of(state)
        self.change_scale.copy_(scale_of(next_state - state))
        if context is not None:
            self.state_mean[: self.context_dim] = context.mean(0)
            self.state_scale[: self.context_dim] = scale_of(context)

    def forward(self, features: Tensor, discrete: Tensor, unit_parameters: Tensor) -> Prediction:
        """Predict one step.

        Args:
            features: the context and then the observation, `[B, context_dim + observation_dim]`.
            discrete: discrete actions, `[B]` or `[B, num_components]`.
            unit_parameters: `[B, num_parameters]` in [-1, 1].
        """
        scaled = (features - self.state_mean) / self.state_scale
        change = self.transition(scaled, discrete, unit_parameters)[0] * self.change_scale
        continuing, terminating, logit = self.outcome(scaled, discrete, unit_parameters).unbind(-1)
        return Prediction(features[..., self.context_dim :] + change, continuing, terminating, logit)
