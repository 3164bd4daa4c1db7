"""P-DQN and MP-DQN: a deep Q-network over the keys, whose parameters a deterministic network chooses.

One network gives the parameters x(s) of all keys, another Q(s, k, x) of every key; the key with the highest Q is
pressed, and x ascends the sum of Q over the keys.

Source: Xiong et al., *Parametrized Deep Q-Networks Learning: Reinforcement Learning with Discrete-Continuous Hybrid
Action Space*, 2018, arXiv 1810.06394, algorithm 1. Multi-pass: Bester, James and Konidaris, *Multi-Pass Q-Networks for
Deep Reinforcement Learning with Parameterised Action Spaces*, 2019, arXiv 1905.04388. Twin critics, target smoothing,
delayed actor: Fujimoto, van Hoof and Meger 2018, arXiv 1802.09477 (TD3). Double Q: van Hasselt, Guez and Silver 2016,
arXiv 1509.06461. Inverting gradients: Hausknecht and Stone 2016, arXiv 1511.04143.

Differs from the source:
- target networks, with a rate each, and uniform replay, as in Bester et al.; one learner instead of asynchronous ones;
- only the pass of the pressed key is computed where the others' values do not matter;
- with twin critics, Q is their minimum everywhere: in targets, in the parameters' ascent and in choosing the key;
- exploration adds Gaussian noise to the parameters beside the epsilon-random presses.

TorchRL's DQNLoss does not fit: it takes one discrete action and a value of the observation alone, while both Q and its
target here are functions of parameters that another network, with a target and a loss of its own, gives for every key.
"""

from __future__ import annotations

import copy
from typing import Any, ClassVar, Literal

import torch
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from hpamdp import keys
from hpamdp.policies.base import is_greedy, option_ends
from hpamdp.policies.shared.fractions import Fraction, PositiveFraction
from hpamdp.policies.shared.networks import HybridCritics, mlp, polyak_update
from hpamdp.policies.shared.replay import ReplayLearner, linear_schedule
from hpamdp.specs import PAMDPSpecs


class InvertingGradients(torch.autograd.Function):
    """Clip to [-1, 1]; scale the gradient by the room left in its direction, so that it turns back past a bound."""

    @staticmethod
    def forward(ctx: Any, raw: Tensor) -> Tensor:
        """Return the clipped parameters."""
        ctx.save_for_backward(raw)
        return raw.clamp(-1.0, 1.0)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        """Return the gradient of a loss, which a descent follows upwards where it is negative."""
        (raw,) = ctx.saved_tensors
        return gradient * torch.where(gradient < 0.0, 1.0 - raw, 1.0 + raw) * 0.5


class ParameterActor(nn.Module):
    """The parameters of all keys, `[*B, observation_dim]` -> `[*B, num_parameters]` in [-1, 1]."""

    def __init__(self, specs: PAMDPSpecs, hidden_dims: list[int], bounding: str) -> None:
        super().__init__()
        self.net = mlp(specs.observation_dim, hidden_dims, specs.num_parameters)
        self.is_inverting = bounding == "inverting_gradients"

    def forward(self, state: Tensor) -> Tensor:
        """Return the bounded parameters."""
        raw = self.net(state)
        return InvertingGradients.apply(raw) if self.is_inverting else raw.tanh()


class PDQNPolicy(TensorDictModuleBase):
    """The key with the highest Q and its parameters; explores with random presses and noise on the parameters."""

    def __init__(self, actor: ParameterActor, critics: HybridCritics, specs: PAMDPSpecs, noise: float) -> None:
        super().__init__()
        self.in_keys = [keys.OBSERVATION]
        self.out_keys = [keys.DISCRETE, keys.PARAMETERS]
        self.actor, self.critics, self.specs, self.noise = actor, critics, specs, noise
        self.register_buffer("epsilon", torch.ones(()))

    @torch.no_grad()
    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write key `[*B]` and parameters `[*B, num_parameters]`."""
        state = td.get(keys.OBSERVATION).reshape(-1, self.specs.observation_dim)
        unit = self.actor(state)
        discrete = self.critics(state, unit).amin(0).argmax(-1)
        if not is_greedy():
            is_random = torch.rand(discrete.shape, device=discrete.device) < self.epsilon
            noisy = (unit + self.noise * torch.randn_like(unit)).clamp(-1.0, 1.0)
            unit = torch.where(is_random.unsqueeze(-1), 2.0 * torch.rand_like(unit) - 1.0, noisy)
            discrete = torch.where(is_random, torch.randint_like(discrete, self.specs.num_discrete), discrete)
        td.set(keys.DISCRETE, discrete.reshape(td.batch_size))
        return td.set(keys.PARAMETERS, self.specs.from_unit(unit).reshape(*td.batch_size, -1))


class PDQN(ReplayLearner):
    """Q-learning over the keys and gradient ascent on their parameters, from a replay buffer of its own."""

    has_value: ClassVar[bool] = True

    def __init__(
        self,
        specs: PAMDPSpecs,
        device: torch.device,
        *,
        multipass: bool,
        twin_q: bool,
        double_q: bool,
        target_smoothing: NonNegativeFloat,
        target_smoothing_clip: NonNegativeFloat,
        policy_delay: PositiveInt,
        n_step: PositiveInt,
        bounding: Literal["tanh", "inverting_gradients"],
        hidden_dims: list[PositiveInt],
        warmup_frames: NonNegativeInt,
        buffer_size: PositiveInt,
        batch_size: PositiveInt,
        updates_per_frame: PositiveFloat,
        gamma: PositiveFraction,
        actor_lr: PositiveFloat,
        critic_lr: PositiveFloat,
        actor_tau: PositiveFraction,
        critic_tau: PositiveFraction,
        max_grad_norm: PositiveFloat | None,
        parameter_noise: NonNegativeFloat,
        epsilon_final: Fraction,
        epsilon_frames: NonNegativeInt,
    ) -> None:
        super().__init__(
            specs,
            device,
            gamma=gamma,
            warmup_frames=warmup_frames,
            buffer_size=buffer_size,
            batch_size=batch_size,
            updates_per_frame=updates_per_frame,
        )
        self.double_q, self.policy_delay, self.n_step = double_q, policy_delay, n_step
        self.target_smoothing, self.target_smoothing_clip = target_smoothing, target_smoothing_clip
        self.actor_tau, self.critic_tau, self.max_grad_norm = actor_tau, critic_tau, max_grad_norm
        self.epsilon_final, self.epsilon_frames = epsilon_final, epsilon_frames

        self.actor = ParameterActor(specs, hidden_dims, bounding)
        self.critics = HybridCritics(specs, 2 if twin_q else 1, hidden_dims, multipass)
        self.target_actor = copy.deepcopy(self.actor).requires_grad_(False)
        self.target_critics = copy.deepcopy(self.critics).requires_grad_(False)
        self.policy = PDQNPolicy(self.actor, self.critics, specs, parameter_noise)
        self.to(device)
        self.optimizers = {
            "actor": torch.optim.Adam(self.actor.parameters(), lr=actor_lr, fused=True),
            "critics": torch.optim.Adam(self.critics.parameters(), lr=critic_lr, fused=True),
        }

    def value(self, observation: Tensor) -> Tensor:
        """Return the highest Q at the actor's parameters, `[B]`."""
        return self.critics(observation, self.actor(observation)).amin(0).amax(-1)

    def explore(self, frames: int) -> None:
        """Let the share of random presses fall."""
        self.policy.epsilon.fill_(linear_schedule(frames, self.epsilon_frames, self.epsilon_final))

    def transitions(self, batch: TensorDictBase) -> TensorDict:
        """Return every row with its n-step return, the state after it and the discount of that state's value."""
        rows = super().transitions(batch)
        done = option_ends(batch).squeeze(-1)
        reward, last = n_step_returns(rows["reward"], done, self.n_step, self.gamma)
        steps = last - torch.arange(done.shape[-1], device=last.device) + 1
        goes_on = ~batch["next", keys.TERMINATED].squeeze(-1).gather(-1, last)
        next_state = rows["next_state"]
        next_state = next_state.gather(-2, last.unsqueeze(-1).expand_as(next_state))
        return rows.update({"reward": reward, "next_state": next_state, "discount": self.gamma**steps * goes_on})

    def train_step(self, sample: TensorDictBase) -> dict[str, Tensor]:
        """Update the critics, now and then also the actor and the targets."""
        state = sample["state"]
        q = self.critics.of_discrete(state, sample["discrete"], sample["unit"])
        critic_loss = (q - self._target(sample)).square().mean(-1).sum()
        self.optimizer_step("critics", critic_loss, self.max_grad_norm)
        scalars = {"critic": critic_loss, "q": q.mean(), "epsilon": self.policy.epsilon}
        if self.updates % self.policy_delay == 0:
            scalars["actor"] = self._update_actor(state)
            polyak_update(self.target_actor, self.actor, self.actor_tau)
            polyak_update(self.target_critics, self.critics, self.critic_tau)
        return scalars

    def _update_actor(self, state: Tensor) -> Tensor:
        """Let the parameters of all keys ascend the sum of their values; return the loss."""
        self.critics.requires_grad_(False)
        loss = -self.critics(state, self.actor(state)).amin(0).sum(-1).mean()
        self.optimizer_step("actor", loss, self.max_grad_norm)
        self.critics.requires_grad_(True)
        return loss

    def _target(self, batch: TensorDictBase) -> Tensor:
        """Return r + discount max_k Q'(s', k, x'(s')), `[B]`, where the discount is 0 after a termination."""
        state = batch["next_state"]
        with torch.no_grad():
            unit = self.target_actor(state)
            if self.target_smoothing > 0.0:
                bound = self.target_smoothing_clip
                noise = (self.target_smoothing * torch.randn_like(unit)).clamp(-bound, bound)
                unit = (unit + noise).clamp(-1.0, 1.0)
            q = self.target_critics(state, unit).amin(0)
            choosing = self.critics(state, unit).amin(0) if self.double_q else q
            best = q.gather(-1, choosing.argmax(-1, keepdim=True)).squeeze(-1)
            return batch["reward"] + batch["discount"] * best


def n_step_returns(reward: Tensor, done: Tensor, n: int, gamma: float) -> tuple[Tensor, Tensor]:
    """Return the discounted sums of the next `n` rewards and the times of the last of them, each `[*B, T]`.

    Sums end early with their episode or with the batch. `reward` and `done` (bool) are `[*B, T]`.
    """
    num_steps = reward.shape[-1]
    time = torch.arange(num_steps, device=reward.device).expand_as(done)
    total, last, is_over = reward, time, done
    for i in range(1, min(n, num_steps)):
        following = (time + i).clamp(max=num_steps - 1)
        is_over = is_over | (time + i >= num_steps)
        total = torch.where(is_over, total, total + gamma**i * reward.gather(-1, following))
        last = torch.where(is_over, last, following)
        is_over = is_over | done.gather(-1, following)
    return total, last
