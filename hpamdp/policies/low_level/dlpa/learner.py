"""DLPA: model predictive control over discrete actions and their parameters, in a learned model.

A transition predictor, two reward predictors and a termination predictor are trained on windows of consecutive real
steps. Every action is the first one of the best action sequence that a sampling-based planner finds in them.

Source: Zhang, Fu, Miao and Konidaris, *Model-based Reinforcement Learning for Parameterized Action Spaces*, 2024, arXiv
2404.03037, section 4: the three forms of the model, the H-step loss, the two reward predictors and the planner, which
extends model predictive path integral control (Williams et al. 2015, arXiv 1509.01149) to parameterised actions.

Differs from the source:
- the transition predictor's target is the change of the state in units of its standard deviation over all stored steps.
  It is trained only on steps that do not terminate, because a plan never continues after one that does. The source's
  code predicts the next state itself, on Platform and Goal through a tanh;
- predictors give numbers. Those of the source's code give Gaussians: training and exploring plans sample from them, and
  greedy plans take the means;
- reward and termination are predicted from the state and the action. In the source's code they are predicted from the
  predicted next state and the action;
- rewards are not squashed, and both reward predictors are used: a plan's return weights them by the predicted
  probability of termination, and later rewards by the probability that the episode continues. The source's code
  squashes rewards on Platform alone, and has the second predictor on Catch Point and Hard Move alone. It ends an
  imagined episode where termination is more likely than not;
- reward and termination have an ensemble of networks; a plan's return is the ensemble's mean minus `pessimism` standard
  deviations;
- `form="masking"` sets the inputs of the other actions to 0. In the source's code the networks see the action's own
  parameters alone and predict for all discrete actions; the chosen one's prediction is taken;
- parameters have a standard deviation of 1 at first and `min_deviation` at least. The source's code begins with 2 and
  has no lower limit;
- the warm-up is 1,000 steps, and the first updates make up for them. In the source's code it is 50 episodes without
  updates;
- windows begin at any step. In the source's code none begins in the last `horizon` steps before the step limit;
- the source's code clamps the parts of the loss at 1e4. It multiplies each termination loss by the masks of all
  windows, not by its own alone. Its learning rate is 3e-4, not 1e-3;
- every plan starts from scratch. To start from the previous plan, it would have to be stored with the environments'
  data. In the true model of this project's benchmark, such a warm start adds little: 0.002 to 0.005 of the best
  possible score at 5 iterations, and 0.006 to 0.01 at 3;
- a greedy action is the likeliest one of the plan's final distribution, with mean parameters. The source's code draws
  one of the last elites by their weights, also in evaluations;
- exploring actions are sampled from the plan's final distribution, a fraction of them uniformly. The source adds noise
  to the drawn elite;
- elites are weighted relative to the spread of returns, by the standard deviation over the plan's first samples. The
  source's weights depend on the scale of the rewards;
- with `end_values` a plan also counts the value of its last state (`policies.shared.end_values`);
- with `memory` the model also sees what is remembered of the session's earlier observations, for problems in which
  something hidden stays the same. The H-step loss trains the memory. Imagined steps go into it, in plans and in the
  windows. Models that are told a learned context: Rakelly et al. 2019, *PEARL*, arXiv 1903.08254; Zintgraf et al. 2020,
  *VariBAD*, arXiv 1910.08348. There the context is a distribution over a latent variable, with a prior: VariBAD's
  decoder of rewards and transitions trains it, PEARL's critic does. Both give it to a model-free policy. Here it is the
  state of a GRU, and a plan does not count what could be done better after finding out;
- windows and plans end where a trip ends, because the start of the next trip is random.

TorchRL's SliceSampler (`fragmented`, padded) does not fit: it samples trajectories instead of steps uniformly, and none
of its windows starts in the last `horizon - 1` steps of a longer trajectory. So the model learns most terminations from
predicted states only. On this project's benchmark the score after 8,000 steps was 0.77 with it and 2.71 without.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TypeAlias

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.nn import functional as F

from hpamdp import keys
from hpamdp.acting import is_greedy
from hpamdp.policies.base import Bonus, known_ends
from hpamdp.policies.low_level.dlpa.model import PAMDPModel
from hpamdp.policies.low_level.dlpa.options import CARDS, DLPAOptions
from hpamdp.policies.low_level.dlpa.planner import Planner
from hpamdp.policies.shared.memory import Stack
from hpamdp.policies.shared.perception import Perception
from hpamdp.policies.shared.planning_learner import PlanningLearner
from hpamdp.policies.shared.planning_policy import PlanningPolicy
from hpamdp.policies.shared.sequences import HistoryLinks, past_of
from hpamdp.specs import PAMDPSpecs

Tensors: TypeAlias = Mapping[str, Tensor] | TensorDictBase

# What the model learns from; beside it, where a step's window goes on.
_STORED = ("state", "discrete", "unit", "reward", "next_state")
# What a memory's state is computed from: the stored state of a stack, and the steps that a GRU saw.
_REMEMBERED = ("memory", "past", "num_past", "first_memory", "first_begins")


class DLPAPolicy(PlanningPolicy):
    """The plan's first action: the likeliest discrete action with mean parameters or, when exploring, a sample."""

    def __init__(self, planner: Planner, specs: PAMDPSpecs, epsilon: float, perception: Perception) -> None:
        super().__init__(specs, epsilon, perception)
        self.model = planner.model  # makes the model's weights part of the policy's state
        self.end_value = planner.end_value  # and those of the values
        self.planner = planner
        self.bonus: Bonus | None = None

    def first_action(
        self, td: TensorDictBase, observation: Tensor, is_planned: Tensor, mask: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Return the first action of each plan, see `PlanningPolicy.first_action`."""
        features = self.perception(observation[is_planned], self.remembered(td, is_planned), has_seen=True)
        plan = self.planner.plan(features, mask, None if is_greedy() else self.bonus)
        probability, mean, deviation = (part[:, 0] for part in plan)
        components = self.specs.components
        if is_greedy():
            return components.best(probability), mean
        unit_parameters = mean + deviation * torch.randn_like(mean)
        drawn = [part.multinomial(1) for part in probability.split(components.sizes, -1)]
        discrete = drawn[0].squeeze(-1) if components.is_single else torch.cat(drawn, -1)
        return discrete, unit_parameters.clamp(-1.0, 1.0)


class DLPA(PlanningLearner):
    """A PAMDPModel trained on windows from a replay buffer, and a Planner that acts in it.

    Windows never leave their trajectory, which is an unbroken sequence of this learner's steps within one environment,
    episode, trip and option. It may span several batches.
    """

    Options = DLPAOptions
    card = CARDS["DLPA"]
    added_later = ("order.last_rows",)  # checkpoints of 0.3 lack it
    options: DLPAOptions
    policy: DLPAPolicy

    def make_networks(self, specs: PAMDPSpecs) -> None:
        """Make the networks and the policy."""
        options = self.options
        self.set_perception(options)
        seen, dims = self.perception.specs, options.hidden_dims
        context_dim = seen.observation_dim - specs.observation_dim
        self.order = HistoryLinks()
        self.model = PAMDPModel(seen, options.form, dims, options.num_members, context_dim)
        self.end_values = self.make_end_values(dims)
        planner = Planner(self.model, specs, options, self.end_values, self.perception.imagined)
        self.policy = DLPAPolicy(planner, specs, options.epsilon, self.perception)

    def stored_losses(self) -> dict[str, Tensor]:
        """Return the H-step loss on the windows that start at all stored steps, and its parts."""
        windows = self.windows(torch.arange(len(self.buffer), device=self.frames.device))
        loss, parts = self.loss(windows.select(*_STORED, "terminated", "valid"), windows[:, 0].select("state"))
        return {"loss": loss, **parts}

    def update_once(self, sample: TensorDictBase) -> dict[str, Tensor]:
        """Update the model from windows `[batch_size, horizon]`, and the values from the first step of each."""
        first = sample[:, 0]
        if self.links is not None:
            first.update(past_of(self.buffer, first["place"], self.num_past))
        windows = sample.select(*_STORED, "terminated", "valid")
        scalars = self.gradient_step("model", self.loss, windows, first.select("state", *_REMEMBERED, strict=False))
        return scalars | self.update_end_values(first)

    def loss(self, windows: Tensors, first: Tensors) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the weighted sum of the parts of the H-step loss, and the parts.

        Args:
            windows: of consecutive steps, `[B, horizon]`.
            first: the first step of each window, `[B]`, with what the memory saw before it.
        """
        parts = self.losses(windows, self.features(first))
        loss = torch.zeros((), device=self.frames.device, dtype=torch.float32)
        for name, part in parts.items():
            loss = loss + getattr(self.options, f"{name}_weight") * part
        return loss, parts

    def losses(self, windows: Tensors, features: Tensor) -> dict[str, Tensor]:
        """Return the parts of the H-step loss, each summed over a window with weight rho^h, averaged over windows.

        Args:
            windows: of consecutive steps, `[B, horizon]`.
            features: what the networks see of the first step of each window, `[B, F]`.
        """
        zero = torch.zeros((), device=self.frames.device, dtype=torch.float32)
        parts = dict.fromkeys(("state", "reward", "termination"), zero)
        for h in range(self.options.horizon):
            step = {name: column[:, h] for name, column in windows.items()}
            predicted = self.model(features, step["discrete"], step["unit"])
            state = predicted.next_state
            if h < self.options.horizon - 1:
                features = self.perception.imagined(features, state)
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
                parts[name] = parts[name] + self.options.rho**h * (error * step["valid"]).mean()
        return parts

    def transitions(self, batch: TensorDictBase) -> TensorDict:
        """Return the model's inputs and targets in a batch `[*B, T]`, and those of the values, if they are learned."""
        rows = super().transitions(batch)
        return rows if self.end_values is not None else rows.select(*_STORED, "terminated", "memory", strict=False)

    def store(self, batch: TensorDictBase, mask: Tensor) -> None:
        """Add the transitions in `mask` of a batch `[*B, T]`, and link the steps before them to these.

        `successor` is the place in the buffer of the step that follows, -1 while there is none. The next batch holds
        the same environments in the same order.
        """
        num_steps = mask.shape[-1]
        rows = self.linked(self.transitions(batch), batch, mask).reshape(-1, num_steps)
        mask = mask.reshape(-1, num_steps)
        ends = known_ends(batch).reshape(-1, num_steps) | rows["terminated"]
        # The step before each, which may be the last one of an earlier batch.
        previous = self.order(torch.zeros_like(mask), mask, self.buffer.write_count)
        follows = mask & (previous >= 0)
        if follows[:, 0].any():
            before = self.buffer[:][previous[:, 0].clamp(min=0) % self.options.buffer_size]
            leads_on = (before["next_state"] == rows["state"][:, 0]).all(-1)  # not after a restart
            follows[:, 0] &= leads_on & ~before["terminated"]
        if keys.IS_DECISION in batch.keys():  # the option of the batch before may have ended, see `known_ends`
            follows[:, 0] &= ~batch.get(keys.IS_DECISION).reshape(-1, num_steps)[:, 0]
        follows[:, 1:] &= mask[:, :-1] & ~ends[:, :-1]
        # A data set may lack steps: then the next row does not begin where this one led.
        follows[:, 1:] &= rows["next_state"][:, :-1].isclose(rows["state"][:, 1:], atol=1e-4).all(-1)
        rows["successor"] = torch.full_like(previous, -1)
        place = torch.full_like(previous, -1)
        place[mask] = self.buffer.extend(rows[mask]).to(place.device)
        follows &= previous >= self.buffer.write_count - self.options.buffer_size  # not overwritten
        self.buffer[:]["successor"][previous[follows] % self.options.buffer_size] = place[follows]

    def on_progress(self, steps: int) -> None:
        """Let the policy plan."""
        self.policy.is_trained.fill_(True)

    def sample_batches(self, num_batches: int) -> Iterator[TensorDictBase]:
        """Fit the model's scales; yield `num_batches` samples of windows that start at any stored step.

        The scales are those of all stored steps. During the warm-up some entries of the state hardly change, such as
        those of places far from the start. Scaled by the warm-up alone, they would be in the hundreds once the policy
        gets there.
        """
        stored = self.buffer[:]
        context = stored["memory"][:, : self.model.context_dim] if isinstance(self.perception.memory, Stack) else None
        self.model.fit_scales(stored["state"], stored["next_state"], context)
        starts = torch.randint(len(self.buffer), (num_batches, self.options.batch_size), device=self.frames.device)
        for start in starts:
            yield self.augmented(self.windows(start))

    def windows(self, start: Tensor) -> TensorDictBase:
        """Return the windows `[N, horizon]` of consecutive steps that start at places `[N]`.

        `valid` is true until the trajectory's end; the steps after it are arbitrary. `place` says where each step is.
        """
        stored = self.buffer[:]
        places = [start]
        valid = [torch.ones_like(start, dtype=torch.bool)]
        for _ in range(self.options.horizon - 1):
            successor = stored["successor"][places[-1]]
            valid.append(valid[-1] & (successor >= 0))
            places.append(successor.clamp(min=0))
        place = torch.stack(places, 1)
        return stored[place].update({"valid": torch.stack(valid, 1), "place": place})
