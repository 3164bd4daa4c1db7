"""HyAR: TD3 or DDPG in a learned latent space of discrete actions and their parameters.

An embedding table and a conditional VAE turn a discrete action and its parameters into one continuous latent action
(e, z). The actor gives latent actions, and the critics value them.

Source: Li, Tang, Zheng, Hao, Li, Wang, Meng and Wang, *HyAR: Addressing Discrete-Continuous Action Reinforcement
Learning via Hybrid Action Representation*, 2022, arXiv 2109.05490: equations 2 to 6 and algorithm 1; TD3: Fujimoto, van
Hoof and Meger 2018, arXiv 1802.09477; DDPG: Lillicrap et al. 2016, arXiv 1509.02971.

In the published form (`discrete="nearest"`) the actor gives e and z, and e stands for the discrete action with the
nearest embedding. The actor only follows the gradient of Q. So it stays with a discrete action whose neighbours in the
latent space are worse, even where others farther away are better. `discrete="greedy"` takes an exact maximum over the
discrete actions instead, in the policy as in the targets: the actor gives a z for each of them, and the embedding and z
with the highest Q are taken. It costs a pass of the critics for each discrete action.

Differs from the source:
- discrete actions may take different numbers of parameters, which lie side by side; the encoder sees only the chosen
  action's own, and the decoder is trained on those alone;
- the change of the state is predicted in units of its standard deviation over the warm-up data. So no entry dominates
  the reconstruction loss by its scale;
- random actions have no latent action of their own: they are encoded when they are sampled from the replay buffer, as
  the representation-shift correction does for outdated ones;
- the correction compares the error of a stored action with a running mean of the codec's error, over its last hundred
  or so updates. The source compares it with the error after the last update (`correction_error=latest`);
- with `parameter_tolerance` the correction asks whether z still decodes to the executed parameters, which are stored.
  The source asks whether the change of the state that z predicts is the one that followed. Where changes are hard to
  predict, the two hardly agree;
- with `layer_norm` the critics' layers are normalised, which bounds the values of latent actions far from all that were
  tried (Ball et al. 2023, arXiv 2302.02948);
- with `greedy_samples` the greedy policy also values variations of z and takes the best of them;
- with `search_samples` the actor is also drawn to the best of random latent actions, weighted by their gain in value.
  `preactivation_penalty` keeps it from the bounds. Both are as in P-DQN;
- the codec concatenates its inputs, which the published code multiplies (`codec_inputs`); its predicted change has no
  bound, there it is a tanh (`predicted_change`); its loss sums, there it averages (`codec_loss`);
- tanh bounds the actor's output; the published code also multiplies the gradient by the range that is left
  (`inverting_gradients`), and clips its norm at 10 (`actor_max_grad_norm`);
- exploration is by random actions, ever fewer, and by Gaussian noise of a constant scale; in the published code it is
  by Gaussian noise alone, whose scale falls from 1 to 0.1 (`noise_initial`);
- the critics learn from the random steps, too; in the published code only the codec does (`critic_window`).

TorchRL's TD3Loss would fit the latent actor and critics, but an update takes 1.5 times as long with it (8.0 instead of
5.3 ms of CPU time, batches of 256). It runs the networks as functional calls under vmap.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from functools import partial
from typing import ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.nn import functional as F

from hpamdp import keys
from hpamdp.acting import is_greedy
from hpamdp.policies.base import States
from hpamdp.policies.low_level.hyar_codec import HybridCodec
from hpamdp.policies.low_level.hyar_options import CARDS, HyAROptions
from hpamdp.policies.masks import allowed_rows, masked_values, random_choice
from hpamdp.policies.shared.actor_search import even_normal, in_pieces, searching_actor_loss, with_variations
from hpamdp.policies.shared.exploration import schedule, with_exploring_noise
from hpamdp.policies.shared.gradients import adam, set_learning_rates
from hpamdp.policies.shared.networks import (
    EnsembleMLP,
    InvertingGradients,
    as_preactivations,
    mlp,
    polyak_update,
    unsquashed,
    with_clipped_noise,
)
from hpamdp.policies.shared.replay import ReplayLearner
from hpamdp.policies.shared.scales import scale_of
from hpamdp.settings import SettingError
from hpamdp.specs import PAMDPSpecs

LATENT = "latent"  # the latent action as the actor gave it; NaN where the action was random

# Latent actions that the critics evaluate at once, unless one state has more: bounds the memory.
_MAX_CANDIDATES = 1 << 14


class LatentActor(nn.Module):
    """Proposes latent actions (e, z) in [-1, 1]: one for each discrete action, or one alone.

    With `proposes_each`, e is each discrete action's own embedding, and the actor gives a z for each. Otherwise it
    gives a single (e, z).
    """

    def __init__(
        self, specs: PAMDPSpecs, embedding_dim: int, latent_dim: int, hidden_dims: Sequence[int], proposes_each: bool
    ) -> None:
        super().__init__()
        self.proposes_each = proposes_each
        self.num_proposals = specs.num_discrete if proposes_each else 1
        self.num_given = latent_dim if proposes_each else embedding_dim + latent_dim
        self.net = mlp(specs.observation_dim, hidden_dims, self.num_proposals * self.num_given)

    def forward(self, state: Tensor) -> Tensor:
        """Return what the actor gives for states `[B, observation_dim]`, `[B, num_proposals, num_given]` in [-1, 1]."""
        return self.raw(state).tanh()

    def raw(self, state: Tensor) -> Tensor:
        """Return what the actor gives before tanh, `[B, num_proposals, num_given]`."""
        return as_preactivations(self.net(state)).unflatten(-1, (self.num_proposals, self.num_given))

    def proposals(self, given: Tensor, embeddings: Tensor) -> Tensor:
        """Return the proposals of what the actor gave, `[B, num_proposals, num_given]` in [-1, 1]."""
        return torch.cat([embeddings.expand(given.shape[0], -1, -1), given], -1) if self.proposes_each else given

    def given(self, proposals: Tensor) -> Tensor:
        """Return the part of proposals that the actor gives."""
        return proposals[..., -self.num_given :]


class LatentCritics(nn.Module):
    """`num_members` independent networks for Q(s, e, z)."""

    def __init__(
        self, num_members: int, observation_dim: int, action_dim: int, hidden_dims: Sequence[int], *, layer_norm: bool
    ) -> None:
        super().__init__()
        self.net = EnsembleMLP(num_members, observation_dim + action_dim, hidden_dims, 1, layer_norm=layer_norm)

    def forward(self, state: Tensor, latent: Tensor, num_members: int | None = None) -> Tensor:
        """Return the values `[E, B, N]` of N latent actions in each state.

        Args:
            state: `[B, observation_dim]`.
            latent: `[B, N, embedding_dim + latent_dim]`.
            num_members: how many of the networks to ask, from the first on. If None, all, E.
        """
        batch_size, num_latents, _ = latent.shape
        rows = torch.cat([state.unsqueeze(1).expand(-1, num_latents, -1), latent], -1)
        return self.net(rows.flatten(0, 1), num_members).reshape(-1, batch_size, num_latents)


def best_of_proposals(critics: LatentCritics, state: Tensor, candidates: Tensor) -> tuple[Tensor, Tensor]:
    """Return the best of T latent actions for each of P proposals, by the lowest of the critics' values, and its value.

    Args:
        critics: value the latent actions.
        state: `[B, observation_dim]`.
        candidates: T latent actions for each proposal in each state, `[B, P, T, embedding_dim + latent_dim]`.

    Returns:
        Latent actions `[B, P, embedding_dim + latent_dim]` and values `[B, P]`.
    """
    q = critics(state, candidates.flatten(1, 2)).amin(0).unflatten(1, candidates.shape[1:3])
    best_value, best_index = q.max(-1)
    indices = best_index[..., None, None].expand(-1, -1, 1, candidates.shape[-1])
    return candidates.gather(2, indices).squeeze(2), best_value


class HyARPolicy(TensorDictModuleBase):
    """Takes the best of the actor's proposals, decoded; explores with noise on them and with random actions."""

    def __init__(
        self, actor: LatentActor, critics: LatentCritics, codec: HybridCodec, specs: PAMDPSpecs, options: HyAROptions
    ) -> None:
        super().__init__()
        self.in_keys = [keys.OBSERVATION]
        self.out_keys = [keys.DISCRETE, keys.PARAMETERS, LATENT]
        self.actor = actor
        self.critics = critics
        self.codec = codec
        self.specs = specs
        self.epsilon = nn.Buffer(torch.ones((), dtype=torch.float32))
        noise = torch.tensor(options.noise_initial or options.parameter_noise, dtype=torch.float32)
        self.noise = nn.Buffer(noise, persistent=options.noise_initial is not None)
        of_z = even_normal(options.greedy_samples, codec.latent_dim, options.greedy_noise)
        self.variations = nn.Buffer(F.pad(of_z, (codec.table.shape[-1], 0)), persistent=False)

    @torch.no_grad()
    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write the discrete action `[*B]`, the parameters `[*B, num_parameters]` and the latent action.

        The latent action is `[*B, embedding_dim + latent_dim]`.
        """
        state = td.get(keys.OBSERVATION).reshape(-1, self.specs.observation_dim)
        allowed = allowed_rows(self.specs, td)
        is_exploring = not is_greedy()
        given = self.actor(state)
        if is_exploring:
            given = with_exploring_noise(given, self.noise)
        proposals = self.actor.proposals(given, self.codec.embeddings)
        if not self.actor.proposes_each:
            proposals = self.codec.of_allowed(proposals, allowed)
        q = None
        if not is_exploring and len(self.variations) > 0:
            proposals, q = self._best_variations(state, proposals)
        latent = proposals[:, 0]
        if proposals.shape[1] > 1:
            q = self.critics(state, proposals).amin(0) if q is None else q
            best = masked_values(q, allowed).argmax(-1)
            latent = proposals[torch.arange(best.shape[0], device=best.device), best]
        discrete, unit_parameters = self.decode(state, latent, allowed)
        if is_exploring and self.epsilon > 0.0:
            is_random = torch.rand_like(unit_parameters[:, :1]) < self.epsilon
            unit_parameters = torch.where(is_random, 2.0 * torch.rand_like(unit_parameters) - 1.0, unit_parameters)
            random_discrete = random_choice(discrete.shape, self.specs.num_discrete, allowed, discrete.device)
            discrete = torch.where(is_random.squeeze(-1), random_discrete, discrete)
            latent = torch.where(is_random, torch.nan, latent)
        td.set(LATENT, latent.reshape(*td.batch_size, -1))
        td.set(keys.DISCRETE, discrete.reshape(td.batch_size))
        unit_parameters = unit_parameters.reshape((*td.batch_size, self.specs.num_parameters))
        return td.set(keys.PARAMETERS, self.specs.from_unit(unit_parameters, td))

    def _best_variations(self, state: Tensor, proposals: Tensor) -> tuple[Tensor, Tensor]:
        """Return the best of each proposal `[B, P, embedding_dim + latent_dim]` and its variations, and its value."""

        def best_of(some_states: Tensor, some_proposals: Tensor) -> tuple[Tensor, Tensor]:
            return best_of_proposals(self.critics, some_states, with_variations(some_proposals, self.variations))

        num_rows = max(1, _MAX_CANDIDATES // (proposals.shape[1] * (1 + len(self.variations))))
        best, values = in_pieces(best_of, num_rows, state, proposals)
        return best, values

    def decode(self, state: Tensor, latent: Tensor, allowed: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the discrete action `[B]` and the parameters `[B, num_parameters]` in [-1, 1] of a latent action.

        Args:
            state: `[B, observation_dim]`.
            latent: `[B, embedding_dim + latent_dim]`.
            allowed: the discrete actions that may be taken, bool `[B, num_discrete]`. If None, all.
        """
        e, z = latent.split([self.codec.table.shape[-1], self.codec.latent_dim], -1)
        discrete = self.codec.nearest_discrete(e, allowed)
        unit_parameters, _ = self.codec.decode(state, discrete, self.codec.z_from_unit(z))
        return discrete, unit_parameters


class HyAR(ReplayLearner):
    """TD3 or DDPG over the latent actions of a HybridCodec, trained off-policy from a replay buffer of its own."""

    Options = HyAROptions
    card = CARDS["HyAR"]
    progress: ClassVar[frozenset[str]] = ReplayLearner.progress | {"episodes", "warmup_rows"}

    options: HyAROptions
    policy: HyARPolicy

    def make_networks(self, specs: PAMDPSpecs) -> None:
        """Make the networks and the policy."""
        options = self.options
        if specs.num_parameters == 0:
            raise SettingError("HyAR encodes parameters, but no discrete action of the problem has one; use low=pdqn")
        self.policy_delay = options.policy_delay if options.twin else 1
        self.smoothing = options.target_smoothing if options.twin else 0.0, options.target_smoothing_clip

        latent_dim = options.latent_dim or max(1, *specs.parameter_dims)
        dims, latent_dims = options.hidden_dims, (options.embedding_dim, latent_dim)
        self.codec = HybridCodec(specs, latent_dim, options)
        self.actor = LatentActor(specs, *latent_dims, dims, proposes_each=options.discrete == "greedy")
        self.critics = LatentCritics(
            2 if options.twin else 1, specs.observation_dim, sum(latent_dims), dims, layer_norm=options.layer_norm
        )
        self.target_actor = copy.deepcopy(self.actor).requires_grad_(False)
        self.target_critics = copy.deepcopy(self.critics).requires_grad_(False)
        self.policy = HyARPolicy(self.actor, self.critics, self.codec, specs, options)
        # The codec's mean squared error of the scaled change of the state, see `correction_error`.
        self.dynamics_error = nn.Buffer(torch.ones((), dtype=torch.float32))
        # Saved only where they count: learners of earlier versions had neither.
        self.counts_episodes = options.noise_initial is not None or options.codec_episodes is not None
        self.episodes: Tensor = nn.Buffer(torch.zeros((), dtype=torch.long), persistent=self.counts_episodes)
        has_window = options.critic_window is not None
        self.warmup_rows = nn.Buffer(torch.zeros((), dtype=torch.long), persistent=has_window)

    def make_optimizers(self) -> dict[str, torch.optim.Optimizer]:
        """Return the optimizers by the names of what they learn."""
        options = self.options
        self.learning_rates = {"codec": options.codec_lr, "actor": options.actor_lr, "critics": options.critic_lr}
        modules = {"codec": self.codec, "actor": self.actor, "critics": self.critics}
        return {name: adam(rate, modules[name]) for name, rate in self.learning_rates.items()}

    def learn(self, batch: TensorDictBase, mask: Tensor) -> dict[str, float]:
        """Store the batch's transitions; after the warm-up, make the updates that are due."""
        before = int(self.episodes)
        if self.counts_episodes and int(self.frames) >= self.options.warmup_steps:
            self.episodes += (batch["next", keys.DONE].squeeze(-1) & mask).sum()
        scalars = super().learn(batch, mask)
        for number in range(self._codec_updates(before) + 1, self._codec_updates(int(self.episodes)) + 1):
            scalars |= {name: value.item() for name, value in self._update_codec(self._codec_sample()).items()}
            if number % self.options.latent_range_every == 0:
                self.fit_latent_range()
        return scalars

    def _codec_updates(self, episodes: int) -> int:
        """Return the updates of the codec that are due after this many episodes; 0 if steps decide, not episodes."""
        if self.options.codec_episodes is None:
            return 0
        return max(0, episodes - self.options.codec_first_episode) // self.options.codec_episodes

    def update_once(self, sample: TensorDictBase) -> dict[str, Tensor]:
        """Update the critics and, less often, the actor, the target networks and the codec."""
        scalars = self.gradient_step("critics", self.critic_loss, sample)
        scalars["epsilon"] = self.policy.epsilon
        if self.updates % self.policy_delay == 0:
            scalars |= self.descent.step(
                self.optimizers["actor"],
                self.actor_loss,
                sample["state"],
                self.allowed(sample),
                max_grad_norm=self.options.actor_max_grad_norm,
            )
            polyak_update(self.target_actor, self.actor, self.options.tau)
            polyak_update(self.target_critics, self.critics, self.options.tau)
        if self.options.codec_episodes is None and self.updates % self.options.codec_every == 0:
            own_sample = sample if self.options.codec_batch_size is None else self._codec_sample()
            scalars |= self._update_codec(own_sample)
            if self.updates % (self.options.latent_range_every * self.options.codec_every) == 0:
                self.fit_latent_range()
        return scalars

    def store(self, batch: TensorDictBase, mask: Tensor) -> None:
        """Store the batch's transitions."""
        if self.buffer.write_count == 0:  # also in a resumed run whose checkpoint has no stored transitions
            self.warmup_rows.zero_()
        super().store(batch, mask)
        if self.frames < self.options.warmup_steps:
            self.warmup_rows.fill_(self.buffer.write_count)

    def _codec_sample(self) -> TensorDictBase:
        """Return a sample of all stored transitions for an update of the codec."""
        return self.augmented(self.buffer.sample(self.options.codec_batch_size or self.options.batch_size))

    def _update_codec(self, sample: TensorDictBase) -> dict[str, Tensor]:
        scalars = self.gradient_step("codec", self.codec_loss, sample)
        if self.options.correction_error == "mean":
            self.dynamics_error.lerp_(scalars["dynamics"], 0.01)
        return scalars

    def sample_batches(self, num_batches: int) -> Iterator[TensorDictBase]:
        """Yield samples `[batch_size]` of the transitions that the critics learn from, once there are as many."""
        if self.options.critic_window is None:
            yield from super().sample_batches(num_batches)
            return
        stored, batch_size = self.buffer.write_count, self.options.batch_size
        num_rows = min(stored - int(self.warmup_rows), len(self.buffer), self.options.critic_window)
        if num_rows < batch_size:
            return
        for _ in range(num_batches):
            ages = torch.randint(num_rows, (batch_size,))
            yield self.augmented(self.buffer[(stored - 1 - ages) % self.options.buffer_size])

    def critic_loss(self, sample: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the squared distance of Q(s, e, z) from r + discount * V(s'), where V is `value`."""
        latent, is_corrected = self.corrected_latent(sample)
        q = self.critics(sample["state"], latent.unsqueeze(1)).squeeze(-1)
        loss = (q - self.target(sample)).square().mean(-1).sum()
        return loss, {"critic": loss, "redone": is_corrected.float().mean()}

    @torch.no_grad()
    def value(self, states: States, *, is_target: bool = False) -> Tensor:
        """Return the max over the target actor's allowed proposals a of min Q'(s, a), `[B]`.

        The proposals of targets carry clipped noise.
        """
        observation = states.observation
        allowed = self.specs.allowed(observation, states.action_mask)
        given = with_clipped_noise(self.target_actor(observation), *(self.smoothing if is_target else (0.0, 0.0)))
        proposals = self.target_actor.proposals(given, self.codec.embeddings)
        if not self.actor.proposes_each:
            return self.target_critics(observation, self.codec.of_allowed(proposals, allowed)).amin(0).amax(-1)
        return masked_values(self.target_critics(observation, proposals).amin(0), allowed).amax(-1)

    def actor_loss(self, state: Tensor, allowed: Tensor | None) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss that falls with the values of the actor's allowed proposals by the first critic."""
        raw = self.actor.raw(state)
        given = InvertingGradients.apply(raw.tanh()) if self.options.inverting_gradients else raw.tanh()
        proposals = self.actor.proposals(given, self.codec.embeddings.detach())
        if not self.actor.proposes_each:
            proposals = self.codec.of_allowed(proposals, allowed)
        q = self.critics(state, proposals, num_members=1)
        value = (q if allowed is None or not self.actor.proposes_each else q * allowed).sum(-1)
        loss = searching_actor_loss(
            self.options, value, raw, partial(self._search, state, raw, proposals.detach(), allowed)
        )
        return loss, {"actor": -value.mean()}

    def _search(self, state: Tensor, raw: Tensor, proposals: Tensor, allowed: Tensor | None) -> tuple[Tensor, Tensor]:
        """Find for every proposal the best of random latent actions, by the critics.

        The random ones differ from the proposal in z. If the actor gives one proposal alone, they also differ in the
        discrete action, one of the allowed.

        Args:
            state: `[B, observation_dim]`.
            raw: what the actor gives there before tanh, `[B, P, num_given]`.
            proposals: made of it, `[B, P, embedding_dim + latent_dim]`.
            allowed: bool `[B, num_discrete]`. If None, all.

        Returns:
            By how much the best one is better than each proposal, at least 0, and the squared distance to it,
            `[B, P]` each.
        """
        shape = (*proposals.shape[:2], self.options.search_samples)
        with torch.no_grad():
            if self.actor.proposes_each:
                e = proposals[..., : -self.codec.latent_dim].unsqueeze(2).expand(*shape, -1)
            else:
                mask = None if allowed is None else allowed[:, None, None].expand(*shape, -1)
                discrete = random_choice(torch.Size(shape), self.specs.num_discrete, mask, state.device)
                e = self.codec.embeddings[discrete]
            z = 2.0 * torch.rand(*shape, self.codec.latent_dim, device=state.device, dtype=torch.float32) - 1.0
            num_rows = max(1, _MAX_CANDIDATES // (shape[1] * shape[2]))
            best_of = partial(best_of_proposals, self.critics)
            best, best_value = in_pieces(best_of, num_rows, state, torch.cat([e, z], -1))
            gain = (best_value - self.critics(state, proposals).amin(0)).clamp(min=0.0)
            gain = gain * allowed if self.actor.proposes_each and allowed is not None else gain
        return gain, (raw - unsquashed(self.actor.given(best))).square().sum(-1)

    def corrected_latent(self, batch: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return latents that the codec still decodes to the executed actions, and which of them were corrected, `[B]`.

        This is the representation-shift correction. If e no longer decodes to the discrete action, it is replaced by
        that action's embedding. If z is no longer current, it is encoded again: if the error of its predicted change is
        above `correction_factor` times the codec's error (`correction_error`). With `parameter_tolerance`, the errors
        of its decoded parameters count instead. With `relabelling="sample"` the new e carries noise, and the new z is a
        sample of the encoder's distribution instead of its mean.

        Latents are `[B, embedding_dim + latent_dim]`.
        """
        state = batch["state"]
        discrete = batch["discrete"]
        with torch.no_grad():
            e, z = batch[LATENT].split([self.codec.table.shape[-1], self.codec.latent_dim], -1)
            is_current = self._is_current(batch, z)
            is_same_discrete = (self.codec.nearest_discrete(e.nan_to_num()) == discrete) & ~e.isnan().any(-1)
            new_e = self.codec.embeddings[discrete]
            if self.actor.proposes_each:
                e = new_e  # the critics are asked about these alone
            else:
                if self.options.relabelling == "sample":
                    new_e = with_clipped_noise(new_e, 0.1, 0.5)
                e = torch.where(is_same_discrete.unsqueeze(-1), e, new_e)
            new_z, log_variance = self.codec.encode(state, discrete, batch["unit"])
            if self.options.relabelling == "sample":
                new_z = new_z + (0.5 * log_variance).exp() * torch.randn_like(new_z)
            z = torch.where(is_current.unsqueeze(-1), z, self.codec.z_to_unit(new_z))
        return torch.cat([e, z], -1), ~(is_same_discrete & is_current)

    def _is_current(self, batch: TensorDictBase, z: Tensor) -> Tensor:
        """Return whether stored z `[B, latent_dim]` in [-1, 1] still stand for what was executed, bool `[B]`.

        A random action's z is NaN. Comparisons with NaN are false, so it is never current.
        """
        state, discrete = batch["state"], batch["discrete"]
        z = self.codec.z_from_unit(z)
        if self.options.parameter_tolerance is None:
            target = self.codec.scaled_change(state, batch["next_state"])
            error = (self.codec.change(state, discrete, z) - target).square().mean(-1)
            return error <= self.options.correction_factor * self.dynamics_error
        unit_parameters, _ = self.codec.decode(state, discrete, z)
        error = ((unit_parameters - batch["unit"]) * self.codec.mask[discrete]).abs().amax(-1)
        return error <= self.options.parameter_tolerance

    def codec_loss(self, sample: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the codec's loss and its parts."""
        state, discrete, executed = sample["state"], sample["discrete"], sample["unit"]
        mean, log_variance = self.codec.encode(state, discrete, executed)
        z = mean + (0.5 * log_variance).exp() * torch.randn_like(mean)
        unit_parameters, change = self.codec.decode(state, discrete, z)
        is_own = self.codec.mask[discrete]
        errors = ((unit_parameters - executed).square() * is_own).sum(-1)
        divergences = -0.5 * (1.0 + log_variance - mean.square() - log_variance.exp()).sum(-1)
        if self.options.codec_loss == "mean":
            errors, divergences = errors / is_own.sum(-1).clamp(min=1.0), divergences / self.codec.latent_dim
        reconstruction, divergence = errors.mean(), divergences.mean()
        dynamics = F.mse_loss(change, self.codec.scaled_change(state, sample["next_state"]))
        loss = (
            self.options.reconstruction_weight * reconstruction
            + self.options.kl_weight * divergence
            + self.options.dynamics_weight * dynamics
        )
        return loss, {"reconstruction": reconstruction, "kl": divergence, "dynamics": dynamics}

    def start(self) -> None:
        """Train the codec alone."""
        if not self.codec.is_change_bounded:
            stored = self.buffer[:]
            self.codec.change_scale.copy_(scale_of(stored["next_state"] - stored["state"]))
        for _ in range(self.options.codec_pretrain_updates):
            self._update_codec(self._codec_sample())
        self.fit_latent_range()

    def on_progress(self, steps: int) -> None:
        """Lower the probability of random actions, the noise and the learning rates."""
        options = self.options
        self.policy.epsilon.fill_(schedule(steps, options.epsilon_steps, options.epsilon_final))
        if options.noise_initial is not None:
            final = options.parameter_noise / options.noise_initial
            part = schedule(int(self.episodes), options.noise_episodes, final)
            self.policy.noise.fill_(options.noise_initial * part)
        fraction = schedule(steps, options.lr_steps, options.lr_final_fraction, options.lr_schedule)
        set_learning_rates(self.optimizers, self.learning_rates, fraction)

    def fit_latent_range(self) -> None:
        """Set the range of z to the central `latent_coverage` of stored actions, encoded.

        With `change_unit="stored"`, also set the unit of the predicted change. With that or with
        `correction_error="latest"`, set the codec's error to that of the same actions.
        """
        sample = self.buffer.sample(4096)
        state, discrete = sample["state"], sample["discrete"]
        has_new_unit = self.options.change_unit == "stored" and not self.codec.is_change_bounded
        if has_new_unit:
            self.codec.set_change_scale(scale_of(sample["next_state"] - state))
        with torch.no_grad():
            mean, log_variance = self.codec.encode(state, discrete, sample["unit"])
            # Samples, not means: in a dimension that the codec does not use, all means are alike. Mapping their narrow
            # range onto [-1, 1] would blow up differences that mean nothing.
            z = mean + (0.5 * log_variance).exp() * torch.randn_like(mean)
            if self.options.correction_error == "latest" or has_new_unit:
                change = self.codec.scaled_change(state, sample["next_state"])
                self.dynamics_error.copy_(F.mse_loss(self.codec.change(state, discrete, z), change))
        tail = (1.0 - self.options.latent_coverage) / 2.0
        low, high = z.quantile(tail, 0), z.quantile(1.0 - tail, 0)
        self.codec.z_low.copy_(low)
        self.codec.z_high.copy_(torch.maximum(high, low + 1e-3))

    def transitions(self, batch: TensorDictBase) -> TensorDict:
        """Return the rows to store, with the latent actions that the actor gave; NaN where an exploration acted."""
        latent = batch[LATENT]
        if self.is_overruled:
            latent = torch.where(batch[keys.IS_HELD].unsqueeze(-1), torch.nan, latent)
        return super().transitions(batch).set(LATENT, latent)

    def augmented(self, sample: TensorDictBase) -> TensorDictBase:
        """Return a sample mapped by random symmetries; the latent actions are encoded again later."""
        if self.symmetry is None:
            return sample
        mapped = self.symmetry(sample)
        return mapped.set(LATENT, torch.full_like(mapped[LATENT], torch.nan))
