"""P-DQN and MP-DQN: Q-learning over discrete actions whose parameters a deterministic network chooses.

One network gives the parameters x(s) of all discrete actions, another the value Q(s, k, x) of every discrete action k.
The policy takes the discrete action with the highest Q; x is trained to increase the sum of all discrete actions' Q.

Source: Xiong et al., *Parametrized Deep Q-Networks Learning: Reinforcement Learning with Discrete-Continuous Hybrid
Action Space*, 2018, arXiv 1810.06394, algorithm 1. Multi-pass: Bester, James and Konidaris, *Multi-Pass Q-Networks for
Deep Reinforcement Learning with Parameterised Action Spaces*, 2019, arXiv 1905.04388. Twin critics, target smoothing,
delayed actor: Fujimoto, van Hoof and Meger 2018, arXiv 1802.09477 (TD3). Double Q: van Hasselt, Guez and Silver 2016,
arXiv 1509.06461. Inverting gradients: Hausknecht and Stone 2016, arXiv 1511.04143. Penalty on preactivations:
Andrychowicz et al. 2017, arXiv 1707.01495, appendix A. Towards the best of random actions: Neumann et al. 2023,
*Greedy Actor-Critic*, arXiv 1810.09103.

Differs from the source:
- one learner with uniform replay and target networks, which move at a rate each, as in Bester et al., instead of
  asynchronous learners;
- with `greedy_samples` the greedy policy also values variations of x(s) and takes the best of them all: the critics
  often know better parameters than those that the actor's gradient has led to. It makes no difference in training;
- with `search_samples` the actor is also drawn to the best of uniformly random parameters of each discrete action, the
  more the better they are by the critics than its own. A gradient alone stays on the hill that it began on;
- with `layer_norm` the critics' layers are normalised (Ball et al. 2023, arXiv 2302.02948);
- where only the chosen action's value matters, only its pass is computed; passes share what they have in common;
- networks start as PyTorch's, not as Kaiming et al. proposed;
- by default, that is with `pdqn.yaml`: twin critics, whose minimum is Q everywhere (in the targets, in the actor's loss
  and in the choice of the action), target smoothing, a delayed actor, parameters squashed by tanh, one learning rate
  and one target rate for both networks, gradients of any length, Gaussian noise on the parameters besides
  epsilon-random actions. `pdqn_published.yaml` has the settings of Bester et al. instead.

TorchRL's DQNLoss does not fit: its value network sees the observation alone, whereas Q and its target here also take
the parameters, which come from a network with a target and a loss of its own.
"""

from __future__ import annotations

import copy
from typing import Literal

import torch
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from hpamdp import keys
from hpamdp.policies.base import is_greedy, option_ends
from hpamdp.policies.masks import allowed_rows, masked_values, random_choice
from hpamdp.policies.shared.actor_critic import set_learning_rates
from hpamdp.policies.shared.exploration import linear_schedule, with_exploring_noise
from hpamdp.policies.shared.networks import (
    HybridCritics,
    InitialLayer,
    InitialParameters,
    InvertingGradients,
    before_tanh,
    even_normal,
    in_pieces,
    mlp,
    polyak_update,
    unsquashed,
    with_clipped_noise,
    with_variations,
)
from hpamdp.policies.shared.replay import ReplayLearner, ReplayOptions
from hpamdp.settings import Fraction, LearningRate, PositiveFraction
from hpamdp.specs import PAMDPSpecs

# Parameters, or values, of the variations that are tried at once: bounds the memory where discrete actions are many.
_MAX_TRIED = 1 << 22


class ParameterActor(nn.Module):
    """The parameters of all discrete actions: `[*B, observation_dim]` -> `[*B, num_parameters]` in [-1, 1]."""

    def __init__(
        self, specs: PAMDPSpecs, hidden_dims: list[int], bounding: str, initial_parameters: InitialParameters
    ) -> None:
        super().__init__()
        self.net = mlp(specs.observation_dim, hidden_dims, specs.num_parameters)
        self.is_inverting = bounding == "inverting_gradients"
        self.initial = InitialLayer(specs, initial_parameters, is_squashed=not self.is_inverting)
        self.initial.shrink(self.net[-1])

    def forward(self, state: Tensor) -> Tensor:
        """Return the bounded parameters."""
        return self.bounded(self.raw(state))

    def raw(self, state: Tensor) -> Tensor:
        """Return the parameters before they are bounded: with tanh, the preactivations."""
        return before_tanh(self.net(state)) + self.initial(state)

    def bounded(self, raw: Tensor) -> Tensor:
        """Return the parameters of raw ones."""
        return InvertingGradients.apply(raw) if self.is_inverting else raw.tanh()

    def unbounded(self, unit: Tensor) -> Tensor:
        """Return the raw parameters of bounded ones in [-1, 1], or of some close to them."""
        return unit if self.is_inverting else unsquashed(unit)


def best_of_tried(critics: HybridCritics, state: Tensor, tried: Tensor) -> tuple[Tensor, Tensor]:
    """Return the highest value of every discrete action and which of the tried parameters has it, `[B, num_discrete]`.

    Args:
        critics: value the parameters; the lowest of their values counts.
        state: `[B, observation_dim]`.
        tried: in each state, `[B, T, num_parameters]` in [-1, 1].
    """
    num_tried = tried.shape[1]
    q = critics(state.repeat_interleave(num_tried, 0), tried.flatten(0, 1)).amin(0)
    value, place = q.unflatten(0, (-1, num_tried)).max(1)
    return value, place


class PDQNPolicy(TensorDictModuleBase):
    """Takes the discrete action with the highest Q; explores with random actions and noise on the parameters.

    Args:
        actor: gives the parameters.
        critics: value them.
        specs: of the problem.
        noise: standard deviation of the exploring noise on the parameters in [-1, 1].
        greedy_samples: how many variations of the parameters the greedy policy values besides the actor's own.
        greedy_noise: standard deviation of these variations.
    """

    epsilon: Tensor
    variations: Tensor

    def __init__(
        self,
        actor: ParameterActor,
        critics: HybridCritics,
        specs: PAMDPSpecs,
        *,
        noise: float,
        greedy_samples: int,
        greedy_noise: float,
    ) -> None:
        super().__init__()
        self.in_keys = [keys.OBSERVATION]
        self.out_keys = [keys.DISCRETE, keys.PARAMETERS]
        self.actor = actor
        self.critics = critics
        self.specs = specs
        self.noise = noise
        self.register_buffer("epsilon", torch.ones((), dtype=torch.float32))
        variations = even_normal(greedy_samples, specs.num_parameters, greedy_noise)
        self.register_buffer("variations", variations, persistent=False)

    @torch.no_grad()
    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write the discrete action `[*B]` and the parameters `[*B, num_parameters]`."""
        state = td.get(keys.OBSERVATION).reshape(-1, self.specs.observation_dim)
        allowed = allowed_rows(self.specs, td)
        unit = self.actor(state)
        if is_greedy() and len(self.variations) > 0:
            discrete, unit = self._best_variation(state, unit, allowed)
        else:
            discrete = masked_values(self.critics(state, unit).amin(0), allowed).argmax(-1)
        if not is_greedy():
            is_random = torch.rand(discrete.shape, device=discrete.device, dtype=torch.float32) < self.epsilon
            noisy = with_exploring_noise(unit, self.noise)
            unit = torch.where(is_random.unsqueeze(-1), 2.0 * torch.rand_like(unit) - 1.0, noisy)
            anything = random_choice(discrete.shape, self.specs.num_discrete, allowed, discrete.device)
            discrete = torch.where(is_random, anything, discrete)
        td.set(keys.DISCRETE, discrete.reshape(td.batch_size))
        return td.set(keys.PARAMETERS, self.specs.from_unit(unit).reshape(*td.batch_size, -1))

    def _best_variation(self, state: Tensor, unit: Tensor, allowed: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return the discrete actions `[B]` and the parameters `[B, P]` that are best among x(s) and its variations."""
        num_tried = 1 + len(self.variations)
        num_rows = max(1, _MAX_TRIED // (num_tried * max(unit.shape[-1], self.specs.num_discrete)))

        def best_of(some_states: Tensor, some_units: Tensor) -> tuple[Tensor, Tensor]:
            return best_of_tried(self.critics, some_states, with_variations(some_units, self.variations))

        values, places = in_pieces(best_of, num_rows, state, unit)
        discrete = masked_values(values, allowed).argmax(-1)
        place = places.gather(-1, discrete.unsqueeze(-1)).squeeze(-1)
        none = unit.new_zeros(1, unit.shape[-1])
        return discrete, (unit + torch.cat([none, self.variations])[place]).clamp(-1.0, 1.0)


class PDQN(ReplayLearner):
    """Q-learning over discrete actions and gradient ascent on their parameters, from a replay buffer of its own."""

    policy: PDQNPolicy
    episodes: Tensor

    def __init__(
        self,
        specs: PAMDPSpecs,
        device: torch.device,
        *,
        multipass: bool,
        twin: bool,
        double_q: bool,
        target_smoothing: NonNegativeFloat,
        target_smoothing_clip: NonNegativeFloat,
        policy_delay: PositiveInt,
        n_step: PositiveInt,
        bounding: Literal["tanh", "inverting_gradients"],
        initial_parameters: InitialParameters,
        hidden_dims: list[PositiveInt],
        layer_norm: bool,
        warmup_steps: NonNegativeInt,
        buffer_size: PositiveInt,
        batch_size: PositiveInt,
        updates_per_step: PositiveFloat,
        augment: bool,
        gamma: PositiveFraction,
        reward_scale: PositiveFloat,
        actor_lr: LearningRate,
        critic_lr: LearningRate,
        lr_final: PositiveFraction,
        lr_steps: NonNegativeInt,
        actor_tau: PositiveFraction,
        critic_tau: PositiveFraction,
        max_grad_norm: PositiveFloat | None,
        preactivation_penalty: NonNegativeFloat,
        search_samples: NonNegativeInt,
        search_weight: NonNegativeFloat,
        parameter_noise: NonNegativeFloat,
        greedy_samples: NonNegativeInt,
        greedy_noise: NonNegativeFloat,
        epsilon_final: Fraction,
        epsilon_steps: NonNegativeInt,
        epsilon_episodes: PositiveInt | None,
    ) -> None:
        if preactivation_penalty > 0.0 and bounding != "tanh":
            raise ValueError(f"preactivation_penalty={preactivation_penalty}: needs bounding=tanh; {bounding=}")
        if search_samples > 0 and not multipass:
            raise ValueError(
                f"{search_samples=}: needs multipass=true, as values else depend on other actions' parameters"
            )
        options = ReplayOptions(
            gamma=gamma,
            warmup_steps=warmup_steps,
            buffer_size=buffer_size,
            batch_size=batch_size,
            updates_per_step=updates_per_step,
            augment=augment,
        )
        super().__init__(specs, device, options)
        self.stores_own_parameters = multipass
        self.double_q = double_q
        self.target_smoothing = target_smoothing
        self.target_smoothing_clip = target_smoothing_clip
        self.policy_delay = policy_delay
        self.n_step = n_step
        self.learning_rates = {"actor": actor_lr, "critics": critic_lr}
        self.lr_final = lr_final
        self.lr_steps = lr_steps
        self.actor_tau = actor_tau
        self.critic_tau = critic_tau
        self.max_grad_norm = max_grad_norm
        self.preactivation_penalty = preactivation_penalty
        self.search_samples = search_samples
        self.search_weight = search_weight
        self.reward_scale = reward_scale
        self.epsilon_final = epsilon_final
        self.epsilon_steps = epsilon_steps
        self.epsilon_episodes = epsilon_episodes
        self.register_buffer("episodes", torch.zeros((), dtype=torch.long))

        self.actor = ParameterActor(specs, hidden_dims, bounding, initial_parameters)
        self.critics = HybridCritics(specs, 2 if twin else 1, hidden_dims, multipass, layer_norm=layer_norm)
        self.target_actor = copy.deepcopy(self.actor).requires_grad_(False)
        self.target_critics = copy.deepcopy(self.critics).requires_grad_(False)
        self.policy = PDQNPolicy(
            self.actor,
            self.critics,
            specs,
            noise=parameter_noise,
            greedy_samples=greedy_samples,
            greedy_noise=greedy_noise,
        )
        self.to(device)
        self.optimizers = {
            "actor": torch.optim.Adam(self.actor.parameters(), lr=actor_lr, fused=True),
            "critics": torch.optim.Adam(self.critics.parameters(), lr=critic_lr, fused=True),
        }

    def learn(self, batch: TensorDictBase, mask: Tensor) -> dict[str, float]:
        """Store the batch's transitions, count its episodes; after the warm-up, make the updates that are due."""
        self.episodes += (batch["next", keys.DONE].squeeze(-1) & mask).sum()
        return super().learn(batch, mask)

    def on_progress(self, steps: int) -> None:
        """Lower the fraction of random actions and the learning rates."""
        time, over = steps, self.epsilon_steps
        if self.epsilon_episodes is not None:
            time, over = int(self.episodes), self.epsilon_episodes
        self.policy.epsilon.fill_(linear_schedule(time, over, self.epsilon_final))
        set_learning_rates(self.optimizers, self.learning_rates, linear_schedule(steps, self.lr_steps, self.lr_final))

    def transitions(self, batch: TensorDictBase) -> TensorDict:
        """Return every row with its n-step return, the state that follows and the discount of that state's value."""
        rows = super().transitions(batch)
        done = option_ends(batch).squeeze(-1)
        terminated = batch["next", keys.TERMINATED].squeeze(-1)
        reward, last = n_step_returns(rows["reward"], done, self.n_step, self.options.gamma)
        num_rewards = last - torch.arange(done.shape[-1], device=last.device) + 1
        next_state = rows["next_state"]
        rows["reward"] = reward
        rows["next_state"] = next_state.gather(-2, last.unsqueeze(-1).expand_as(next_state))
        rows["discount"] = self.options.gamma ** num_rewards.float() * ~terminated.gather(-1, last)
        for name in ("option_ended", "next_option"):
            if name in rows.keys():
                rows[name] = rows[name].gather(-1, last)
        if "next_action_mask" in rows.keys():
            mask = rows["next_action_mask"]
            rows["next_action_mask"] = mask.gather(-2, last.unsqueeze(-1).expand_as(mask))
        return rows

    def update_once(self, sample: TensorDictBase) -> dict[str, Tensor]:
        """Update the critics; every `policy_delay` updates, also the actor and the targets. Return scalars."""
        scalars = self.gradient_step("critics", self._critic_loss, sample)
        scalars["epsilon"] = self.policy.epsilon
        if self.updates % self.policy_delay == 0:
            scalars |= self._update_actor(sample["state"], self.allowed(sample))
            polyak_update(self.target_actor, self.actor, self.actor_tau)
            polyak_update(self.target_critics, self.critics, self.critic_tau)
        return scalars

    def _critic_loss(self, sample: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the squared distance from the targets, and scalars."""
        q = self.critics.of_discrete(sample["state"], sample["discrete"], sample["unit"])
        loss = (q - self.target(sample)).square().mean(-1).sum()
        return loss, {"critic": loss, "q": q.mean()}

    def _update_actor(self, state: Tensor, allowed: Tensor | None) -> dict[str, Tensor]:
        """Update the actor to increase the sum of the allowed discrete actions' values; return the loss."""
        return self.gradient_step("actor", self._actor_loss, state, allowed)

    def _actor_loss(self, state: Tensor, allowed: Tensor | None) -> tuple[Tensor, dict[str, Tensor]]:
        raw = self.actor.raw(state)
        q = self.critics(state, self.actor.bounded(raw)).amin(0)
        value_loss = -(q if allowed is None else q * allowed).sum(-1).mean()
        loss = value_loss
        if self.preactivation_penalty > 0.0:
            loss = loss + self.preactivation_penalty * raw.square().sum(-1).mean()
        if self.search_samples > 0 and self.search_weight > 0.0:
            found, gain = self._best_of_random(state, q)
            gain = gain if allowed is None else gain * allowed
            distance = (raw - self.actor.unbounded(found)).square()
            loss = loss + self.search_weight * (gain[:, self.owner] * distance).sum(-1).mean()
        return loss, {"actor": value_loss}

    @torch.no_grad()
    def _best_of_random(self, state: Tensor, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return for every discrete action the best of random parameters, by the critics, and its gain.

        Args:
            state: `[B, observation_dim]`.
            q: values of the actor's parameters there, `[B, num_discrete]`.

        Returns:
            Parameters `[B, num_parameters]` in [-1, 1], and by how much each discrete action is better with its own of
            them than with the actor's, `[B, num_discrete]`, at least 0.
        """
        shape = len(state), self.search_samples, self.specs.num_parameters
        tried = 2.0 * torch.rand(shape, device=state.device, dtype=torch.float32) - 1.0
        best, place = best_of_tried(self.critics, state, tried)
        found = tried.gather(1, place[:, self.owner].unsqueeze(1)).squeeze(1)
        return found, (best - q).clamp(min=0.0)

    @torch.no_grad()
    def value(self, observation: Tensor, action_mask: Tensor | None = None) -> Tensor:
        """Return max_k Q'(s, k, x'(s)) over the allowed discrete actions k, `[B]`.

        With `double_q`, the learned critics choose k instead of the target critics.
        """
        unit = with_clipped_noise(self.target_actor(observation), self.target_smoothing, self.target_smoothing_clip)
        q = self.target_critics(observation, unit).amin(0)
        choosing_q = self.critics(observation, unit).amin(0) if self.double_q else q
        choosing_q = masked_values(choosing_q, self.specs.allowed(observation, action_mask))
        return q.gather(-1, choosing_q.argmax(-1, keepdim=True)).squeeze(-1)


def n_step_returns(reward: Tensor, done: Tensor, n: int, gamma: float) -> tuple[Tensor, Tensor]:
    """Return the discounted sums of the next `n` rewards and the times of the last of them, each `[*B, T]`.

    Sums end early where `done`, and at the end of the batch. TorchRL's MultiStep computes the same sums, but its memory
    grows with episodes times steps of a batch: 9 GB for a data set of 25,000 steps in 8,000 episodes.

    Args:
        reward: `[*B, T]`.
        done: where the episode or the option ends, bool `[*B, T]`.
        n: largest number of rewards in a sum.
        gamma: discount of a step.
    """
    num_steps = reward.shape[-1]
    time = torch.arange(num_steps, device=reward.device).expand_as(done)
    total = reward
    last = time
    is_over = done
    for i in range(1, min(n, num_steps)):
        following = (time + i).clamp(max=num_steps - 1)
        is_over = is_over | (time + i >= num_steps)
        total = torch.where(is_over, total, total + gamma**i * reward.gather(-1, following))
        last = torch.where(is_over, last, following)
        is_over = is_over | done.gather(-1, following)
    return total, last
