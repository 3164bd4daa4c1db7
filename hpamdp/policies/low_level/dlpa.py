"""DLPA: plan over keys and parameters in a learned model of the problem.

A transition, two reward and a termination predictor are trained on windows of real steps; every press is the first of
the best sequence that sampling finds in them.

Source: Zhang, Fu, Miao and Konidaris, *Model-based Reinforcement Learning for Parameterized Action Spaces*, 2024, arXiv
2404.03037, section 4: the three forms of the model, the H-step loss, the two reward predictors and the planner, which
extends model predictive path integral control (Williams et al. 2015, arXiv 1509.01149) to keys with parameters.

Differs from the source:
- the change of the state is predicted, in units of its own deviation over the warm-up data, and learned only from steps
  that do not terminate: a plan never goes on from one that does;
- rewards are not squashed, and both reward predictors are used: a plan's return weighs them by the predicted
  probability of termination, and what comes after by that of having gone on;
- reward and termination have an ensemble of networks; a plan's return is its mean less `pessimism` deviations;
- every press is planned from scratch, not from the last plan, which would have to travel with the environment's data;
  in the boat task's true model a warm start adds .002 to .005 of the ceiling at 5 rounds, .006 to .01 at 3;
- presses that explore are drawn from the final distribution, some uniformly.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, NamedTuple

import torch
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.nn import functional as F
from torchrl.data import LazyTensorStorage, ReplayBuffer

from hpamdp import keys
from hpamdp.policies.base import Learner, is_greedy
from hpamdp.policies.low_level.dlpa_model import PAMDPModel
from hpamdp.policies.shared.fractions import PositiveFraction
from hpamdp.specs import PAMDPSpecs

Share = Annotated[float, Field(ge=0.0, lt=1.0)]
Form = Literal["parallel", "masking", "sequential"]

_CHUNK_ROWS = 4096  # states predicted together when planning: fits the cache and bounds the memory


class Plan(NamedTuple):
    """A distribution over sequences of presses: a categorical over keys and a Gaussian per parameter and step."""

    probability: Tensor  # [N, H, num_keys]
    mean: Tensor  # [N, H, num_parameters] in [-1, 1]
    deviation: Tensor  # [N, H, num_parameters]


class Planner:
    """Find good sequences of presses in a model by sampling, weighing the best and sampling anew.

    Args:
        model: what maps (state, key, unit) to a Prediction.
        specs: of the problem.
        horizon: presses in a sequence; num_samples: sequences in each of num_iterations rounds, of which the
            num_elites best make the next distribution.
        temperature: of the elites' weights exp(return / temperature).
        momentum: the old distribution's share in the new one.
        min_deviation: the smallest deviation of a parameter, in [-1, 1] units.
        gamma: discount of a press.
        pessimism: deviations between the model's members that are taken off their mean return.
        precision: in which the model's networks predict when planning.
    """

    def __init__(
        self,
        model: Any,
        specs: PAMDPSpecs,
        *,
        horizon: int,
        num_samples: int,
        num_elites: int,
        num_iterations: int,
        temperature: float,
        momentum: float,
        min_deviation: float,
        gamma: float,
        pessimism: float,
        precision: str = "float32",
    ) -> None:
        if num_elites > num_samples:
            raise ValueError(f"num_elites={num_elites}, but must be at most num_samples={num_samples}")
        self.model, self.specs, self.horizon, self.num_samples = model, specs, horizon, num_samples
        self.num_elites, self.num_iterations, self.temperature = num_elites, num_iterations, temperature
        self.momentum, self.min_deviation, self.gamma, self.pessimism = momentum, min_deviation, gamma, pessimism
        self.precision = getattr(torch, precision)

    @torch.no_grad()
    def plan(self, state: Tensor) -> Plan:
        """Return the final distributions for states `[N, observation_dim]`."""
        plans = [self._plan(rows) for rows in state.split(max(1, _CHUNK_ROWS // self.num_samples))]
        return Plan(*(torch.cat(parts) for parts in zip(*plans, strict=True)))

    def _plan(self, state: Tensor) -> Plan:
        shape = state.shape[0], self.horizon
        probability = state.new_full((*shape, self.specs.num_discrete), 1.0 / self.specs.num_discrete)
        mean = state.new_zeros(*shape, self.specs.num_parameters)
        plan = Plan(probability, mean, torch.ones_like(mean))
        for _ in range(self.num_iterations):
            discrete, unit = self.sample(plan)
            plan = self.re_estimate(plan, discrete, unit, self.returns(state, discrete, unit))
        return plan

    def sample(self, plan: Plan) -> tuple[Tensor, Tensor]:
        """Draw keys `[N, S, H]` and parameters `[N, S, H, num_parameters]` in [-1, 1]."""
        discrete = plan.probability.flatten(0, 1).multinomial(self.num_samples, replacement=True)
        discrete = discrete.unflatten(0, plan.probability.shape[:2]).transpose(1, 2)
        noise = torch.randn(*discrete.shape, self.specs.num_parameters, device=discrete.device)
        return discrete, (plan.mean.unsqueeze(1) + plan.deviation.unsqueeze(1) * noise).clamp(-1.0, 1.0)

    def returns(self, state: Tensor, discrete: Tensor, unit: Tensor) -> Tensor:
        """Return what the model expects of sequences, `[N, S]`, from states `[N, observation_dim]`."""
        rows = state.repeat_interleave(discrete.shape[1], 0)
        total, survival = 0.0, 1.0
        for h in range(discrete.shape[2]):
            with torch.autocast(rows.device.type, self.precision, enabled=self.precision != torch.float32):
                predicted = self.model(rows, discrete[:, :, h].flatten(), unit[:, :, h].flatten(0, 1))
            ends = predicted.logit.float().sigmoid()
            reward = ends * predicted.terminating + (1.0 - ends) * predicted.continuing
            total = total + self.gamma**h * survival * reward.float()
            survival = survival * (1.0 - ends)
            rows = predicted.next_state
        doubt = self.pessimism * total.std(0, correction=0) if self.pessimism else 0.0
        return (total.mean(0) - doubt).unflatten(0, discrete.shape[:2])

    def re_estimate(self, plan: Plan, discrete: Tensor, unit: Tensor, returns: Tensor) -> Plan:
        """Return the distribution of the elites, each key's parameters from the elites that press it alone.

        The parameters of a key that no elite presses stay as they were.
        """
        value, elite = returns.topk(self.num_elites, 1)
        discrete, unit = discrete.take_along_dim(elite[..., None], 1), unit.take_along_dim(elite[..., None, None], 1)
        pressed = (value / self.temperature).softmax(1)[..., None, None] * F.one_hot(discrete, self.specs.num_discrete)
        weight = pressed @ self.specs.parameter_mask.to(pressed)
        total = weight.sum(1)
        weight = weight / total.clamp(min=1e-8).unsqueeze(1)
        mean = (weight * unit).sum(1)
        deviation = (weight * (unit - mean.unsqueeze(1)).square()).sum(1).sqrt().clamp(min=self.min_deviation)
        share = 1.0 - self.momentum
        return Plan(
            plan.probability.lerp(pressed.sum(1), share),
            plan.mean.lerp(torch.where(total > 1e-8, mean, plan.mean), share),
            plan.deviation.lerp(torch.where(total > 1e-8, deviation, plan.deviation), share),
        )


class DLPAPolicy(TensorDictModuleBase):
    """The first press of the plan: its likeliest key and mean parameters, or a draw where it explores.

    Random until the model was trained. Episodes that are over get a press that is none.
    """

    def __init__(self, planner: Planner, specs: PAMDPSpecs, epsilon: float) -> None:
        super().__init__()
        self.in_keys = [keys.OBSERVATION, keys.DONE]
        self.out_keys = [keys.DISCRETE, keys.PARAMETERS]
        self.model = planner.model  # whoever copies the policy's weights needs the model's
        self.planner, self.specs, self.epsilon = planner, specs, epsilon
        self.register_buffer("is_trained", torch.zeros((), dtype=torch.bool))

    @torch.no_grad()
    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write key `[*B]` and parameters `[*B, num_parameters]`."""
        state = td.get(keys.OBSERVATION).flatten(0, -2)
        discrete = torch.randint(self.specs.num_discrete, state.shape[:1], device=state.device)
        unit = 2.0 * torch.rand(state.shape[0], self.specs.num_parameters, device=state.device) - 1.0
        is_planned = self.is_trained.expand(state.shape[0])
        over = td.get(keys.DONE, None)
        if over is not None:
            is_planned = is_planned & ~over.flatten()
        exploring = not is_greedy()
        if exploring:
            is_planned = is_planned & (torch.rand(state.shape[0], device=state.device) >= self.epsilon)
        if is_planned.any():
            discrete[is_planned], unit[is_planned] = self.press(state[is_planned], exploring)
        shape = td.batch_size
        duration = self.specs.from_unit(unit).reshape(*shape, self.specs.num_parameters)
        return td.update({keys.ACTION: {"discrete": discrete.reshape(shape), "parameters": duration}})

    def press(self, state: Tensor, exploring: bool) -> tuple[Tensor, Tensor]:
        """Return the key `[N]` and the parameters `[N, num_parameters]` in [-1, 1] of the plan's first press."""
        probability, mean, deviation = (part[:, 0] for part in self.planner.plan(state))
        if not exploring:
            return probability.argmax(-1), mean
        unit = mean + deviation * torch.randn_like(mean)
        return probability.multinomial(1).squeeze(-1), unit.clamp(-1.0, 1.0)


class DLPA(Learner):
    """A PAMDPModel trained on windows of its own replay, and a Planner that acts in it."""

    def __init__(
        self,
        specs: PAMDPSpecs,
        device: torch.device,
        *,
        form: Form,
        hidden_dims: list[PositiveInt],
        num_members: PositiveInt,
        lr: PositiveFloat,
        state_weight: PositiveFloat,
        reward_weight: PositiveFloat,
        termination_weight: PositiveFloat,
        rho: PositiveFraction,
        buffer_size: PositiveInt,
        batch_size: PositiveInt,
        updates_per_frame: PositiveFloat,
        warmup_frames: PositiveInt,
        epsilon: Share,
        gamma: PositiveFraction,
        horizon: PositiveInt,
        num_samples: PositiveInt,
        num_elites: PositiveInt,
        num_iterations: PositiveInt,
        temperature: PositiveFloat,
        momentum: Share,
        min_deviation: NonNegativeFloat,
        pessimism: NonNegativeFloat,
        planning_precision: Literal["float32", "bfloat16"],
    ) -> None:
        super().__init__(specs)
        self.weights = {"state": state_weight, "reward": reward_weight, "termination": termination_weight}
        self.rho, self.horizon, self.batch_size = rho, horizon, batch_size
        self.updates_per_frame, self.warmup_frames = updates_per_frame, warmup_frames
        self.model = PAMDPModel(specs, form, hidden_dims, num_members)
        search = dict(num_samples=num_samples, num_elites=num_elites, num_iterations=num_iterations, gamma=gamma)
        search |= dict(temperature=temperature, momentum=momentum, min_deviation=min_deviation, pessimism=pessimism)
        search |= dict(precision=planning_precision)
        self.policy = DLPAPolicy(Planner(self.model, specs, horizon=horizon, **search), specs, epsilon)
        self.register_buffer("frames", torch.zeros((), dtype=torch.long))
        self.register_buffer("updates", torch.zeros((), dtype=torch.long))
        self.to(device)
        self.optimizer = torch.optim.Adam(self.model.parameters(), lr=lr, fused=True)
        self.buffer = ReplayBuffer(storage=LazyTensorStorage(buffer_size, device=device))

    def stateful(self) -> dict[str, Any]:
        """Return the optimiser and the replay buffer."""
        return {"model": self.optimizer, "buffer": self.buffer}

    def learn(self, batch: TensorDictBase, mask: Tensor) -> dict[str, float]:
        """Store the batch's transitions and, once the warm-up is over, train the model on windows of them."""
        if not mask.any():
            return {}
        self.store(batch, mask)
        before, self.frames = self.frames.clone(), self.frames + mask.sum()
        if self.frames < self.warmup_frames:
            return {}
        if before < self.warmup_frames:
            seen = self.buffer[:]
            self.model.fit_scales(seen["state"], seen["next_state"])
            before = torch.zeros_like(before)
        losses: dict[str, list[Tensor]] = {}
        for _ in range(int(self.frames * self.updates_per_frame) - int(before * self.updates_per_frame)):
            self._update(losses)
        self.policy.is_trained.fill_(True)
        return {name: torch.stack(values).mean().item() for name, values in losses.items()} | {
            "updates": self.updates.item()
        }

    def store(self, batch: TensorDictBase, mask: Tensor) -> None:
        """Add the masked transitions of a batch `[*B, T]`, each with the place of the one that follows it.

        `successor` is -1 where an episode ends, and while what follows an unfinished one is not known yet: it is the
        first step of a later batch that starts in the same environment with the state in which this one ended.
        """
        num_steps = mask.shape[-1]
        rows = batch[mask]
        environment, step = mask.reshape(-1, num_steps).nonzero().unbind(-1)
        over = rows["next", keys.DONE].squeeze(-1)
        waiting = self._waiting(mask[..., 0].numel())
        new = TensorDict(
            {
                "state": rows[keys.OBSERVATION],
                "discrete": rows[keys.DISCRETE],
                "unit": self.specs.to_unit(rows[keys.PARAMETERS]),
                "reward": rows["next", keys.REWARD].squeeze(-1),
                "next_state": rows["next", keys.OBSERVATION],
                "terminated": rows["next", keys.TERMINATED].squeeze(-1),
                "over": over,
                "environment": environment,
                "successor": torch.full_like(environment, -1),
            },
            batch_size=rows.shape,
        )
        place = self.buffer.extend(new).to(over.device)
        stored = self.buffer[:]
        # In one environment an option's steps lie side by side until its episode ends.
        goes_on = (~over & (step < num_steps - 1)).nonzero().squeeze(-1)
        stored["successor"][place[goes_on]] = place[goes_on + 1]
        first = (step == 0).nonzero().squeeze(-1)
        last = waiting[environment[first]]
        is_next = (last >= 0) & (stored["next_state"][last] == new["state"][first]).all(-1)
        stored["successor"][last[is_next]] = place[first[is_next]]

    def _waiting(self, num_environments: int) -> Tensor:
        """Return where in the replay each environment's unfinished episode ends `[num_environments]`, -1: none."""
        waiting = torch.full((num_environments,), -1, device=self.frames.device)
        if len(self.buffer):
            stored = self.buffer[:]
            place = (~stored["over"] & (stored["successor"] < 0)).nonzero().squeeze(-1)
            waiting[stored["environment"][place]] = place
        return waiting

    def windows(self) -> TensorDictBase:
        """Sample windows `[batch_size, horizon]` of steps that follow each other; `valid` up to an episode's end."""
        stored, rows = self.buffer[:], [self.buffer.sample(self.batch_size)]
        valid = [torch.ones_like(rows[0]["over"])]
        for _ in range(self.horizon - 1):
            successor = rows[-1]["successor"]
            valid.append(valid[-1] & (successor >= 0))
            rows.append(stored[successor.clamp(min=0)])
        return torch.stack([row.select(*stored.keys()) for row in rows], 1).set("valid", torch.stack(valid, 1))

    def losses(self, windows: TensorDictBase) -> dict[str, Tensor]:
        """Return the parts of the H-step loss, each summed over a window with weight rho^h, averaged over windows."""
        parts: dict[str, Tensor] = dict.fromkeys(self.weights, torch.zeros((), device=self.frames.device))
        state = windows["state"][:, 0]
        for h, step in enumerate(windows.unbind(1)):
            predicted = self.model(state, step["discrete"], step["unit"])
            state, terminated = predicted.next_state, step["terminated"]
            change = ((state - step["next_state"]) / self.model.change_scale).square().mean(-1) * ~terminated
            reward = torch.where(terminated, predicted.terminating, predicted.continuing)
            label = terminated.float().expand_as(reward)
            errors = {
                "state": change,
                "reward": (reward - step["reward"]).square().mean(0),
                "termination": F.binary_cross_entropy_with_logits(predicted.logit, label, reduction="none").mean(0),
            }
            for name, error in errors.items():
                parts[name] = parts[name] + self.rho**h * (error * step["valid"]).mean()
        return parts

    def _update(self, losses: dict[str, list[Tensor]]) -> None:
        parts = self.losses(self.windows())
        self.optimizer.zero_grad(set_to_none=True)
        sum(self.weights[name] * part for name, part in parts.items()).backward()
        self.optimizer.step()
        self.updates += 1
        for name, part in parts.items():
            losses.setdefault(name, []).append(part.detach())
