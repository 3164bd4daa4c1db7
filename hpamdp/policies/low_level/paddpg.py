"""PADDPG and PATD3: one actor outputs a score for each discrete action and the parameters of all of them.

The policy takes the discrete action with the highest score, with its own parameters. The critic sees all scores and
parameters; the actor ascends its value by inverting gradients, which keep its output within [-1, 1]. With `twin`, both
are trained as in TD3, which later papers call PATD3.

Source: Hausknecht and Stone, *Deep Reinforcement Learning in Parameterized Action Space*, 2016, arXiv 1511.04143:
sections 4 and 5, equation 11. TD3: Fujimoto, van Hoof and Meger 2018, arXiv 1802.09477. PATD3: Li et al. 2022, arXiv
2109.05490 (a row of its tables).

Differs from the source:
- A random action is stored with random scores in [-1, 1], of which the highest is its own, as in the authors' code
  (github.com/mhauskn/dqn-hfo). In the code of Bester, James and Konidaris 2019, arXiv 1905.04388, they lie in [0, 1].
- Outputs are clipped to their bounds before a critic sees them and before they are stored. In both codes critics see,
  and the buffer stores, what the actor gave.
- `parameter_noise` adds Gaussian noise to scores and parameters, besides epsilon-random actions.
- Epsilon falls with the learner's steps to 0.05. In the authors' code it falls to 0.1 within 10,000 updates.
- There is an update for every four steps, in the authors' code for every ten.
- The networks are smaller and start as PyTorch's; the learning rates and the target rate are those of this project.
  ReLU has no slope below 0, where the authors' has 0.01. Adam's first beta is 0.9, not 0.95.
- If `initial_parameters` asks for them, a frozen layer adds the problem's initial parameters, as in Bester et al.
- With `twin`, outputs are clipped as without. In HyAR's PATD3 a tanh bounds them, in addition to inverting gradients.
  That code explores by Gaussian noise alone and clips the gradients of the actor alone. It smooths targets by 0.2,
  clipped at 0.5.

TorchRL's DDPGLoss and TD3Loss would need a composite action split for them, and bounds of their own. They have no
inverting gradients, for which the gradient must be changed between critic and actor.
"""

from __future__ import annotations

import copy

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from hpamdp import keys
from hpamdp.acting import is_greedy
from hpamdp.components import Components
from hpamdp.policies.base import States
from hpamdp.policies.low_level.paddpg_options import CARDS, PADDPGOptions
from hpamdp.policies.masks import masked_values, zero_fixed
from hpamdp.policies.shared.exploration import schedule, with_exploring_noise
from hpamdp.policies.shared.gradients import adam
from hpamdp.policies.shared.networks import (
    EnsembleMLP,
    InitialLayer,
    InvertingGradients,
    mlp,
    polyak_update,
    with_clipped_noise,
)
from hpamdp.policies.shared.replay import ReplayLearner
from hpamdp.specs import PAMDPSpecs

# The policy also writes the scores of the discrete actions, which the critic sees.
SCORES = "scores"


class PADDPGActor(nn.Module):
    """Scores and parameters: `[*B, observation_dim]` -> `[*B, num_discrete + num_parameters]` in [-1, 1]."""

    def __init__(self, specs: PAMDPSpecs, options: PADDPGOptions) -> None:
        super().__init__()
        self.specs = specs
        self.num_discrete = specs.num_discrete
        self.net = mlp(specs.observation_dim, options.hidden_dims, specs.num_discrete + specs.num_parameters)
        self.initial = InitialLayer(specs, options.initial_parameters, is_squashed=False)
        self.initial.shrink(self.net[-1], slice(self.num_discrete, None))

    def forward(self, state: Tensor) -> Tensor:
        """Return what the actor outputs, clipped; its gradients are inverted."""
        scores, parameters = self.net(state).tensor_split([self.num_discrete], -1)
        output = InvertingGradients.apply(torch.cat([scores, parameters + self.initial(state)], -1))
        return self.as_stored(output, state)

    def as_stored(self, output: Tensor, state: Tensor) -> Tensor:
        """Return an output with the numbers that the critic has seen for the same action.

        Whole parameters are in the middle of their cells (`PAMDPSpecs.in_cells`), those with a single value are 0.
        """
        is_fixed = self.specs.is_fixed(state)
        if not self.specs.has_integers and is_fixed is None:
            return output
        scores, parameters = output.tensor_split([self.num_discrete], -1)
        return torch.cat([scores, zero_fixed(self.specs.in_cells(parameters), is_fixed)], -1)


def with_lowest_scores(output: Tensor, allowed: Tensor | None) -> Tensor:
    """Return an actor's outputs with the lowest score for forbidden discrete actions, the only one that critics see.

    Args:
        output: scores and parameters, `[*B, num_discrete + num_parameters]` in [-1, 1].
        allowed: the discrete actions that may be taken, bool `[*B, num_discrete]`; if None, all.
    """
    if allowed is None:
        return output
    scores, parameters = output.tensor_split([allowed.shape[-1]], -1)
    return torch.cat([scores.masked_fill(~allowed, -1.0), parameters], -1)


def with_best(scores: Tensor, discrete: Tensor, components: Components) -> Tensor:
    """Return scores `[*B, num_discrete]` in which the chosen discrete action of each component has the highest one.

    It swaps scores with the action that had the highest one.
    """
    places = components.places(discrete)
    best = components.places(components.best(scores))
    swapped = scores.scatter(-1, best, scores.gather(-1, places))
    return swapped.scatter(-1, places, scores.gather(-1, best))


class PADDPGPolicy(TensorDictModuleBase):
    """Takes the discrete action with the highest score; explores with random outputs and noise on the actor's."""

    def __init__(self, actor: PADDPGActor, specs: PAMDPSpecs, noise: float) -> None:
        super().__init__()
        self.in_keys = [keys.OBSERVATION]
        self.out_keys = [keys.DISCRETE, keys.PARAMETERS, SCORES]
        self.actor = actor
        self.specs = specs
        self.noise = noise
        self.epsilon = nn.Buffer(torch.ones((), dtype=torch.float32))

    @torch.no_grad()
    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write the discrete action `[*B]`, all parameters `[*B, num_parameters]`, all scores `[*B, num_discrete]`."""
        observation = td.get(keys.OBSERVATION)
        allowed = self.specs.allowed(observation, td.get(keys.ACTION_MASK, None))
        output = self.actor(observation)
        if not is_greedy():
            is_random = torch.rand_like(output[..., :1]) < self.epsilon
            noisy = with_exploring_noise(output, self.noise)
            output = torch.where(is_random, 2.0 * torch.rand_like(output) - 1.0, noisy)
        scores, unit_parameters = with_lowest_scores(output, allowed).tensor_split([self.specs.num_discrete], -1)
        discrete = self.specs.components.best(masked_values(scores, allowed))
        action = {"discrete": discrete, "parameters": self.specs.from_unit(unit_parameters, td)}
        return td.update({keys.ACTION: action, SCORES: scores})


class PADDPG(ReplayLearner):
    """Deterministic policy gradients on scores and parameters together, from a replay buffer of its own."""

    Options = PADDPGOptions
    card = CARDS["PADDPG"]
    options: PADDPGOptions
    policy: PADDPGPolicy

    def make_networks(self, specs: PAMDPSpecs) -> None:
        """Make the networks and the policy."""
        options = self.options
        self.max_grad_norm = options.max_grad_norm
        self.policy_delay = options.policy_delay if options.twin else 1
        self.actor = PADDPGActor(specs, options)
        num_inputs = specs.observation_dim + specs.num_discrete + specs.num_parameters
        self.critics = EnsembleMLP(2 if options.twin else 1, num_inputs, options.hidden_dims, 1)
        self.target_actor = copy.deepcopy(self.actor).requires_grad_(False)
        self.target_critics = copy.deepcopy(self.critics).requires_grad_(False)
        self.policy = PADDPGPolicy(self.actor, specs, options.parameter_noise)

    def make_optimizers(self) -> dict[str, torch.optim.Optimizer]:
        """Return the optimizers by the names of what they learn."""
        options = self.options
        return {"actor": adam(options.actor_lr, self.actor), "critics": adam(options.critic_lr, self.critics)}

    def update_once(self, sample: TensorDictBase) -> dict[str, Tensor]:
        """Update the critics; every `policy_delay` updates, also the actor and the targets. Return scalars."""
        scalars = self.gradient_step("critics", self.critic_loss, sample)
        scalars["epsilon"] = self.policy.epsilon
        if self.updates % self.policy_delay == 0:
            scalars |= self.gradient_step("actor", self.actor_loss, sample["state"], self.allowed(sample))
            polyak_update(self.target_actor, self.actor, self.options.tau)
            polyak_update(self.target_critics, self.critics, self.options.tau)
        return scalars

    def critic_loss(self, sample: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the squared distance from r + discount min Q'(s', a'), and scalars."""
        q = q_values(self.critics, sample["state"], torch.cat([sample[SCORES], sample["unit"]], -1))
        loss = (q - self.target(sample)).square().mean(-1).sum()
        return loss, {"critic": loss, "q": q.mean()}

    def actor_loss(self, state: Tensor, allowed: Tensor | None) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss that falls with the value of the actor's output by the first critic."""
        loss = -q_values(self.critics, state, with_lowest_scores(self.actor(state), allowed))[0].mean()
        return loss, {"actor": loss}

    @torch.no_grad()
    def value(self, states: States, *, is_target: bool = False) -> Tensor:
        """Return min Q'(s, a), `[B]`, with a the target actor's output; targets of a twin learner add clipped noise."""
        observation = states.observation
        output = self.target_actor(observation)
        if self.options.twin:
            smoothing = self.options.target_smoothing if is_target else 0.0
            output = with_clipped_noise(output, smoothing, self.options.target_smoothing_clip)
            output = self.target_actor.as_stored(output, observation)
        output = with_lowest_scores(output, self.specs.allowed(observation, states.action_mask))
        return q_values(self.target_critics, observation, output).amin(0)

    def transitions(self, batch: TensorDictBase) -> TensorDict:
        """Return the rows to store, with all scores; where an exploration acted, with the highest for its action."""
        scores = batch[SCORES]
        if self.is_overruled:
            swapped = with_best(scores, batch[keys.DISCRETE], self.specs.components)
            scores = torch.where(batch[keys.IS_HELD].unsqueeze(-1), swapped, scores)
        return super().transitions(batch).set(SCORES, scores)

    def on_progress(self, steps: int) -> None:
        """Lower the probability of random actions."""
        self.policy.epsilon.fill_(schedule(steps, self.options.epsilon_steps, self.options.epsilon_final))


def q_values(critics: EnsembleMLP, state: Tensor, output: Tensor) -> Tensor:
    """Return the critics' values `[E, B]` of an actor's outputs `[B, num_discrete + num_parameters]`."""
    return critics(torch.cat([state, output], -1)).squeeze(-1)
