"""DLPA: model predictive control over discrete actions and their parameters, in a learned model.

A transition, two reward and a termination predictor are trained on windows of consecutive real steps. Every action is
the first one of the best action sequence that a sampling-based planner finds in them.

Source: Zhang, Fu, Miao and Konidaris, *Model-based Reinforcement Learning for Parameterized Action Spaces*, 2024, arXiv
2404.03037, section 4: the three forms of the model, the H-step loss, the two reward predictors and the planner, which
extends model predictive path integral control (Williams et al. 2015, arXiv 1509.01149) to parameterised actions.

Differs from the source:
- the transition predictor's target is the change of the state in units of its standard deviation over all stored steps,
  and it is trained only on steps that do not terminate: a plan never continues after one that does;
- rewards are not squashed, and both reward predictors are used: a plan's return weights them by the predicted
  probability of termination, and what follows by the probability that the episode continues;
- reward and termination have an ensemble of networks; a plan's return is the ensemble's mean minus `pessimism` standard
  deviations;
- every plan starts from scratch, not from the previous one, which would have to be stored with the environments' data;
  with the true model of this project's benchmark, a warm start adds .002 to .005 of the best possible score at 5
  iterations, .006 to .01 at 3;
- exploring actions are sampled from the plan's final distribution, a fraction of them uniformly;
- with `end_values` a plan also counts what its last state is worth (`policies.shared.end_values`).

TorchRL's SliceSampler (`fragmented`, padded) does not fit: it samples trajectories instead of steps uniformly, and none
of its windows starts in the last `horizon - 1` steps of a longer trajectory, so that the model learns most terminations
from predicted states only; on this project's benchmark the score after 8,000 steps was .77 with it and 2.71 without.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, ClassVar, Literal, NamedTuple

import torch
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.nn import functional as F

from hpamdp import keys
from hpamdp.policies.base import is_greedy, option_ends
from hpamdp.policies.low_level.dlpa_model import PAMDPModel
from hpamdp.policies.masks import random_choice
from hpamdp.policies.shared.end_values import EndValues
from hpamdp.policies.shared.planning import Prediction, discounted_return, elite_weights
from hpamdp.policies.shared.replay import ReplayLearner, ReplayOptions
from hpamdp.settings import Expectile, LearningRate, PositiveFraction
from hpamdp.specs import PAMDPSpecs

FractionBelowOne = Annotated[float, Field(ge=0.0, lt=1.0)]
Form = Literal["parallel", "masking", "sequential"]

# What the model learns from; beside it, where a step's window goes on.
_STORED = ("state", "discrete", "unit", "reward", "next_state")

_CHUNK_ROWS = 4096  # states predicted at once when planning: fits the cache and bounds the memory


class Plan(NamedTuple):
    """A distribution over action sequences: at each step a categorical and a Gaussian for each parameter."""

    probability: Tensor  # [N, H, num_discrete]
    mean: Tensor  # [N, H, num_parameters] in [-1, 1]
    deviation: Tensor  # [N, H, num_parameters]


class Planner:
    """Find good action sequences in a model by iterated sampling, weighting the best more.

    Args:
        model: maps states, discrete actions and parameters in [-1, 1] to a `Prediction`.
        specs: of the problem.
        horizon: number of steps in a sequence.
        num_samples: number of sequences sampled in each iteration.
        num_elites: number of the best of them that define the next iteration's distribution.
        num_iterations: number of iterations.
        temperature: of the elites' weights exp(return / temperature).
        momentum: weight of the old distribution in the new one.
        min_deviation: smallest standard deviation of a parameter, in [-1, 1] units.
        gamma: discount of a step.
        pessimism: number of standard deviations between the ensemble's members that are subtracted from a return.
        end_value: maps the last state of a plan `[B, observation_dim]` to what it is worth, `[B]`; None: nothing.
        precision: dtype in which the model's networks predict during planning.

    Raises:
        ValueError: `num_elites` is greater than `num_samples`.
    """

    def __init__(
        self,
        model: Callable[[Tensor, Tensor, Tensor], Prediction],
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
        end_value: Callable[[Tensor], Tensor] | None = None,
        precision: str = "float32",
    ) -> None:
        if num_elites > num_samples:
            raise ValueError(f"num_elites={num_elites}, but must be at most num_samples={num_samples}")
        if horizon * num_samples * num_iterations > 1e9:
            raise ValueError(
                f"horizon={horizon}, num_samples={num_samples}, num_iterations={num_iterations}: a plan would try more "
                "than 1,000,000,000 actions"
            )
        self.model = model
        self.specs = specs
        self.horizon = horizon
        self.num_samples = num_samples
        self.num_elites = num_elites
        self.num_iterations = num_iterations
        self.temperature = temperature
        self.momentum = momentum
        self.min_deviation = min_deviation
        self.gamma = gamma
        self.pessimism = pessimism
        self.end_value = end_value
        self.precision: torch.dtype = getattr(torch, precision)

    @torch.no_grad()
    def plan(self, state: Tensor, action_mask: Tensor | None = None) -> Plan:
        """Return the final distributions for states `[N, observation_dim]`.

        Args:
            state: where the plans begin.
            action_mask: what the environment allows there, bool `[N, num_discrete]`; None: everything. What it will
                allow in predicted states is unknown, and taken to be everything.
        """
        size = max(1, _CHUNK_ROWS // self.num_samples)
        masks = [None] * len(state) if action_mask is None else action_mask.split(size)
        plans = [self._plan(rows, mask) for rows, mask in zip(state.split(size), masks, strict=False)]
        return Plan(*(torch.cat(parts) for parts in zip(*plans, strict=True)))

    def _plan(self, state: Tensor, action_mask: Tensor | None) -> Plan:
        shape = state.shape[0], self.horizon
        probability = state.new_full((*shape, self.specs.num_discrete), 1.0 / self.specs.num_discrete)
        later = self.specs.allowed(state)
        if later is not None:
            probability = probability * later.unsqueeze(1)
        if action_mask is not None:
            probability[:, 0] *= action_mask
        if later is not None or action_mask is not None:
            # The iterations never leave these actions: what is not sampled is no elite.
            probability = probability / probability.sum(-1, keepdim=True)
        mean = state.new_zeros(*shape, self.specs.num_parameters)
        plan = Plan(probability, mean, torch.ones_like(mean))
        for _ in range(self.num_iterations):
            discrete, unit = self.sample(plan)
            plan = self.re_estimate(plan, discrete, unit, self.returns(state, discrete, unit))
        return plan

    def sample(self, plan: Plan) -> tuple[Tensor, Tensor]:
        """Sample discrete actions `[N, S, H]` and parameters `[N, S, H, num_parameters]` in [-1, 1]."""
        discrete = plan.probability.flatten(0, 1).multinomial(self.num_samples, replacement=True)
        discrete = discrete.unflatten(0, plan.probability.shape[:2]).transpose(1, 2)
        noise = torch.randn(*discrete.shape, self.specs.num_parameters, device=discrete.device, dtype=torch.float32)
        unit = plan.mean.unsqueeze(1) + plan.deviation.unsqueeze(1) * noise
        return discrete, unit.clamp(-1.0, 1.0)

    def returns(self, state: Tensor, discrete: Tensor, unit: Tensor) -> Tensor:
        """Return the predicted returns `[N, S]` of action sequences from states `[N, observation_dim]`."""
        rows = state.repeat_interleave(discrete.shape[1], 0)

        def steps() -> Iterator[Prediction]:
            nonlocal rows
            for h in range(discrete.shape[2]):
                with torch.autocast(rows.device.type, self.precision, enabled=self.precision != torch.float32):
                    predicted = self.model(rows, discrete[:, :, h].flatten(), unit[:, :, h].flatten(0, 1))
                rows = predicted.next_state
                yield predicted

        total = discounted_return(steps(), self.gamma, self.end_value)
        value = total.mean(0)
        if self.pessimism > 0.0:
            value = value - self.pessimism * total.std(0, correction=0)
        return value.unflatten(0, discrete.shape[:2])

    def re_estimate(self, plan: Plan, discrete: Tensor, unit: Tensor, returns: Tensor) -> Plan:
        """Return the distribution of the elites.

        The parameters of a discrete action are estimated from the elites that choose it; they stay as they were if
        there are none.
        """
        elite, elite_weight = elite_weights(returns, self.num_elites, self.temperature)
        discrete = discrete.take_along_dim(elite[..., None], 1)
        unit = unit.take_along_dim(elite[..., None, None], 1)
        discrete_weight = elite_weight[..., None, None] * F.one_hot(discrete, self.specs.num_discrete)
        parameter_weight = discrete_weight @ self.specs.parameter_mask.to(discrete_weight)
        total = parameter_weight.sum(1)
        parameter_weight = parameter_weight / total.clamp(min=1e-8).unsqueeze(1)
        mean = (parameter_weight * unit).sum(1)
        variance = (parameter_weight * (unit - mean.unsqueeze(1)).square()).sum(1)
        deviation = variance.sqrt().clamp(min=self.min_deviation)
        step = 1.0 - self.momentum
        return Plan(
            plan.probability.lerp(discrete_weight.sum(1), step),
            plan.mean.lerp(torch.where(total > 1e-8, mean, plan.mean), step),
            plan.deviation.lerp(torch.where(total > 1e-8, deviation, plan.deviation), step),
        )


class DLPAPolicy(TensorDictModuleBase):
    """The plan's first action: the likeliest discrete action with mean parameters or, when exploring, a sample.

    Acts uniformly at random until the model has been trained. Nothing is planned for finished episodes: their action is
    random, too, and is ignored.
    """

    is_trained: Tensor

    def __init__(self, planner: Planner, specs: PAMDPSpecs, epsilon: float) -> None:
        super().__init__()
        self.in_keys = [keys.OBSERVATION, keys.DONE]
        self.out_keys = [keys.DISCRETE, keys.PARAMETERS]
        self.model = planner.model  # makes the model's weights part of the policy's state
        self.end_value = planner.end_value  # and those of the values
        self.planner = planner
        self.specs = specs
        self.epsilon = epsilon
        self.register_buffer("is_trained", torch.zeros((), dtype=torch.bool))

    @torch.no_grad()
    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write the discrete action `[*B]` and the parameters `[*B, num_parameters]`."""
        state = td.get(keys.OBSERVATION).flatten(0, -2)
        mask = td.get(keys.ACTION_MASK, None)
        mask = None if mask is None else mask.flatten(0, -2)
        allowed = self.specs.allowed(state, mask)
        discrete = random_choice(state.shape[:1], self.specs.num_discrete, allowed, state.device)
        unit = (
            2.0 * torch.rand(state.shape[0], self.specs.num_parameters, device=state.device, dtype=torch.float32) - 1.0
        )
        is_planned = self.is_trained.expand(state.shape[0])
        done = td.get(keys.DONE, None)
        if done is not None:
            is_planned = is_planned & ~done.flatten()
        exploring = not is_greedy()
        if exploring:
            is_planned = is_planned & (
                torch.rand(state.shape[0], device=state.device, dtype=torch.float32) >= self.epsilon
            )
        if is_planned.any():
            mask = None if mask is None else mask[is_planned]
            discrete[is_planned], unit[is_planned] = self.first_action(state[is_planned], exploring, mask)
        shape = td.batch_size
        parameters = self.specs.from_unit(unit).reshape(*shape, self.specs.num_parameters)
        return td.update({keys.ACTION: {"discrete": discrete.reshape(shape), "parameters": parameters}})

    def first_action(self, state: Tensor, exploring: bool, action_mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the discrete action `[N]` and the parameters `[N, num_parameters]` in [-1, 1] of the first step."""
        probability, mean, deviation = (part[:, 0] for part in self.planner.plan(state, action_mask))
        if not exploring:
            return probability.argmax(-1), mean
        unit = mean + deviation * torch.randn_like(mean)
        return probability.multinomial(1).squeeze(-1), unit.clamp(-1.0, 1.0)


class DLPA(ReplayLearner):
    """A PAMDPModel trained on windows from a replay buffer, and a Planner that acts in it.

    Windows never leave their trajectory, which is an unbroken sequence of this learner's steps within one environment,
    episode and option. It may span several batches.
    """

    modes: ClassVar[tuple[str, ...]] = ("train",)
    value_option = "end_values"

    catches_up = True

    policy: DLPAPolicy

    def __init__(
        self,
        specs: PAMDPSpecs,
        device: torch.device,
        *,
        form: Form,
        hidden_dims: list[PositiveInt],
        num_members: PositiveInt,
        lr: LearningRate,
        state_weight: PositiveFloat,
        reward_weight: PositiveFloat,
        termination_weight: PositiveFloat,
        rho: PositiveFraction,
        buffer_size: PositiveInt,
        batch_size: PositiveInt,
        updates_per_step: PositiveFloat,
        augment: bool,
        warmup_steps: PositiveInt,
        epsilon: FractionBelowOne,
        gamma: PositiveFraction,
        horizon: PositiveInt,
        num_samples: PositiveInt,
        num_elites: PositiveInt,
        num_iterations: PositiveInt,
        temperature: PositiveFloat,
        momentum: FractionBelowOne,
        min_deviation: NonNegativeFloat,
        pessimism: NonNegativeFloat,
        planning_precision: Literal["float32", "bfloat16"],
        end_values: bool,
        end_value_lr: LearningRate,
        end_value_tau: PositiveFraction,
        end_value_expectile: Expectile,
    ) -> None:
        options = ReplayOptions(
            gamma=gamma,
            warmup_steps=warmup_steps,
            buffer_size=buffer_size,
            batch_size=batch_size,
            updates_per_step=updates_per_step,
            augment=augment,
        )
        super().__init__(specs, device, options)
        self.loss_weights = {"state": state_weight, "reward": reward_weight, "termination": termination_weight}
        self.rho = rho
        self.horizon = horizon
        self.model = PAMDPModel(specs, form, hidden_dims, num_members)
        self.end_values = (
            EndValues(specs.observation_dim, hidden_dims, tau=end_value_tau, expectile=end_value_expectile)
            if end_values
            else None
        )
        planner = Planner(
            self.model,
            specs,
            horizon=horizon,
            num_samples=num_samples,
            num_elites=num_elites,
            num_iterations=num_iterations,
            temperature=temperature,
            momentum=momentum,
            min_deviation=min_deviation,
            gamma=gamma,
            pessimism=pessimism,
            end_value=self.end_values,
            precision=planning_precision,
        )
        self.policy = DLPAPolicy(planner, specs, epsilon)
        self.to(device)
        self.optimizers = {"model": torch.optim.Adam(self.model.parameters(), lr=lr, fused=True)}
        if self.end_values is not None:
            self.optimizers["end_values"] = torch.optim.Adam(self.end_values.learned(), lr=end_value_lr, fused=True)

    def value(self, observation: Tensor, action_mask: Tensor | None = None) -> Tensor:
        """Return the values `[N]` of states `[N, observation_dim]` that `end_values` has learned, whatever is allowed.

        Raises:
            NotImplementedError: there are none.
        """
        return super().value(observation) if self.end_values is None else self.end_values.of_own(observation)

    def transitions(self, batch: TensorDictBase) -> TensorDict:
        """Return the model's inputs and targets in a batch `[*B, T]`, and those of the values, if they are learned."""
        rows = super().transitions(batch)
        if self.end_values is None:
            rows = rows.select(*_STORED)
        return rows.set("terminated", batch["next", keys.TERMINATED].squeeze(-1))

    def store(self, batch: TensorDictBase, mask: Tensor) -> None:
        """Add the transitions in `mask` of a batch `[*B, T]`, each with its trajectory and a link to the next step.

        `trajectory` is a number, unique in the buffer. `successor` is the place of the trajectory's next step in the
        buffer, -1 while there is none. `is_open` marks the steps whose successor may come with the next batch, which
        holds the same environments in the same order.
        """
        num_steps = mask.shape[-1]
        rows = self.transitions(batch).reshape(-1, num_steps)
        mask = mask.reshape(-1, num_steps)
        ends = option_ends(batch).reshape(-1, num_steps)
        # A step follows the one before it, which may be the last step of an earlier batch.
        last_place, last_trajectory = self._open_steps(rows["state"][:, 0])
        follows = torch.zeros_like(mask)
        follows[:, 0] = mask[:, 0] & (last_place >= 0)
        follows[:, 1:] = mask[:, 1:] & mask[:, :-1] & ~ends[:, :-1]

        # New trajectories are numbered on from those in the buffer.
        num_stored = len(self.buffer)
        first_number = int(self.buffer[:]["trajectory"].max()) + 1 if num_stored else 0
        is_first = mask & ~follows
        number = first_number + is_first.flatten().cumsum(0).reshape(mask.shape) - 1
        is_new = is_first.cumsum(-1) > 0
        rows["trajectory"] = torch.where(is_new, number, last_trajectory.unsqueeze(-1))
        rows["environment"] = torch.arange(len(mask), device=mask.device).unsqueeze(-1).expand_as(mask)
        rows["successor"] = torch.full_like(number, -1)
        is_open = torch.zeros_like(mask)
        is_open[:, -1] = ~ends[:, -1]
        rows["is_open"] = is_open

        if num_stored:
            self.buffer[:]["is_open"].fill_(False)
        place = torch.full_like(number, -1)
        place[mask] = self.buffer.extend(rows[mask]).to(place.device)
        previous = torch.cat([last_place.unsqueeze(-1), place[:, :-1]], -1)
        self.buffer[:]["successor"][previous[follows]] = place[follows]

    def check_rows(self, rows: TensorDictBase, example: TensorDictBase) -> None:
        """Refuse invalid rows, and links to steps or environments that do not exist."""
        super().check_rows(rows, example)
        limits = {"successor": len(rows), "environment": int(example["environment"].max()) + 1}
        for name, limit in limits.items():
            if not -1 <= int(rows[name].min()) <= int(rows[name].max()) < limit:
                raise ValueError(f"{name} must be from -1 to {limit - 1}")

    def _open_steps(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return which stored step each environment goes on from: its place and its trajectory, each `[N]`.

        Both are -1 where there is none, or where it did not end in the environment's state `[N, observation_dim]`, as
        after a restart.
        """
        place = torch.full((len(state),), -1, device=state.device)
        trajectory = place.clone()
        if len(self.buffer):
            stored = self.buffer[:]
            open_place = stored["is_open"].nonzero().squeeze(-1)
            last = stored[open_place]
            is_followed = (last["next_state"] == state[last["environment"]]).all(-1)
            environment = last["environment"][is_followed]
            place[environment] = open_place[is_followed]
            trajectory[environment] = last["trajectory"][is_followed]
        return place, trajectory

    def on_progress(self, steps: int) -> None:
        """Let the policy plan."""
        self.policy.is_trained.fill_(True)

    def sample_batches(self, num_batches: int) -> Iterator[TensorDictBase]:
        """Fit the model's scales; yield `num_batches` samples of windows that start at any stored step.

        The scales are those of all stored steps: entries of the state that the warm-up saw hardly change, such as those
        of places far from the start, would else be in the hundreds once the policy gets there.
        """
        stored = self.buffer[:]
        self.model.fit_scales(stored["state"], stored["next_state"])
        starts = torch.randint(len(self.buffer), (num_batches, self.options.batch_size), device=self.frames.device)
        for start in starts:
            yield self.augmented(self.windows(start))

    def windows(self, start: Tensor) -> TensorDictBase:
        """Return the windows `[N, horizon]` of consecutive steps that start at places `[N]`.

        `valid` is true until the trajectory's end; the steps after it are arbitrary.
        """
        stored = self.buffer[:]
        trajectory = stored["trajectory"][start]
        places = [start]
        valid = [torch.ones_like(start, dtype=torch.bool)]
        for _ in range(self.horizon - 1):
            successor = stored["successor"][places[-1]]
            place = successor.clamp(min=0)
            valid.append(valid[-1] & (successor >= 0) & (stored["trajectory"][place] == trajectory))
            places.append(place)
        return stored[torch.stack(places, 1)].set("valid", torch.stack(valid, 1))

    def losses(self, windows: Mapping[str, Tensor] | TensorDictBase) -> dict[str, Tensor]:
        """Return the parts of the H-step loss, each summed over a window with weight rho^h, averaged over windows."""
        parts = {name: torch.zeros((), device=self.frames.device, dtype=torch.float32) for name in self.loss_weights}
        state = windows["state"][:, 0]
        for h in range(self.horizon):
            step = {name: column[:, h] for name, column in windows.items()}
            predicted = self.model(state, step["discrete"], step["unit"])
            state = predicted.next_state
            terminated = step["terminated"]
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

    def update_once(self, sample: TensorDictBase) -> dict[str, Tensor]:
        """Update the model from windows `[batch_size, horizon]`, and the values from the first step of each."""
        scalars = self.gradient_step("model", self._loss, sample.select(*_STORED, "terminated", "valid"))
        if self.end_values is not None:
            first = sample[:, 0]
            scalars |= self.end_values.update(self, first, first["state"], first["next_state"])
        return scalars

    def _loss(self, windows: Mapping[str, Tensor] | TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        parts = self.losses(windows)
        loss = torch.zeros((), device=self.frames.device, dtype=torch.float32)
        for name, part in parts.items():
            loss = loss + self.loss_weights[name] * part
        return loss, parts
