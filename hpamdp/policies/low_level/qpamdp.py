"""Q-PAMDP: learn which discrete action to take, then, with that fixed, its parameters, and so on in turns.

The values of the discrete actions are linear and learned by Sarsa(lambda). The parameters are learned by the episodic
natural actor-critic (eNAC).

Source: Masson, Ranchod and Konidaris, *Reinforcement Learning with Parameterized Actions*, 2016, arXiv 1509.01644:
algorithm 1 and section 5; eNAC: Peters and Schaal 2008, *Natural Actor-Critic*, table 2; Fourier basis: Konidaris,
Osentoski and Thomas 2011, *Value Function Approximation in Reinforcement Learning using the Fourier Basis*; the bound
on the step: Dabney and Barto 2012, *Adaptive Step-Size for Online Temporal Difference Learning*.

Differs from the source:
- All environments learn together. For each time step and group of environments, Sarsa makes one update: the mean over
  the group. The bound on its step size holds for that mean. eNAC accumulates its regression as normal equations, with a
  ridge penalty.
- The value of the next discrete action is its expectation under the softmax if that action is not in the batch: in the
  batch's last column, and where an episode is truncated.
- If an option ends inside its episode, the step is terminal, and its reward includes the discounted value under the
  option that follows. Sarsa, eNAC and windows then treat the option as the source treats an episode.
- The Fourier basis couples at most `max_coupled` entries of the observation. Each entry is scaled to `feature_range`,
  or to its range in the warm-up.
- By default all weights of the values have the same step size. Dabney and Barto's bound limits it again at each step,
  whatever the sign of the change. The temperature is constant, also in the parameter phases, and sigma decays.
  The settings of Bester et al.'s code on Platform: step_scaling=true, step_bound=non_increasing, temperature=1,
  temperature_decay=0.995, samples_in_parameter_phase=false, sigma_decay=1. The settings below call these published.
  In that code each phase of Sarsa restarts at the initial temperature, and the discount is 0.999 for each tick. On Goal
  it has no bound, a constant temperature, alpha 0.01, lambda 0.1, a discount of 0.9 and gradients of unit norm.
- The mean parameters are linear in a Fourier basis, and eNAC's baseline in that of the values. In that code the means
  are linear in entries of the observation. The baseline is a constant, on Goal three features.
- Phases are shorter. That code has 10,000 initial and 1,000 relearning episodes on Platform, and 180 updates of 50
  rollouts.
- Parameters are in units where their bounds are [-1, 1], and sigma is a standard deviation. eNAC's returns are not
  discounted, and the divergence from the old policy bounds its step.
"""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.nn import functional as F

from hpamdp import keys
from hpamdp.acting import is_greedy
from hpamdp.devices import Device, checked_device
from hpamdp.policies.base import Learner, States, known_ends
from hpamdp.policies.low_level.qpamdp_features import FourierBasis, num_fourier_features
from hpamdp.policies.low_level.qpamdp_options import CARDS, QPAMDPOptions
from hpamdp.policies.masks import masked_logits, masked_values, sample_index
from hpamdp.policies.shared.hybrid_actor import RAW
from hpamdp.policies.shared.networks import InitialLayer
from hpamdp.policies.shared.sized_by_data import SizedByData
from hpamdp.settings import SettingError
from hpamdp.specs import PAMDPSpecs

# Coefficients in eNAC's regression, whose normal equations are a square of them: 2 GB.
MAX_REGRESSORS = 16_384

# The phases: what is being learned.
SARSA = 0
PARAMETERS = 1


class QPAMDPPolicy(TensorDictModuleBase, SizedByData):
    """A softmax over linear values of the discrete actions, and Gaussian parameters with linear means.

    Attributes:
        phi: features of the values.
        psi: features of the means.
        w: weights of the values, `[num_discrete, num_features]`.
        theta: weights of the means, `[num_parameters, num_features]`.
        sigma: standard deviation of the parameters.
        temperature: of the softmax.
        samples_discrete: whether exploring actions are sampled from the softmax, or those of highest value.
    """

    def __init__(self, specs: PAMDPSpecs, options: QPAMDPOptions) -> None:
        super().__init__()
        self.in_keys = [keys.OBSERVATION]
        self.out_keys = [keys.DISCRETE, keys.PARAMETERS, RAW]
        self.specs = specs
        self.phi = FourierBasis(options.phi_order, options.phi_max_coupled)
        self.psi = FourierBasis(options.psi_order, options.psi_max_coupled)
        self.initial = InitialLayer(specs, options.initial_parameters, is_squashed=False)
        mean = 0.0 if self.initial.exists else options.initial_mean
        self.temperature: Tensor = nn.Buffer(torch.tensor(options.temperature, dtype=torch.float32))
        self.samples_discrete = nn.Buffer(torch.tensor(True))
        self.w: Tensor = nn.Buffer(torch.zeros(specs.num_discrete, 1, dtype=torch.float32))
        self.theta: Tensor = nn.Buffer(torch.full((specs.num_parameters, 1), mean, dtype=torch.float32))
        self.sigma: Tensor = nn.Buffer(torch.tensor(options.sigma, dtype=torch.float32))

    def widen(self) -> None:
        """Append zeros to the weights to match the fitted bases; the policy stays the same."""
        self.w = F.pad(self.w, (0, len(self.phi.coefficients) - self.w.shape[1]))
        self.theta = F.pad(self.theta, (0, len(self.psi.coefficients) - self.theta.shape[1]))

    def mean(self, observation: Tensor) -> Tensor:
        """Return the means `[*B, num_parameters]` for observations `[*B, observation_dim]`."""
        return self.psi(observation) @ self.theta.T + self.initial(observation)

    def q(self, observation: Tensor) -> Tensor:
        """Return the values of the discrete actions `[*B, num_discrete]`."""
        return self.phi(observation) @ self.w.T

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write the discrete action `[*B]`, the parameters and their raw sample, each `[*B, num_parameters]`."""
        observation = td.get(keys.OBSERVATION)
        allowed = self.specs.allowed(observation, td.get(keys.ACTION_MASK, None))
        q = masked_values(self.q(observation), allowed)
        raw = self.mean(observation)
        is_exploring = not is_greedy()
        discrete = sample_index(q / self.temperature) if is_exploring and self.samples_discrete else q.argmax(-1)
        if is_exploring:
            raw = raw + self.sigma * torch.randn_like(raw)
        parameters = self.specs.from_unit(raw.clamp(-1.0, 1.0), td)
        return td.update({keys.ACTION: {"discrete": discrete, "parameters": parameters}, RAW: raw})


class SarsaLambda(SizedByData):
    """Linear Sarsa(lambda) over parallel environments; the traces carry over from one batch to the next."""

    def __init__(self, options: QPAMDPOptions) -> None:
        super().__init__()
        self.options = options
        self.step_size: Tensor = nn.Buffer(torch.tensor(options.step_size, dtype=torch.float32))
        self.traces: Tensor = nn.Buffer(torch.zeros(0, 1, 1, dtype=torch.float32))

    def update(self, w: Tensor, rows: TensorDict, temperature: Tensor, step_scale: Tensor) -> tuple[Tensor, Tensor]:
        """Make the updates of a batch: one for each time step and group of `envs_per_update` environments.

        Args:
            w: weights `[num_discrete, num_features]`.
            rows: `[N, T]` with `phi` and `next_phi` `[N, T, num_features]`, and `discrete`, `reward`, `terminated`,
                `done` and `mask` `[N, T]`; only the rows in `mask` count. `next_allowed` `[N, T, num_discrete]`: the
                discrete actions that may be taken in the next states, if not all. `is_first` `[N, T]`: whether a
                row begins an episode or an option; the one before it may have been abandoned.
            temperature: of the softmax policy, `[]`.
            step_scale: factors on the steps of the features' weights, `[num_features]`.

        Returns:
            The new weights and the mean squared temporal-difference error.
        """
        num_envs, num_steps = rows.shape
        if self.traces.shape != (num_envs, *w.shape):
            self.traces = w.new_zeros(num_envs, *w.shape)
        self.traces[rows["is_first"][:, 0]] = 0.0
        # The action at the next time step; -1 in the last column, where it is not known.
        next_discrete = F.pad(rows["discrete"][:, 1:], (0, 1), value=-1)
        size = num_envs if self.options.envs_per_update is None else self.options.envs_per_update
        groups = [{name: rows[name][i : i + size] for name in rows.keys()} for i in range(0, num_envs, size)]
        errors: list[Tensor] = []
        for t in range(num_steps):
            for group, taken, traces in zip(groups, next_discrete.split(size), self.traces.split(size), strict=True):
                row = {name: values[:, t] for name, values in group.items()}
                w, error = self.step(w, row, taken[:, t], traces, temperature, step_scale)
                errors.append(error * row["mask"].sum())
        return w, torch.stack(errors).sum() / rows["mask"].sum().clamp(min=1)

    def step(
        self,
        w: Tensor,
        row: dict[str, Tensor],
        next_discrete: Tensor,
        traces: Tensor,
        temperature: Tensor,
        step_scale: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Return the weights after one update, and the mean squared error before it; change the traces in place.

        Args:
            w, temperature, step_scale: as in `update`.
            row: of a group of environments, each `[n, ...]`.
            next_discrete: what they choose next, `[n]`; -1 where it is not known.
            traces: of the group, `[n, num_discrete, num_features]`.
        """
        phi, next_phi, discrete = row["phi"], row["next_phi"], row["discrete"]
        envs = torch.arange(len(traces), device=w.device)
        weight = row["mask"].float() / row["mask"].sum().clamp(min=1)
        traces *= self.options.gamma * self.options.trace_decay
        traces[envs, discrete] += phi

        next_q = next_phi @ w.T
        is_known = (next_discrete >= 0) & ~row["done"]
        taken = F.one_hot(next_discrete.clamp(min=0), len(w))
        next_logits = masked_logits(next_q / temperature, row.get("next_allowed"))
        next_probs = torch.where(is_known.unsqueeze(-1), taken, next_logits.softmax(-1))
        next_weight = self.options.gamma * next_probs * ~row["terminated"].unsqueeze(-1)
        error = row["reward"] + (next_weight * next_q).sum(-1) - (phi * w[discrete]).sum(-1)

        # Dabney and Barto's bound, from the mean change of the errors that a step of size 1 would cause.
        next_change = torch.einsum("nkf,nf->nk", traces, next_phi * step_scale)
        changes = (next_weight * next_change).sum(-1) - (traces[envs, discrete] * step_scale * phi).sum(-1)
        change = (changes * weight).sum()
        step_size = self.step_size.minimum(1.0 / change.abs())
        if self.options.step_bound == "non_increasing":
            step_size = self.step_size = torch.where(change < 0.0, step_size, self.step_size)
        w = w + step_size * step_scale * torch.einsum("n,nkf->kf", error * weight, traces)
        traces[row["done"]] = 0.0
        return w, (error.square() * weight).sum()


class NaturalActorCritic(SizedByData):
    """The regression of eNAC: episode returns on the summed gradients of the log-likelihood and on phi(s_0).

    Episodes may span batches. Only those that began after the last `restart` count, since earlier rows were sampled by
    an older policy.

    Args:
        ridge: weight of the ridge penalty, in units of the regressors' mean square.
    """

    def __init__(self, ridge: float) -> None:
        super().__init__()
        self.ridge = ridge
        self.is_fresh: Tensor = nn.Buffer(torch.zeros(0, dtype=torch.bool))  # where the next row begins an episode
        # Where the current episode began after the last restart; its regressors and its return.
        self.is_whole: Tensor = nn.Buffer(torch.zeros(0, dtype=torch.bool))
        self.regressors: Tensor = nn.Buffer(torch.zeros(0, 0, dtype=torch.float32))
        self.returns: Tensor = nn.Buffer(torch.zeros(0, dtype=torch.float32))
        self.gram: Tensor = nn.Buffer(torch.zeros(0, 0, dtype=torch.float64))
        self.moment: Tensor = nn.Buffer(torch.zeros(0, dtype=torch.float64))
        self.num_episodes: Tensor = nn.Buffer(torch.zeros((), dtype=torch.long))

    def restart(self, num_regressors: int, is_fresh: Tensor) -> None:
        """Discard the collected episodes.

        Args:
            num_regressors: number of coefficients of the new regression.
            is_fresh: where the next row begins an episode, bool `[N]`.
        """
        self.gram = self.gram.new_zeros(num_regressors, num_regressors)
        self.moment = self.moment.new_zeros(num_regressors)
        self.num_episodes.zero_()
        self._forget_open_episodes(len(is_fresh))
        self.is_fresh = is_fresh.clone()

    def _forget_open_episodes(self, num_envs: int) -> None:
        """Discard the episodes that have not ended. The next rows may begin in the middle of other episodes."""
        self.is_fresh = self.is_fresh.new_zeros(num_envs)
        self.is_whole = self.is_whole.new_zeros(num_envs)
        self.regressors = self.regressors.new_zeros(num_envs, len(self.moment))
        self.returns = self.returns.new_zeros(num_envs)

    def collect(self, rows: TensorDict, ended_before: Tensor | None = None, value_before: float | Tensor = 0.0) -> None:
        """Add the episodes that end in a batch, or ended with the one before, to the regression.

        Args:
            rows: `[N, T]` with `gradient` `[N, T, num_weights]`, `phi` `[N, T, num_features]`, and `reward`, `done` and
                `mask` `[N, T]`; only the episodes whose last row is in `mask` count. `is_first` as for `SarsaLambda`.
            ended_before: where an episode ended with the batch before, as this one shows, bool `[N]`. If None, nowhere.
            value_before: what to add to their returns, `[N]`.
        """
        if len(self.is_whole) != len(rows):  # a run that goes on with another number of environments
            self._forget_open_episodes(len(rows))
        ended = torch.zeros_like(self.is_whole) if ended_before is None else ended_before & self.is_whole
        ended_regressors = [self.regressors[ended]]
        ended_returns = [(self.returns + value_before)[ended]]
        self.is_fresh = self.is_fresh | rows["is_first"][:, 0]
        for t in range(rows.shape[1]):
            row = rows[:, t]
            gradient = row["gradient"]
            num_weights = gradient.shape[-1]
            start = F.pad(row["phi"], (num_weights, 0))
            self.regressors = torch.where(self.is_fresh.unsqueeze(-1), start, self.regressors)
            self.regressors[:, :num_weights] += gradient
            self.returns = torch.where(self.is_fresh, 0.0, self.returns) + row["reward"]
            self.is_whole = self.is_whole | self.is_fresh
            self.is_fresh = row["done"].clone()
            ended = row["done"] & row["mask"] & self.is_whole
            ended_regressors.append(self.regressors[ended])
            ended_returns.append(self.returns[ended])
        x = torch.cat(ended_regressors)
        y = torch.cat(ended_returns)
        self.gram += x.T @ x
        self.moment += x.T @ y
        self.num_episodes += len(y)

    def natural_gradient(self, num_weights: int) -> tuple[Tensor, Tensor]:
        """Solve the regression.

        Returns:
            The first `num_weights` coefficients, which are the natural gradient. Then the divergence that a step of
            size 1 along it causes, in nats an episode, `[]`.
        """
        identity = torch.eye(len(self.gram), dtype=torch.float32).to(self.gram)
        penalty = self.ridge * self.gram.diagonal().mean() * identity
        # With gelsy, the default on the CPU, the last digits differ from run to run, and a resumed run from its own.
        driver = "gelsd" if self.gram.device.type == "cpu" else None
        regression = torch.linalg.lstsq(self.gram + penalty, self.moment.unsqueeze(-1), driver=driver)
        solution = regression.solution[:num_weights, 0]
        fisher = self.gram[:num_weights, :num_weights] / self.num_episodes
        return solution.float(), (0.5 * solution @ fisher @ solution).float()


class PendingOptionEnds(SizedByData):
    """Remembers options that may have ended with a batch's last step, and the discounted values of their next states.

    If the selector decides where options end, the next batch shows whether one ended.
    """

    def __init__(self) -> None:
        super().__init__()
        self.is_open: Tensor = nn.Buffer(torch.zeros(0, dtype=torch.bool))  # `[N]`
        self.value: Tensor = nn.Buffer(torch.zeros(0, dtype=torch.float32))  # discounted, `[N]`

    def close(self, rows: TensorDict) -> tuple[Tensor, Tensor]:
        """Return where an option ended with the batch before, bool `[N]`, and the values of what followed, `[N]`.

        Then keep what these rows `[N, T]` leave open, by `is_open` and `open_value`. An episode that was given up
        between the batches did not end.
        """
        num = len(rows)
        is_open, value = self.is_open, self.value
        if len(is_open) != num:
            is_open, value = (each.new_zeros(num) for each in (is_open, value))
        self.is_open, self.value = (rows[name][:, -1].clone() for name in ("is_open", "open_value"))
        return is_open & rows["begins_option"][:, 0], value


class QPAMDP(Learner):
    """Sarsa(lambda) for the discrete actions and eNAC for their parameters, in turns.

    A phase consists of windows of finished episodes: Sarsa updates in every batch, eNAC once at the end of a window.
    """

    Options = QPAMDPOptions
    card = CARDS["QPAMDP"]
    # A run from `low.checkpoint` goes on in the saved phase: a second warm-up would fit other bases under the weights.
    progress: ClassVar[frozenset[str]] = frozenset()

    policy: QPAMDPPolicy

    def __init__(self, specs: PAMDPSpecs, *, device: Device = "cpu", options: Any = None, **settings: Any) -> None:
        super().__init__(specs)
        self.options: QPAMDPOptions = QPAMDPOptions.of(options, settings)
        check_features(self.options, specs)
        self.policy = QPAMDPPolicy(specs, self.options)
        self.sarsa = SarsaLambda(self.options)
        self.enac = NaturalActorCritic(self.options.ridge)
        self.open = PendingOptionEnds()
        self.mask = nn.Buffer(specs.parameter_mask.float())  # the own parameters of each discrete action
        self.low: Tensor = nn.Buffer(torch.full((specs.observation_dim,), torch.inf, dtype=torch.float32))
        self.high: Tensor = nn.Buffer(torch.full((specs.observation_dim,), -torch.inf, dtype=torch.float32))
        self.best_return = nn.Buffer(torch.tensor(-torch.inf, dtype=torch.float32))  # of the current phase's windows
        self.window_return: Tensor = nn.Buffer(torch.zeros((), dtype=torch.float32))  # sum over the current window
        self.frames: Tensor = nn.Buffer(torch.zeros((), dtype=torch.long))
        self.phase = nn.Buffer(torch.zeros((), dtype=torch.long))
        self.window_episodes: Tensor = nn.Buffer(torch.zeros((), dtype=torch.long))
        self.windows: Tensor = nn.Buffer(torch.zeros((), dtype=torch.long))  # finished in the current phase
        self.windows_since_best: Tensor = nn.Buffer(torch.zeros((), dtype=torch.long))
        self.updates: Tensor = nn.Buffer(torch.zeros((), dtype=torch.long))  # of the parameters
        self.to(checked_device(self, device))

    def has_updated(self) -> bool:
        """Return whether Sarsa has made an update, which leaves traces."""
        return self.sarsa.traces.numel() > 0

    def learn(self, batch: TensorDictBase, mask: Tensor) -> dict[str, float]:
        """Collect the ranges of the features during the warm-up; then learn what the phase learns, and end it if due.

        Updates within a phase use the rows in `mask`. Windows count their episodes, or options if these end before.
        """
        batch = batch.reshape(-1, batch.shape[-1])
        mask = mask.reshape(-1, mask.shape[-1])
        if self.frames < self.options.warmup_steps:
            self.warm_up(batch[keys.OBSERVATION][mask])
            return {}
        rows = self.rows(batch, mask)
        ended_before, value_before = self.open.close(rows)
        num_episodes = (rows["done"] & rows["mask"]).sum() + ended_before.sum()
        self.window_return += (rows["reward"] * rows["mask"]).sum() + value_before[ended_before].sum()
        self.window_episodes += num_episodes
        scalars = {"phase": float(self.phase)}
        if self.phase == SARSA:
            # Whether or not the option goes on, its next state has this value.
            rows["reward"] = rows["reward"] + rows["open_value"]
            rows["terminated"] = rows["terminated"] | rows["is_open"]
            scalars["td_error"] = self._update_values(rows, num_episodes)
            is_first_phase = self.updates == 0 and self.windows == 0
            wanted = self.options.initial_episodes if is_first_phase else self.options.relearning_episodes
            is_full = self.window_episodes >= wanted
        else:
            self.enac.collect(rows, ended_before, value_before)
            is_full = self.enac.num_episodes >= self.options.rollouts
        if is_full:
            scalars["return"] = (self.window_return / self.window_episodes.clamp(min=1)).item()
            if self.phase == PARAMETERS:
                scalars |= self._update_parameters()
            self._end_window(scalars["return"], is_fresh=rows["done"][:, -1])
        return {**scalars, "updates": self.updates.item(), "sigma": self.policy.sigma.item()}

    def _update_values(self, rows: TensorDict, num_episodes: Tensor) -> float:
        """Make Sarsa's updates of a batch and lower the temperature; return the mean squared error."""
        policy, options = self.policy, self.options
        coefficients = policy.phi.coefficients
        step_scale = policy.phi.step_scale() if options.step_scaling else coefficients.new_ones(len(coefficients))
        policy.w, error = self.sarsa.update(policy.w, rows, policy.temperature, step_scale)
        cooled = policy.temperature * options.temperature_decay ** num_episodes.float()
        policy.temperature = cooled.clamp(min=min(options.temperature, options.temperature_final))
        return error.item()

    def _update_parameters(self) -> dict[str, float]:
        """Step the mean parameters along the natural gradient and lower sigma; return scalars."""
        policy, options = self.policy, self.options
        direction, divergence = self.enac.natural_gradient(policy.theta.numel())
        # The divergence grows with the square of the step.
        step = (options.max_divergence / divergence.clamp(min=1e-12)).sqrt().clamp(max=options.natural_step_size)
        policy.theta = policy.theta + step * direction.view_as(policy.theta)
        policy.sigma = (policy.sigma * options.sigma_decay).clamp(min=options.sigma_final)
        self.updates += 1
        return {"natural_step": step.item(), "divergence": (divergence * step.square()).item()}

    def _end_window(self, window_return: float, is_fresh: Tensor) -> None:
        """Begin the next window, and the other phase if this one is over.

        Args:
            window_return: mean return of the window's episodes.
            is_fresh: where the next row begins an episode, bool `[N]`.
        """
        self.windows += 1
        if window_return > self.best_return:
            self.best_return.fill_(window_return)
            self.windows_since_best.zero_()
        else:
            self.windows_since_best += 1
        if self.options.parameter_updates is None:
            is_over = self.windows_since_best >= self.options.patience
        else:
            is_over = self.windows >= (1 if self.phase == SARSA else self.options.parameter_updates)
        if is_over:
            self.phase.fill_(PARAMETERS if self.phase == SARSA else SARSA)
            self.policy.samples_discrete.fill_(bool(self.phase == SARSA) or self.options.samples_in_parameter_phase)
            self.best_return.fill_(-torch.inf)
            self.windows.zero_()
            self.windows_since_best.zero_()
            self.sarsa.traces.zero_()
        if self.phase == PARAMETERS:
            self.enac.restart(self.policy.theta.numel() + self.policy.w.shape[1], is_fresh)
        self.window_return.zero_()
        self.window_episodes.zero_()

    def warm_up(self, observation: Tensor) -> None:
        """Extend the ranges by observations `[N, observation_dim]`; fit the bases once there are enough."""
        self.frames += len(observation)
        self.low = torch.cat([observation, self.low.unsqueeze(0)]).amin(0)
        self.high = torch.cat([observation, self.high.unsqueeze(0)]).amax(0)
        if self.frames < self.options.warmup_steps:
            return
        varying = (self.high - self.low > 1e-6).nonzero().squeeze(-1)
        inputs = varying if self.options.features is None else varying.new_tensor(self.options.features)
        for basis in (self.policy.phi, self.policy.psi):
            low, high = self.low[inputs], self.high[inputs]
            if self.options.feature_range is not None:
                low, high = (torch.full_like(low, side) for side in self.options.feature_range)
            basis.fit(inputs, low, high)
        self.policy.widen()

    @torch.no_grad()
    def value(self, states: States, *, is_target: bool = False) -> Tensor:
        """Return the expected value of the softmax policy's discrete action, `[N]`."""
        q = self.policy.q(states.observation)
        allowed = self.specs.allowed(states.observation, states.action_mask)
        logits = masked_logits(q / self.policy.temperature, allowed)
        return (logits.softmax(-1) * q).sum(-1)

    def rows(self, batch: TensorDictBase, mask: Tensor) -> TensorDict:
        """Return what the phase's update needs of a batch `[N, T]`.

        A step with which an option ends inside its episode is `terminated` and `done`, and its reward includes the
        discounted value of what follows. If only the next batch shows whether it ends (`is_open`), that value is apart
        (`open_value`).
        """
        observation = batch[keys.OBSERVATION]
        reward = batch["next", keys.REWARD].squeeze(-1)
        terminated = batch["next", keys.TERMINATED].squeeze(-1)
        option_ended = batch.get(("next", keys.OPTION_ENDED), None)
        is_open, open_value = torch.zeros_like(mask), torch.zeros_like(reward)
        if option_ended is not None:
            is_followed = (option_ended & ~batch["next", keys.DONE]).squeeze(-1) & mask
            allowed = batch["next", keys.ACTION_MASK] if self.specs.has_action_mask else None
            following = States(batch["next", keys.OBSERVATION], allowed).at(is_followed)
            value = self.next_options.value(following, batch[keys.NEXT_OPTION][is_followed])
            followed = torch.zeros_like(reward).index_put((is_followed,), self.options.gamma * value)
            is_over = is_followed & known_ends(batch).squeeze(-1)
            is_open = is_followed & ~is_over
            open_value = followed * is_open
            reward = reward + followed * is_over
            terminated = terminated | is_over
        rows = {
            "phi": self.policy.phi(observation),
            "discrete": batch[keys.DISCRETE],
            "reward": reward,
            "terminated": terminated,
            "done": known_ends(batch).squeeze(-1),
            "mask": mask,
            "is_open": is_open,
            "open_value": open_value,
        }
        begins, begins_episode = torch.zeros_like(mask), torch.zeros_like(mask)
        if keys.IS_DECISION in batch.keys():
            begins = batch[keys.IS_DECISION].squeeze(-1)
        if keys.EPISODE_STEPS in batch.keys():
            begins_episode = (batch[keys.EPISODE_STEPS] == 0).squeeze(-1)
        rows["is_first"], rows["begins_option"] = begins | begins_episode, begins & ~begins_episode
        if self.phase == SARSA:
            next_observation = batch["next", keys.OBSERVATION]
            rows["next_phi"] = self.policy.phi(next_observation)
            allowed = self.specs.allowed(next_observation, batch.get(("next", keys.ACTION_MASK), None))
            if allowed is not None:
                rows["next_allowed"] = allowed
        else:
            psi = self.policy.psi(observation)
            error = batch[RAW] - self.policy.mean(observation)
            score = error / self.policy.sigma.square() * self.mask[rows["discrete"]]
            if self.is_overruled:  # the action did not come from the mean
                score = score * ~batch[keys.IS_HELD].unsqueeze(-1)
            rows["gradient"] = (score.unsqueeze(-1) * psi.unsqueeze(-2)).flatten(-2)
        return TensorDict(rows, batch_size=mask.shape)


def check_features(options: QPAMDPOptions, specs: PAMDPSpecs) -> None:
    """Refuse features of entries that the observation does not have, and more features than memory holds.

    Raises:
        ValueError: a setting does not suit the problem.
    """
    features, last = options.features, specs.observation_dim - 1
    if features is not None and (not features or max(features) > last):
        raise SettingError(f"features={list(features)}: name some of the observation's entries 0 to {last}; null: all")
    num_inputs = specs.observation_dim if features is None else len(features)
    num_regressors = specs.num_parameters * num_fourier_features(num_inputs, options.psi_order, options.psi_max_coupled)
    num_regressors += num_fourier_features(num_inputs, options.phi_order, options.phi_max_coupled)
    if num_regressors > MAX_REGRESSORS:
        raise SettingError(
            f"phi_order={options.phi_order}, psi_order={options.psi_order}: the regression for the parameters would "
            f"have {num_regressors:,} coefficients, more than {MAX_REGRESSORS:,}; use fewer features or lower orders"
        )
