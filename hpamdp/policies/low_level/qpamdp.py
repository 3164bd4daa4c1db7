"""Q-PAMDP: learn which key to press and, with that frozen, for how long; then the other way round.

Sarsa(lambda) with linear values of the keys and an episodic natural actor-critic (eNAC) for the parameters take turns.

Source: Masson, Ranchod and Konidaris, *Reinforcement Learning with Parameterized Actions*, 2016, arXiv 1509.01644:
algorithm 1 and section 5; eNAC: Peters and Schaal 2008, *Natural Actor-Critic*, table 2; Fourier basis: Konidaris,
Osentoski and Thomas 2011, *Value Function Approximation in Reinforcement Learning using the Fourier Basis*; the bound
on the step: Dabney and Barto 2012, *Adaptive Step-Size for Online Temporal Difference Learning*.

Differs from the source:
- all environments update together: Sarsa takes the mean of their updates, one step of theirs after the other, and the
  bound on its step holds for that mean; eNAC's regression is accumulated as normal equations, ridge added;
- the next key's value is its expectation under the softmax where the next key is not in the batch: in its last column
  and where an episode is truncated;
- the Fourier basis couples at most `max_coupled` entries of the observation, each scaled to its range in the warm-up;
- parameters are in units of their bounds, sigma is a standard deviation, returns are not discounted in eNAC, and its
  step is bounded by the divergence from the old policy.
"""

from __future__ import annotations

from typing import Annotated, ClassVar

import torch
from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.nn import functional as F

from hpamdp import keys
from hpamdp.policies.base import Learner, is_greedy
from hpamdp.policies.low_level.qpamdp_features import FourierBasis, SizedByData
from hpamdp.policies.shared.fractions import Fraction, PositiveFraction
from hpamdp.policies.shared.networks import sample_index
from hpamdp.specs import PAMDPSpecs

RAW = "raw_parameters"  # the parameters as they were drawn, in units of their bounds: [-1, 1] before clipping
SARSA, PARAMETERS = 0, 1  # the phases


class QPAMDPPolicy(TensorDictModuleBase, SizedByData):
    """A softmax over linear values of the keys, and Gaussian parameters with linear means."""

    def __init__(
        self, specs: PAMDPSpecs, phi: FourierBasis, psi: FourierBasis, temperature: float, sigma: float, mean: float
    ) -> None:
        super().__init__()
        self.in_keys = [keys.OBSERVATION]
        self.out_keys = [keys.DISCRETE, keys.PARAMETERS, RAW]
        self.specs, self.phi, self.psi, self.temperature = specs, phi, psi, temperature
        self.register_buffer("w", torch.zeros(specs.num_discrete, 1))
        self.register_buffer("theta", torch.full((specs.num_parameters, 1), mean))
        self.register_buffer("sigma", torch.tensor(sigma))

    def widen(self) -> None:
        """Give the weights the bases' sizes; what they say stays the same."""
        self.w = F.pad(self.w, (0, len(self.phi.coefficients) - self.w.shape[1]))
        self.theta = F.pad(self.theta, (0, len(self.psi.coefficients) - self.theta.shape[1]))

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write key `[*B]`, parameters and their raw sample `[*B, num_parameters]`."""
        observation = td.get(keys.OBSERVATION)
        q, raw = self.phi(observation) @ self.w.T, self.psi(observation) @ self.theta.T
        if is_greedy():
            discrete = q.argmax(-1)
        else:
            discrete = sample_index(q / self.temperature)
            raw = raw + self.sigma * torch.randn_like(raw)
        duration = self.specs.from_unit(raw.clamp(-1.0, 1.0))
        return td.update({keys.ACTION: {"discrete": discrete, "parameters": duration}, RAW: raw})


class SarsaLambda(SizedByData):
    """Linear Sarsa(lambda) over environments side by side; their traces go on from one batch to the next."""

    def __init__(self, gamma: float, trace_decay: float, step_size: float, temperature: float) -> None:
        super().__init__()
        self.gamma, self.trace_decay, self.step_size, self.temperature = gamma, trace_decay, step_size, temperature
        self.register_buffer("traces", torch.zeros(0, 1, 1))

    def update(self, w: Tensor, rows: TensorDict) -> tuple[Tensor, Tensor]:
        """Return the new weights `[num_keys, num_features]` and the mean squared error of the temporal differences.

        Rows `[N, T]` have `phi`, `next_phi`, `key`, `reward`, `terminated`, `done` and `mask`: those that count.
        """
        num_envs, num_steps = rows.shape
        if self.traces.shape != (num_envs, *w.shape):
            self.traces = w.new_zeros(num_envs, *w.shape)
        every, errors = torch.arange(num_envs, device=w.device), []
        for t in range(num_steps):
            row = rows[:, t]
            phi, next_phi, discrete = row["phi"], row["next_phi"], row["discrete"]
            weight = row["mask"] / row["mask"].sum().clamp(min=1)
            self.traces *= self.gamma * self.trace_decay
            self.traces[every, discrete] += phi
            next_q = next_phi @ w.T
            following = (next_q / self.temperature).softmax(-1)
            if t + 1 < num_steps:
                pressed = F.one_hot(rows["discrete"][:, t + 1], len(w))
                following = torch.where(row["done"].unsqueeze(-1), following, pressed)
            following = self.gamma * following * ~row["terminated"].unsqueeze(-1)
            error = row["reward"] + (following * next_q).sum(-1) - (phi * w[discrete]).sum(-1)
            # How far a unit step would move the errors themselves, on average: Dabney and Barto's bound.
            along = torch.einsum("nkf,nf->nk", self.traces, next_phi)
            change = (following * along).sum(-1) - (self.traces[every, discrete] * phi).sum(-1)
            step = (1.0 / (change * weight).sum().abs()).clamp(max=self.step_size)
            w = w + step * torch.einsum("n,nkf->kf", error * weight, self.traces)
            self.traces[row["done"]] = 0.0
            errors.append((error.square() * weight).sum())
        return w, torch.stack(errors).mean()


class NaturalActorCritic(SizedByData):
    """The regression of eNAC: whole episodes' returns on the sums of their log-likelihoods' gradients and phi(s_0).

    An episode may span batches. Only those count that began after the last `restart`, under the present parameters.
    """

    def __init__(self, ridge: float) -> None:
        super().__init__()
        self.ridge = ridge
        self.register_buffer("is_fresh", torch.zeros(0, dtype=torch.bool))  # the next row begins an episode
        self.register_buffer("is_whole", torch.zeros(0, dtype=torch.bool))
        self.register_buffer("regressors", torch.zeros(0, 0))  # of the episodes under way
        self.register_buffer("returns", torch.zeros(0))
        self.register_buffer("gram", torch.zeros(0, 0, dtype=torch.float64))
        self.register_buffer("moment", torch.zeros(0, dtype=torch.float64))
        self.register_buffer("num_episodes", torch.zeros((), dtype=torch.long))

    def restart(self, num_regressors: int, is_fresh: Tensor) -> None:
        """Begin a new regression; `is_fresh` `[N]`: where the next row begins an episode."""
        self.is_fresh, self.is_whole = is_fresh.clone(), torch.zeros_like(is_fresh)
        self.regressors = self.regressors.new_zeros(len(is_fresh), num_regressors)
        self.returns = self.returns.new_zeros(len(is_fresh))
        self.gram = self.gram.new_zeros(num_regressors, num_regressors)
        self.moment = self.moment.new_zeros(num_regressors)
        self.num_episodes.zero_()

    def collect(self, rows: TensorDict) -> None:
        """Take rows `[N, T]` with `gradient` `[N, T, P]`, `phi`, `reward`, `done` and `mask`, the rows that count."""
        finished = []
        for t in range(rows.shape[1]):
            row = rows[:, t]
            gradient, start = row["gradient"], F.pad(row["phi"], (row["gradient"].shape[-1], 0))
            self.regressors = torch.where(self.is_fresh.unsqueeze(-1), start, self.regressors)
            self.regressors[:, : gradient.shape[-1]] += gradient
            self.returns = torch.where(self.is_fresh, 0.0, self.returns) + row["reward"]
            self.is_whole = self.is_whole | self.is_fresh
            self.is_fresh = row["done"].clone()
            ended = row["done"] & row["mask"] & self.is_whole
            finished.append((self.regressors[ended], self.returns[ended]))
        x, y = (torch.cat(parts) for parts in zip(*finished, strict=True))
        self.gram += x.T @ x
        self.moment += x.T @ y
        self.num_episodes += len(y)

    def natural_gradient(self, num_weights: int) -> tuple[Tensor, Tensor]:
        """Return the first `num_weights` coefficients and what a unit step along them diverges by (nats an episode)."""
        penalty = self.ridge * self.gram.diagonal().mean() * torch.eye(len(self.gram)).to(self.gram)
        solution = torch.linalg.lstsq(self.gram + penalty, self.moment.unsqueeze(-1)).solution[:num_weights, 0]
        fisher = self.gram[:num_weights, :num_weights] / self.num_episodes
        return solution.float(), (0.5 * solution @ fisher @ solution).float()


class QPAMDP(Learner):
    """Sarsa(lambda) for the keys and eNAC for their parameters, in turns counted in finished episodes."""

    has_value: ClassVar[bool] = True

    def __init__(
        self,
        specs: PAMDPSpecs,
        device: torch.device,
        *,
        features: list[NonNegativeInt] | None,
        phi_order: PositiveInt,
        phi_max_coupled: PositiveInt,
        psi_order: PositiveInt,
        psi_max_coupled: PositiveInt,
        warmup_frames: PositiveInt,
        initial_episodes: PositiveInt,
        relearning_episodes: PositiveInt,
        gamma: PositiveFraction,
        trace_decay: Fraction,
        step_size: PositiveFloat,
        temperature: PositiveFloat,
        parameter_updates: PositiveInt | None,
        patience: PositiveInt,
        rollouts: PositiveInt,
        natural_step_size: PositiveFloat,
        max_divergence: PositiveFloat,
        ridge: NonNegativeFloat,
        initial_mean: Annotated[float, Field(ge=-1.0, le=1.0)],
        sigma: PositiveFloat,
        sigma_final: PositiveFloat,
        sigma_decay: PositiveFraction,
    ) -> None:
        super().__init__(specs)
        if features is not None and not all(i < specs.observation_dim for i in features):
            last = specs.observation_dim - 1
            raise ValueError(f"features={features}: the observation has entries 0 to {last}; null: all")
        self.features, self.warmup_frames, self.initial_episodes = features, warmup_frames, initial_episodes
        self.relearning_episodes, self.rollouts = relearning_episodes, rollouts
        self.parameter_updates, self.patience, self.max_divergence = parameter_updates, patience, max_divergence
        self.natural_step_size, self.sigma_final, self.sigma_decay = natural_step_size, sigma_final, sigma_decay

        phi, psi = FourierBasis(phi_order, phi_max_coupled), FourierBasis(psi_order, psi_max_coupled)
        self.policy = QPAMDPPolicy(specs, phi, psi, temperature, sigma, initial_mean)
        self.sarsa, self.enac = SarsaLambda(gamma, trace_decay, step_size, temperature), NaturalActorCritic(ridge)
        self.register_buffer("mask", specs.parameter_mask.float())
        self.register_buffer("low", torch.full((specs.observation_dim,), torch.inf))
        self.register_buffer("high", torch.full((specs.observation_dim,), -torch.inf))
        self.register_buffer("best_return", torch.tensor(-torch.inf))  # of the phase's windows
        self.register_buffer("window_return", torch.zeros(()))
        for name in ("frames", "phase", "window_episodes", "windows", "windows_since_best", "updates"):
            self.register_buffer(name, torch.zeros((), dtype=torch.long))
        self.to(device)

    def value(self, observation: Tensor) -> Tensor:
        """Return the highest value of a key, `[B]`."""
        return (self.policy.phi(observation) @ self.policy.w.T).amax(-1)

    def learn(self, batch: TensorDictBase, mask: Tensor) -> dict[str, float]:
        """Fit the features' ranges once the warm-up is over; then update the phase's half, and change phase if due."""
        batch, mask = batch.reshape(-1, batch.shape[-1]), mask.reshape(-1, mask.shape[-1])
        if self.frames < self.warmup_frames:
            self._warm_up(batch[keys.OBSERVATION][mask])
            return {}
        rows = self._rows(batch, mask)
        self.window_return += (rows["reward"] * rows["mask"]).sum()
        self.window_episodes += (rows["done"] & rows["mask"]).sum()
        scalars = {"phase": float(self.phase)}
        if self.phase == SARSA:
            self.policy.w, error = self.sarsa.update(self.policy.w, rows)
            scalars["td_error"] = error.item()
            is_first = self.updates == 0 and self.windows == 0
            is_full = self.window_episodes >= (self.initial_episodes if is_first else self.relearning_episodes)
        else:
            self.enac.collect(rows)
            is_full = self.enac.num_episodes >= self.rollouts
        if is_full:
            scalars |= self._end_window(rows["done"][:, -1])
        return {**scalars, "updates": self.updates.item(), "sigma": self.policy.sigma.item()}

    def _warm_up(self, observation: Tensor) -> None:
        self.frames += len(observation)
        self.low = torch.cat([observation, self.low.unsqueeze(0)]).amin(0)
        self.high = torch.cat([observation, self.high.unsqueeze(0)]).amax(0)
        if self.frames < self.warmup_frames:
            return
        varying = (self.high - self.low > 1e-6).nonzero().squeeze(-1)
        inputs = varying if self.features is None else varying.new_tensor(self.features)
        for basis in (self.policy.phi, self.policy.psi):
            basis.fit(inputs, self.low[inputs], self.high[inputs])
        self.policy.widen()

    def _rows(self, batch: TensorDictBase, mask: Tensor) -> TensorDict:
        """Return what the phase's update needs of a batch `[N, T]`."""
        policy, observation = self.policy, batch[keys.OBSERVATION]
        rows = {
            "phi": policy.phi(observation),
            "discrete": batch[keys.DISCRETE],
            "reward": batch["next", keys.REWARD].squeeze(-1),
            "terminated": batch["next", keys.TERMINATED].squeeze(-1),
            "done": batch["next", keys.DONE].squeeze(-1),
            "mask": mask,
        }
        if self.phase == SARSA:
            rows["next_phi"] = policy.phi(batch["next", keys.OBSERVATION])
        else:
            psi = policy.psi(observation)
            score = (batch[RAW] - psi @ policy.theta.T) / policy.sigma.square() * self.mask[rows["discrete"]]
            rows["gradient"] = (score.unsqueeze(-1) * psi.unsqueeze(-2)).flatten(-2)
        return TensorDict(rows, batch_size=mask.shape)

    def _end_window(self, is_fresh: Tensor) -> dict[str, float]:
        """Step theta where it is its turn, and change phase where this one is over."""
        scalars = {"return": (self.window_return / self.window_episodes.clamp(min=1)).item()}
        if self.phase == PARAMETERS:
            scalars |= self._step_parameters()
        self.windows += 1
        self.windows_since_best = (self.windows_since_best + 1) * (self.best_return >= scalars["return"])
        self.best_return.clamp_(min=scalars["return"])
        if self.parameter_updates is None:
            is_over = self.windows_since_best >= self.patience
        else:
            is_over = self.windows >= (1 if self.phase == SARSA else self.parameter_updates)
        if is_over:
            self.phase = 1 - self.phase
            self.best_return.fill_(-torch.inf)
            self.windows.zero_()
            self.windows_since_best.zero_()
            self.sarsa.traces.zero_()
        if self.phase == PARAMETERS:
            self.enac.restart(self.policy.theta.numel() + self.policy.w.shape[1], is_fresh)
        self.window_return.zero_()
        self.window_episodes.zero_()
        return scalars

    def _step_parameters(self) -> dict[str, float]:
        direction, divergence = self.enac.natural_gradient(self.policy.theta.numel())
        # The divergence grows with the step's square.
        step = (self.max_divergence / divergence.clamp(min=1e-12)).sqrt().clamp(max=self.natural_step_size)
        self.policy.theta = self.policy.theta + step * direction.view_as(self.policy.theta)
        self.policy.sigma = (self.policy.sigma * self.sigma_decay).clamp(min=self.sigma_final)
        self.updates += 1
        return {"natural_step": step.item(), "divergence": (divergence * step.square()).item()}
