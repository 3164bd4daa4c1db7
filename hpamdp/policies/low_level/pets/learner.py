"""PETS for parameterised actions: learn an ensemble of models, and act by model-predictive control (MPC).

Members predict the next state, the reward and the end of an episode. A plan tries every sequence of discrete actions,
each with Gaussians of its own for their parameters. To explore, an environment follows the plans of a single member
until its episode or option ends; a greedy plan takes the mean of all members' returns. It is meant for a few hundred
steps.

Sources: Chua, Calandra, McAllister and Levine 2018, *Deep Reinforcement Learning in a Handful of Trials using
Probabilistic Dynamics Models*, arXiv 1805.12114: the ensemble, the probabilistic members, and a member for each
imagined trajectory (TS-infinity). Posterior sampling: Osband, Russo and Van Roy 2013, arXiv 1306.0940. Reward and
termination of parameterised actions: Zhang et al. 2024, arXiv 2404.03037. Symmetry: van der Pol et al. 2020, arXiv
2006.16908.

Differs from the sources:
- the model has two stages. A small network predicts the change of the state in a step that does not terminate. A larger
  network sees where the step would lead by that prediction, and predicts termination and reward: an end, such as at a
  wall or in a target, depends on where a step leads;
- if the problem declares its geometry, states are turned until the discrete action points along +x before the networks
  see them. The lengths of all vectors are among the inputs. For other declared symmetries, the model also learns from
  the mapped steps (`augment`);
- if the problem only reveals where its actions point, states are turned by what the episode's steps have shown. Until
  all is known, plans begin under sampled directions, and count what their first action would show (`hypotheses`,
  `policies.shared.contingent_planning`);
- if states are not turned, the change is a linear model, fitted by least squares, plus what the networks add to it
  (`linear_part`). A few hundred steps teach networks alone little of such a problem;
- if states are not turned, exploring plans maximise the mean of all members' returns plus their standard deviation
  (`posterior_sampling`, `optimism`). Every single member predicts no reward for actions that had none so far, so
  planning with one member does not explore;
- if options end inside episodes, a member is followed for one option, not for an episode. With options of one or two
  steps, little of posterior sampling is left;
- `epsilon` makes some exploratory actions random. If no ensemble member has seen a reward, all of them predict none,
  and planning alone never finds it;
- some entries of the state change linearly with others, such as a target's offset with the agent's own place. They are
  derived from these instead of predicted;
- members share the data and differ in their initial weights and their minibatches; there is no bootstrap;
- reward and termination are learned, and returns are discounted. The code of Chua et al. is given the cost of a state
  and knows no terminations. Its plans have 25 or 30 steps and no discount;
- by default members predict no variance (`probabilistic`). If they do, it lies between fixed limits. In the code of
  Chua et al. all members predict it, and learn its limits;
- each member imagines one trajectory, not four as in the code of Chua et al. (20 for five members);
- the networks are small and have ReLU. Those of Chua et al. have three or four layers of 200 or 500 swish units;
- targets are standardised, too. The code of Chua et al. standardises inputs alone;
- there are ten updates for each step. The code of Chua et al. makes five passes over all data after each episode;
- exploring plans carry Gaussian noise on the parameters. The code of Chua et al. adds none;
- the first 64 steps are random, and more until two rewards differ. In the code of Chua et al. the first episode is;
- weight decay falls with the number of stored steps, as the weight of a prior does;
- each sequence of discrete actions has its own search for parameters (`policies.shared.planning`). It weighs the elites
  by their returns and takes the best sample. The code of Chua et al. takes the mean of equally weighted elites;
- every plan starts from scratch. In the code of Chua et al. it starts from the last one, moved on by a step;
- with `end_values` a plan also counts the value of its last state (`policies.shared.end_values`);
- with `memory` the networks also see what is remembered of the session's earlier observations, for problems in which
  something hidden stays the same. Imagined steps go into the memory, too. Models that are told a context: Rakelly et
  al. 2019, *PEARL*, arXiv 1903.08254; Nagabandi et al. 2019, *Learning to Adapt*, arXiv 1803.11347, which adapts the
  model's weights instead;
- plans end where a trip ends, because the start of the next trip is random.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.nn import functional as F

from hpamdp.devices import Device
from hpamdp.policies.base import Bonus, States
from hpamdp.policies.low_level.pets.model import PETSModel
from hpamdp.policies.low_level.pets.options import CARDS, PETSOptions
from hpamdp.policies.low_level.pets.policy import PETSPolicy
from hpamdp.policies.shared.known_directions import KnownDirections
from hpamdp.policies.shared.memory import Stack
from hpamdp.policies.shared.planning_learner import PlanningLearner
from hpamdp.policies.shared.sequences import past_of, sample_with_past, states_of_past
from hpamdp.settings import SettingError
from hpamdp.specs import PAMDPSpecs

_MAX_COPIES = 16  # of a stored step under the problem's symmetries


class PETS(PlanningLearner):
    """A PETSModel trained on all steps so far, and a SequenceSearch that plans in it."""

    Options = PETSOptions
    card = CARDS["PETS"]
    stores_own_parameters = True

    options: PETSOptions
    policy: PETSPolicy

    def __init__(self, specs: PAMDPSpecs, *, device: Device = "cpu", options: Any = None, **settings: Any) -> None:
        options = PETSOptions.of(options, settings)
        self.num_entries = specs.observation_dim
        self.entries = list(range(self.num_entries))
        uses_geometry = options.augment is not False and options.memory == "none"
        self.is_revealed = uses_geometry and specs.geometry is not None and specs.geometry.revealed is not None
        if uses_geometry and not self.is_revealed:
            self.entries, specs = specs.telling_entries, specs.with_telling_entries()
        super().__init__(specs, device=device, options=options)

    def make_networks(self, specs: PAMDPSpecs) -> None:
        """Make the model and the policy that plans in it."""
        options = self.options
        self.weight_decay = options.weight_decay
        self.set_perception(options, knows_directions=self.is_revealed)
        features_dim = self.perception.specs.observation_dim
        predicted = specs.with_telling_entries() if self.is_revealed else specs
        if options.memory != "none":
            predicted = _without_directions(specs)
        context_dim = features_dim - predicted.observation_dim
        self.model = PETSModel(predicted, options, context_dim, is_revealed=self.is_revealed)
        self.end_values = self.make_end_values(options.outcome_dims)
        self.policy = PETSPolicy(self.model, specs, self.entries, options, self.perception, self.end_values)

    def take_bonus(self, bonus: Bonus) -> None:
        """Add a bonus, scaled as rewards are, to the rewards of exploring plans, which all members then make together.

        Raises:
            SettingError: the bonus is of whole observations, but the model predicts less, or turned ones.
        """
        if bonus.of is not None and (self.model.frame.turns or len(self.entries) < self.num_entries):
            raise SettingError(
                "low=pets does not predict whole observations here, so it cannot tell how new they are; use "
                "low.augment=false, or exploration=novelty exploration.in_plans=disagreement"
            )
        super().take_bonus(bonus)
        self.policy.samples_posterior = False

    def update_once(self, sample: TensorDictBase) -> dict[str, Tensor]:
        """Update every member from its own minibatch of a sample `[num_members, batch_size]`.

        Then update the values, if they are learned, from as many steps, mapped by no symmetry.
        """
        scalars = self.gradient_step("model", self.loss, sample)
        if self.end_values is None:
            return scalars
        num = sample.numel()
        rows = self.buffer.sample(num) if self.links is None else sample_with_past(self.buffer, num, self.num_past)
        return scalars | self.update_end_values(rows)

    def loss(self, sample: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the sum of the members' losses, and the mean of each part of it."""
        ends = sample["terminated"]
        transition, outcome = self.model.in_frame(sample["turned"], sample["action"], self._context(sample))
        change = sample["change"]
        if self.model.is_probabilistic:
            mean, log_variance = self.model.moments(transition)
            error = 0.5 * ((mean - change).square() * (-log_variance).exp() + log_variance)
        else:
            error = (transition - change).square()
        is_predicted = self.model.is_predicted
        error = (error * is_predicted).sum(-1) / is_predicted.sum().clamp(min=1.0)
        logit, terminating, continuing = outcome.unbind(-1)
        reward = torch.where(ends > 0.0, terminating, continuing)
        parts = {
            "change": (error * (1.0 - ends)).mean(),
            "termination": F.binary_cross_entropy_with_logits(logit, ends),
            "reward": (reward - sample["reward"]).square().mean(),
        }
        loss = self.options.transition_weight * parts["change"] + parts["termination"] + parts["reward"]
        return loss * self.model.num_members, parts

    def stored_losses(self) -> dict[str, Tensor]:
        """Return the members' mean loss on all stored steps, and its parts, at the model's present scales."""
        rows = self.prepared(fits=False)
        loss, parts = self.loss(rows.expand(self.model.num_members, len(rows)))
        return {"loss": loss / self.model.num_members, **parts}

    def _context(self, sample: TensorDictBase) -> Tensor | None:
        """Return what is remembered of the observations before those of a sample, `[E, B, context_dim]`, if anything.

        A recurrent memory has seen the sample's own observations as well.
        """
        if self.links is None:
            return sample.get("context", None)
        states = states_of_past(sample.flatten(0, 1), self.perception, self.burn_in)
        return states.unflatten(0, sample.batch_size)

    def value(self, states: States, *, is_target: bool = False) -> Tensor:
        """Return the values `[N]` of states.

        With `end_values` they are what these have learned, whatever a mask allows; else see `PETSPolicy.value`.
        """
        if self.end_values is None:
            return self.policy.value(states)
        return super().value(states._replace(observation=states.observation[..., self.entries]))

    def sample_batches(self, num_batches: int) -> Iterator[TensorDictBase]:
        """Yield samples `[num_members, batch_size]` of all stored steps, each with all its mirror images or maps."""
        options = self.options
        decay = options.weight_decay * min(1.0, options.weight_decay_steps / len(self.buffer))
        for group in self.optimizers["model"].param_groups:
            group["weight_decay"] = decay
        rows = self.prepared()
        shape = num_batches, options.num_members, options.batch_size
        for places in torch.randint(len(rows), shape, device=rows.device):
            sample = rows[places]
            if self.links is not None:  # there is a row for each stored step, in the same order
                past = past_of(self.buffer, places.flatten(), self.num_past)
                sample.update(past.unflatten(0, places.shape))
            yield sample

    def prepared(self, *, fits: bool = True) -> TensorDict:
        """Return all stored steps in the canonical frame, as the model sees them; first fit its scales, if `fits`."""
        stored = self.buffer[:].select("state", "discrete", "unit", "next_state", "reward", "terminated")
        frame = self.model.frame
        if self.symmetry is not None and not frame.turns:
            stored = self._with_all_maps(stored)
        joint = self.policy.joint
        if joint.components.is_single:
            states, certainty = [stored["state"], stored["next_state"]], None
            memory = self.perception.memory
            if isinstance(memory, KnownDirections):
                table = memory.table(memory.under_held_option(stored["state"], self.buffer[:]["memory"]))
                direction, certainty = frame.revealed_direction(table, stored["discrete"])
                states = [memory.telling(state) for state in states]
            else:
                direction = frame.direction(stored["state"], stored["discrete"])
            turned = [frame.turn(state, direction) for state in states]
            kind, own = frame.kind[stored["discrete"]], stored["unit"] * joint.has_slot[stored["discrete"]]
        else:
            turned = [stored["state"], stored["next_state"]]
            kind = joint.number(stored["discrete"])
            own, certainty = joint.own(kind, stored["unit"]), None
        reward, terminated = stored["reward"], stored["terminated"]
        if frame.turns and frame.geometry is not None and frame.geometry.has_mirror:
            turned = [torch.cat([state, frame.mirror(state)]) for state in turned]
            kind, own, reward, terminated = (torch.cat([part, part]) for part in (kind, own, reward, terminated))
            certainty = None if certainty is None else torch.cat([certainty, certainty])
        action = self.model.action_inputs(kind, own, certainty)
        if fits:
            self.model.fit_scales(turned[0], action, turned[1], reward, terminated)
        mean, scale = self.model.reward_mean, self.model.reward_scale
        which = terminated.long()
        contexts: dict[str, Tensor] = {}
        if isinstance(self.perception.memory, Stack):
            contexts["context"] = self.buffer[:]["memory"][:, : self.model.context_dim]
            self.model.fit_context_scales(contexts["context"])
        return TensorDict(
            {
                **contexts,
                "turned": turned[0],
                "action": action,
                "change": self.model.target_change(turned[0], action, turned[1]),
                "reward": (reward - mean[which]) / scale[which],
                "terminated": terminated.float(),
            },
            batch_size=len(reward),
        )

    def _with_all_maps(self, stored: TensorDictBase) -> TensorDictBase:
        """Return stored steps under all symmetries, or of many of them each under some."""
        assert self.symmetry is not None
        num_maps = len(self.symmetry.maps)
        copies = min(num_maps, _MAX_COPIES)
        number = torch.arange(copies, device=stored.device).repeat_interleave(len(stored))
        if copies < num_maps:
            number = torch.randint(num_maps, number.shape, device=stored.device)
        rows = stored.repeat(copies)
        rows = rows.set("unit", self._all_parameters(rows["discrete"], rows["unit"]))
        rows = self.symmetry.mapped(number, rows)
        return rows.set("unit", rows["unit"].gather(-1, self.slots[rows["discrete"]]))

    def on_progress(self, steps: int) -> None:
        """Let the policy plan once stored rewards or terminations differ.

        With end values, or a reward for new states, it plans at once.
        """
        if self.policy.is_trained:  # later steps may be the same because the plans are good
            return
        stored = self.buffer[:]
        differ = [(stored[name] != stored[name][0]).any() for name in ("reward", "terminated")]
        plans_at_once = self.end_values is not None or self.bonus is not None
        self.policy.is_trained.fill_(plans_at_once or bool(torch.stack(differ).any()))

    def transitions(self, batch: TensorDictBase) -> TensorDict:
        """Return the model's inputs and targets in a batch `[*B, T]`; a truncated step has not terminated.

        A step that ends a trip counts as one that terminates. Where values are learned, `next_observation` has all
        entries of the next state.
        """
        rows = super().transitions(batch)
        if self.end_values is None:
            rows = rows.exclude("discount", "action_mask", "next_action_mask")
        else:
            rows.set("next_observation", rows["next_state"])
        for name in ("state", "next_state"):
            rows.set(name, rows[name][..., self.entries])
        return rows


def _without_directions(specs: PAMDPSpecs) -> PAMDPSpecs:
    """Return the specs without the directions of actions, so that no states are turned.

    With a memory nothing can be turned, because what is remembered would have to turn, too.
    """
    geometry = specs.geometry
    return specs if geometry is None else replace(specs, geometry=replace(geometry, directions=None))
