"""P-DQN and MP-DQN: Q-learning over discrete actions whose parameters a deterministic network chooses.

One network gives the parameters x(s) of all discrete actions, another the value Q(s, k, x) of every discrete action k.
The policy takes the discrete action with the highest Q; x is trained to increase the sum of all discrete actions' Q.

Source: Xiong et al., *Parametrized Deep Q-Networks Learning: Reinforcement Learning with Discrete-Continuous Hybrid
Action Space*, 2018, arXiv 1810.06394, algorithm 1. Multi-pass: Bester, James and Konidaris, *Multi-Pass Q-Networks for
Deep Reinforcement Learning with Parameterised Action Spaces*, 2019, arXiv 1905.04388. Twin critics, target smoothing,
delayed actor: Fujimoto, van Hoof and Meger 2018, arXiv 1802.09477 (TD3). Double Q: van Hasselt, Guez and Silver 2016,
arXiv 1509.06461. Inverting gradients: Hausknecht and Stone 2016, arXiv 1511.04143. Ornstein-Uhlenbeck noise: Lillicrap
et al. 2016, arXiv 1509.02971, with the form and the constant of Bester et al.'s code. Penalty on preactivations:
Andrychowicz et al. 2017, arXiv 1707.01495, appendix A. Towards the best of random actions: Neumann et al. 2023,
*Greedy Actor-Critic*, arXiv 1810.09103.

Differs from the source:
- one learner with uniform replay and target networks replaces asynchronous learners; each target network moves at its
  own rate, as in Bester et al.;
- with `greedy_samples` the greedy policy also values variations of x(s) and takes the best of them. The critics often
  know better parameters than the actor's gradient has found. Training stays the same;
- with `search_samples` the actor is also drawn to the best of uniformly random parameters of each discrete action. The
  weight is their gain in value. A gradient alone stays on the hill that it began on;
- with `layer_norm` the critics' layers are normalised (Ball et al. 2023, arXiv 2302.02948);
- critic updates compute only the chosen action's pass, and all passes share the state's part of the first layer;
- networks have PyTorch's initialisation, the actor's last layer scaled by 0.01. In the code of Bester et al. layers
  start as Kaiming et al. proposed, biases at 0, and the actor's outputs near 0. On Goal the critic's outputs do, too;
- parameters are clipped to their bounds before a critic sees them and before they are stored, also with inverting
  gradients. In the code of Bester et al. critics see and the buffer stores what the actor gave;
- the defaults add what TD3 adds to DDPG: twin critics, target smoothing and a delayed actor. The actor, too, increases
  the minimum of both critics; TD3's actor uses the first one. The noise in the target has a standard deviation of 0.1
  and is clipped at 0.2; TD3 has 0.2 and 0.5;
- the defaults squash parameters by tanh, do not clip gradients, draw the parameters of random actions uniformly, and
  add Gaussian noise to the others. Both networks have one learning rate and one target rate. There is an update for
  every four steps, and epsilon falls with the steps to 0.05. In the code of Bester et al. there is one for each step,
  and epsilon falls with the episodes to 0.01. `pdqn_published.yaml` has the settings of Bester et al. instead.

TorchRL's DQNLoss does not fit: its value network sees the observation alone. Here Q and its target also take the
parameters, which come from a network with a target and a loss of its own. Its OrnsteinUhlenbeckProcessModule does not
fit either: it adds noise to an action in the environment's units and begins again with each episode.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from functools import partial

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from hpamdp import keys
from hpamdp.acting import is_greedy
from hpamdp.policies.base import States, option_ends, step_discounts
from hpamdp.policies.low_level.pdqn_options import CARDS, PDQNOptions
from hpamdp.policies.masks import allowed_rows, masked_values, random_discrete, zero_fixed
from hpamdp.policies.shared.actor_search import even_normal, in_pieces, searching_actor_loss, with_variations
from hpamdp.policies.shared.exploration import schedule, with_exploring_noise
from hpamdp.policies.shared.gradients import adam, set_learning_rates
from hpamdp.policies.shared.networks import (
    HybridCritics,
    InitialLayer,
    InvertingGradients,
    as_preactivations,
    mlp,
    polyak_update,
    unsquashed,
    with_clipped_noise,
)
from hpamdp.policies.shared.options import InitialParameters
from hpamdp.policies.shared.perception import Perception
from hpamdp.policies.shared.replay import ReplayLearner
from hpamdp.specs import PAMDPSpecs

PROCESS = "noise_process"  # the last step's noise, if it is a process, float32 [*B, num_parameters]
_PULL = 0.15  # fraction of the process that is lost in a step

# Numbers that the critics evaluate at once for the greedy policy: bounds the memory if there are many discrete actions.
_MAX_NUMBERS = 1 << 22


class ParameterActor(nn.Module):
    """The parameters of all discrete actions: `[*B, observation_dim]` -> `[*B, num_parameters]` in [-1, 1]."""

    def __init__(
        self, specs: PAMDPSpecs, hidden_dims: Sequence[int], bounding: str, initial_parameters: InitialParameters
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
        return as_preactivations(self.net(state)) + self.initial(state)

    def bounded(self, raw: Tensor) -> Tensor:
        """Return parameters in [-1, 1], given those before they are bounded."""
        return InvertingGradients.apply(raw) if self.is_inverting else raw.tanh()

    def unbounded(self, unit_parameters: Tensor) -> Tensor:
        """Return the inverse of `bounded`, after clamping parameters at a bound to values close to it."""
        return unit_parameters if self.is_inverting else unsquashed(unit_parameters)


def best_of_candidates(critics: HybridCritics, state: Tensor, candidates: Tensor) -> tuple[Tensor, Tensor]:
    """Return every discrete action's highest value and the index of the candidate with it, `[B, num_discrete]` each.

    Args:
        critics: value the parameters; the lowest of their values counts.
        state: `[B, observation_dim]`.
        candidates: T parameter vectors in each state, `[B, T, num_parameters]` in [-1, 1].
    """
    num_candidates = candidates.shape[1]
    q = critics(state.repeat_interleave(num_candidates, 0), candidates.flatten(0, 1)).amin(0)
    best_value, best_index = q.unflatten(0, (-1, num_candidates)).max(1)
    return best_value, best_index


class PDQNPolicy(TensorDictModuleBase):
    """Takes the discrete action with the highest Q; explores with random actions and noise on the parameters."""

    def __init__(
        self,
        actor: ParameterActor,
        critics: HybridCritics,
        perception: Perception,
        specs: PAMDPSpecs,
        options: PDQNOptions,
    ) -> None:
        super().__init__()
        self.in_keys = list(perception.in_keys)
        self.out_keys = [keys.DISCRETE, keys.PARAMETERS, *perception.out_keys]
        self.has_process = options.noise_process == "ornstein_uhlenbeck"
        if self.has_process:
            self.in_keys.append(PROCESS)
            self.out_keys.append(PROCESS)
        self.draws_parameters = options.random_parameters == "uniform"
        self.perception = perception
        self.actor = actor
        self.critics = critics
        self.specs = specs
        self.noise = options.parameter_noise
        self.epsilon = nn.Buffer(torch.ones((), dtype=torch.float32))
        variations = even_normal(options.greedy_samples, specs.num_parameters, options.greedy_noise)
        self.variations = nn.Buffer(variations, persistent=False)

    @torch.no_grad()
    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write the discrete action `[*B]` and the parameters `[*B, num_parameters]`."""
        state = self.perception.see(td).reshape(-1, self.perception.specs.observation_dim)
        allowed = allowed_rows(self.specs, td)
        observation = td.get(keys.OBSERVATION)
        # An export keeps the size of a batch open, which `len` would fix.
        is_fixed = self.specs.is_fixed(observation.reshape(-1, observation.shape[-1]))
        unit_parameters = zero_fixed(self.actor(state), is_fixed)
        if is_greedy() and len(self.variations) > 0:
            discrete, unit_parameters = self._best_variation(state, unit_parameters, allowed, is_fixed)
        else:
            values = masked_values(self.critics(state, unit_parameters).amin(0), allowed)
            discrete = self.specs.components.best(values)
        if not is_greedy():
            is_random = torch.rand(len(discrete), device=discrete.device, dtype=torch.float32) < self.epsilon
            noisy = self._with_noise(unit_parameters, td)
            if self.draws_parameters:
                random_parameters = 2.0 * torch.rand_like(unit_parameters) - 1.0
                noisy = torch.where(is_random.unsqueeze(-1), random_parameters, noisy)
            unit_parameters = noisy
            random_actions = random_discrete(self.specs, is_random.shape, allowed, discrete.device)
            is_random = is_random.reshape(-1, *[1] * (discrete.ndim - 1))
            discrete = torch.where(is_random, random_actions, discrete)
        td.set(keys.DISCRETE, discrete.reshape((*td.batch_size, *discrete.shape[1:])))
        unit_parameters = unit_parameters.reshape((*td.batch_size, self.specs.num_parameters))
        if self.has_process and td.get(PROCESS, None) is None:
            td.set(PROCESS, torch.zeros_like(unit_parameters))
        return td.set(keys.PARAMETERS, self.specs.from_unit(unit_parameters, td))

    def _with_noise(self, unit_parameters: Tensor, td: TensorDictBase) -> Tensor:
        """Return parameters `[B, num_parameters]` with the exploring noise of a step, and keep the process in `td`."""
        if not self.has_process:
            return with_exploring_noise(unit_parameters, self.noise)
        before = td.get(PROCESS, None)
        before = torch.zeros_like(unit_parameters) if before is None else before.reshape(unit_parameters.shape)
        process = (1.0 - _PULL) * before + self.noise * torch.randn_like(unit_parameters)
        td.set(PROCESS, process.reshape(*td.batch_size, self.specs.num_parameters))
        return (unit_parameters + process).clamp(-1.0, 1.0)

    def _best_variation(
        self, state: Tensor, unit_parameters: Tensor, allowed: Tensor | None, is_fixed: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Return the discrete actions `[B]` and the parameters `[B, P]` that are best among x(s) and its variations."""
        num_candidates = 1 + len(self.variations)
        num_rows = max(1, _MAX_NUMBERS // (num_candidates * max(unit_parameters.shape[-1], self.specs.num_discrete)))

        def best_of(some_states: Tensor, some_parameters: Tensor, *fixed: Tensor) -> tuple[Tensor, Tensor]:
            candidates = with_variations(some_parameters, self.variations)
            candidates = zero_fixed(candidates, fixed[0].unsqueeze(-2) if fixed else None)
            return best_of_candidates(self.critics, some_states, candidates)

        fixed = () if is_fixed is None else (is_fixed,)
        best_values, best_indices = in_pieces(best_of, num_rows, state, unit_parameters, *fixed)
        discrete = self.specs.components.best(masked_values(best_values, allowed))
        variations = torch.cat([torch.zeros_like(self.variations[:1]), self.variations])
        if self.specs.components.is_single:
            best_index = best_indices.gather(-1, discrete.unsqueeze(-1)).squeeze(-1)
            variation = variations[best_index]
        else:  # each discrete action's parameters from its own best candidate
            variation = variations.gather(0, best_indices.index_select(-1, self.critics.owner))
        return discrete, (unit_parameters + variation).clamp(-1.0, 1.0)


class PDQN(ReplayLearner):
    """Q-learning over discrete actions and gradient ascent on their parameters, from a replay buffer of its own."""

    Options = PDQNOptions
    card = CARDS["PDQN"]
    exploring_keys = frozenset({PROCESS})
    progress = ReplayLearner.progress | {"episodes"}

    options: PDQNOptions
    policy: PDQNPolicy

    def make_networks(self, specs: PAMDPSpecs) -> None:
        """Make the networks and the policy."""
        options = self.options
        self.stores_own_parameters = options.multipass and specs.components.is_single
        self.max_grad_norm = options.max_grad_norm
        self.episodes: Tensor = nn.Buffer(torch.zeros((), dtype=torch.long))

        dims = options.hidden_dims
        self.set_perception(options)
        seen = self.perception.specs
        self.actor = ParameterActor(seen, dims, options.bounding, options.initial_parameters)
        self.critics = HybridCritics(
            seen, 2 if options.twin else 1, dims, options.multipass, layer_norm=options.layer_norm
        )
        self.target_actor = copy.deepcopy(self.actor).requires_grad_(False)
        self.target_critics = copy.deepcopy(self.critics).requires_grad_(False)
        self.policy = PDQNPolicy(self.actor, self.critics, self.perception, specs, options)

    def make_optimizers(self) -> dict[str, torch.optim.Optimizer]:
        """Return the optimizers by the names of what they learn."""
        options = self.options
        self.learning_rates = {"actor": options.actor_lr, "critics": options.critic_lr}
        return {
            "actor": adam(options.actor_lr, self.actor),
            "critics": adam(options.critic_lr, self.critics, self.perception),
        }

    def update_once(self, sample: TensorDictBase) -> dict[str, Tensor]:
        """Update the critics; every `policy_delay` updates, also the actor and the targets. Return scalars.

        `ReplayLearner.update` has counted this update, from 1.
        """
        scalars = self.gradient_step("critics", self.critic_loss, sample)
        scalars["epsilon"] = self.policy.epsilon
        if self.updates % self.options.policy_delay == 0:
            given = self.detached(sample), self.allowed(sample), self.fixed(sample)
            scalars |= self.gradient_step("actor", self.actor_loss, *given)
            polyak_update(self.target_actor, self.actor, self.options.actor_tau)
            polyak_update(self.target_critics, self.critics, self.options.critic_tau)
            polyak_update(self.target_perception, self.perception, self.options.critic_tau)
        return scalars

    @torch.no_grad()
    def value(self, states: States, *, is_target: bool = False) -> Tensor:
        """Return max_k Q'(s, k, x'(s)) over the allowed discrete actions k, `[B]`; the sum over the components.

        With `double_q`, the learned critics choose k instead of the target critics. Targets have `target_smoothing`.
        """
        state = self.target_perception.of_states(states)
        smoothing = self.options.target_smoothing if is_target else 0.0
        unit_parameters = with_clipped_noise(self.target_actor(state), smoothing, self.options.target_smoothing_clip)
        unit_parameters = zero_fixed(unit_parameters, self.specs.is_fixed(states.observation))
        q = self.target_critics(state, unit_parameters).amin(0)
        choosing_q = q
        if self.options.double_q:
            choosing_q = self.critics(self.perception.of_states(states), unit_parameters).amin(0)
        choosing_q = masked_values(choosing_q, self.specs.allowed(states.observation, states.action_mask))
        components = self.specs.components
        return components.total(components.of_choice(q, components.best(choosing_q)))

    def actor_loss(
        self, state: Tensor, allowed: Tensor | None, is_fixed: Tensor | None = None
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Return minus the sum of the allowed discrete actions' values; only the actor gets its gradient."""
        raw = self.actor.raw(state)
        q = self.critics(state, zero_fixed(self.actor.bounded(raw), is_fixed)).amin(0)
        value = (q if allowed is None else q * allowed).sum(-1)
        loss = searching_actor_loss(self.options, value, raw, partial(self._search, state, raw, q, allowed, is_fixed))
        return loss, {"actor": -value.mean()}

    def _search(
        self, state: Tensor, raw: Tensor, q: Tensor, allowed: Tensor | None, is_fixed: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Find for every discrete action the best of random parameters, by the critics.

        Args:
            state: what the networks see, `[B, perception.specs.observation_dim]`.
            raw: the actor's parameters there, before they are bounded, `[B, num_parameters]`.
            q: their values, `[B, num_discrete]`.
            allowed: the discrete actions that may be taken, bool `[B, num_discrete]`. If None, all.
            is_fixed: the parameters that have a single value there, bool `[B, num_parameters]`. If None, none.

        Returns:
            For each parameter, the gain in value of the best random parameters of its discrete action, at least 0. Then
            the squared distance to these. Both are `[B, num_parameters]`.
        """
        shape = len(state), self.options.search_samples, self.specs.num_parameters
        with torch.no_grad():
            candidates = 2.0 * torch.rand(shape, device=state.device, dtype=torch.float32) - 1.0
            candidates = zero_fixed(candidates, None if is_fixed is None else is_fixed.unsqueeze(-2))
            best_value, best_index = best_of_candidates(self.critics, state, candidates)
            best_parameters = candidates.gather(1, best_index[:, self.owner].unsqueeze(1)).squeeze(1)
            gain = (best_value - q).clamp(min=0.0)
            gain = gain if allowed is None else gain * allowed
        return gain[:, self.owner], (raw - self.actor.unbounded(best_parameters)).square()

    def learn(self, batch: TensorDictBase, mask: Tensor) -> dict[str, float]:
        """Store the batch's transitions, count its episodes; after the warm-up, make the updates that are due."""
        self.episodes += (batch["next", keys.DONE].squeeze(-1) & mask).sum()
        options = self.options
        if options.epsilon_episodes is not None:
            fallen = schedule(int(self.episodes), options.epsilon_episodes, options.epsilon_final)
            self.policy.epsilon.fill_(fallen)
        return super().learn(batch, mask)

    def on_progress(self, steps: int) -> None:
        """Lower the probability of random actions, and the learning rates."""
        options = self.options
        if options.epsilon_episodes is None:
            self.policy.epsilon.fill_(schedule(steps, options.epsilon_steps, options.epsilon_final))
        fraction = schedule(steps, options.lr_steps, options.lr_final_fraction, options.lr_schedule)
        set_learning_rates(self.optimizers, self.learning_rates, fraction)

    def num_updates(self, steps: int) -> int:
        """Return the number of updates, or 0 with at most one hidden layer.

        With 0, `compile_updates=auto` does not compile: compiled updates of such networks take longer.
        """
        return super().num_updates(steps) if len(self.options.hidden_dims) > 1 else 0

    def transitions(self, batch: TensorDictBase) -> TensorDict:
        """Return every row with its n-step return, the state that follows and the discount of that state's value."""
        rows = super().transitions(batch)
        done = option_ends(batch).squeeze(-1)
        terminated = batch["next", keys.TERMINATED].squeeze(-1)
        discounts = step_discounts(batch, self.options.gamma) * torch.ones_like(batch["next", keys.REWARD])
        reward, last, discount = n_step_returns(rows["reward"], discounts.squeeze(-1), done, self.options.n_step)
        rows["reward"] = reward
        rows["discount"] = discount * ~terminated.gather(-1, last)
        for name in ("option_ended", "next_option", "next_state", "next_action_mask"):
            if name in rows.keys():
                rows[name] = _at_times(rows[name], last)
        if self.memory_key is not None and self.options.n_step > 1:
            rows["last_memory"] = _at_times(rows["memory"], last)
        return rows


def _at_times(values: Tensor, time: Tensor) -> Tensor:
    """Return values `[*B, T, ...]` at times `[*B, T]`."""
    return values.take_along_dim(time.reshape(*time.shape, *[1] * (values.ndim - time.ndim)), time.ndim - 1)


def n_step_returns(reward: Tensor, discount: Tensor, done: Tensor, n: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return the discounted sums of the next `n` rewards, the times of the last of them and the discounts after it.

    Each has the shape `[*B, T]`. Sums end early where `done`, and at the end of the batch. TorchRL's MultiStep computes
    the same sums, but its memory grows with episodes times steps of a batch: 9 GB for a data set of 25,000 steps in
    8,000 episodes.

    Args:
        reward: `[*B, T]`.
        discount: of each step, `[*B, T]`.
        done: where the episode or the option ends, bool `[*B, T]`.
        n: largest number of rewards in a sum.
    """
    num_steps = reward.shape[-1]
    time = torch.arange(num_steps, device=reward.device).expand_as(done)
    total, product = reward, discount
    last = time
    is_over = done
    for i in range(1, min(n, num_steps)):
        following = (time + i).clamp(max=num_steps - 1)
        is_over = is_over | (time + i >= num_steps)
        total = torch.where(is_over, total, total + product * reward.gather(-1, following))
        product = torch.where(is_over, product, product * discount.gather(-1, following))
        last = torch.where(is_over, last, following)
        is_over = is_over | done.gather(-1, following)
    return total, last, product
