"""Judge an agent without its environment: roll it out in a model of recorded transitions.

The model is the ensemble of `low=pets`, fitted to transitions from which the agent has not learned. Every member rolls
the agent out from starts of recorded episodes. If a step terminates with probability p, what follows counts with weight
1 - p.

Source: model-based off-policy evaluation as in Fu et al. 2021, *Benchmarks for Deep Off-Policy Evaluation*, arXiv
2103.16596; the members and TS-infinity of Chua et al. 2018, arXiv 1805.12114.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType

from hpamdp import keys
from hpamdp.acting import acting
from hpamdp.config.errors import ConfigError
from hpamdp.data.row_checks import PERSON
from hpamdp.env.decisions import DecisionTracker
from hpamdp.policies.agent import HierarchicalAgent, with_option
from hpamdp.specs import PAMDPSpecs

_OVER = 1e-3  # probability that an episode goes on, below which it counts as over
_MOST_NEIGHBOURS = 4000  # rows of the data among which the nearest one is looked for
_IN_DATA = 0.95  # fraction of the data's own rows that coverage calls covered


@dataclass(frozen=True)
class Rollout:
    """What a model predicts of an agent. Single numbers are means over starts and members.

    Attributes:
        returns: undiscounted returns from each start, by each member, `[E, N]`.
        steps: expected number of steps.
        coverage: fraction of the agent's actions that are like an action in the data, in a state like one there.
        unfinished: probability that an episode has not ended.
    """

    returns: Tensor
    steps: float
    coverage: float
    unfinished: float


class RecordedProblem:
    """A problem as an ensemble has learned it from recorded transitions.

    Args:
        learner: an untrained `PETS` for `specs`; if there are options, for `specs.with_option_observed()`.
        specs: of the problem.
        rows: the transitions `[M]`, as in `Demonstrations`.
        num_updates: updates of the ensemble.

    Raises:
        ConfigError: no model can stand for this problem.
    """

    def __init__(self, learner: Any, specs: PAMDPSpecs, rows: TensorDict, num_updates: int) -> None:
        forbids = specs.has_action_mask or specs.has_option_mask or specs.has_pair_mask or specs.has_parameter_bounds
        if forbids or specs.entries:
            what = "forbids actions in some states" if forbids else "has pictures"
            raise ConfigError(f"judge: the problem {what}, which a model of recorded transitions does not predict")
        if learner.memory_key is not None:
            raise ConfigError("judge: the problem tells nowhere but in earlier steps where its actions point")
        self.learner = learner
        self.specs = specs
        shown = with_option(rows, specs.num_options) if specs.num_options else rows
        batch = shown.unsqueeze(0)
        learner.add_demonstrations(batch, torch.ones(batch.shape, dtype=torch.bool, device=rows.device))
        learner.update(num_updates)
        model = learner.model
        contexts = set(model.frame.geometry.entries_of_contexts) if model.frame.turns else set()
        # The model's entries that are of the observation and not of a context, by their places in the model.
        self.places = [
            place
            for place, entry in enumerate(learner.entries)
            if place not in contexts and entry < specs.observation_dim
        ]
        self.predicted = [learner.entries[place] for place in self.places]
        self.rest = [entry for entry in range(specs.observation_dim) if entry not in self.predicted]
        goes_on = ~rows["next", keys.TERMINATED].squeeze(-1)
        now, after = shown[keys.OBSERVATION][goes_on], shown["next", keys.OBSERVATION][goes_on]
        inputs = self._inputs_of_rest(now, after[:, self.predicted])
        self.weight = inputs.new_zeros(inputs.shape[-1], 0)
        if self.rest:
            self.weight = torch.linalg.lstsq(inputs, after[:, self.rest].double(), driver="gelsd").solution
        self._known = self._neighbours(shown)

    @property
    def num_members(self) -> int:
        """The number of the ensemble's members."""
        return self.learner.model.num_members

    def _inputs_of_rest(self, now: Tensor, next_predicted: Tensor) -> Tensor:
        """Return what the entries that the model does not predict are linear in, `[B, *]`.

        That is the predicted change, these entries before the step, and the option. So entries that stay the same for
        an episode do, an option that is shown once it is chosen is shown, and a velocity follows from the movement.
        """
        change = next_predicted - now[:, self.predicted]
        option = now[:, self.specs.observation_dim :]
        return torch.cat([change, now[:, self.rest], option, torch.ones_like(now[:, :1])], -1).double()

    @torch.no_grad()
    def step(self, acted: TensorDictBase) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Predict the steps of the agents in `acted` `[E * N]`, member by member.

        Returns:
            The next observations `[E * N, observation_dim]`, the rewards if the step terminates and if it does not, and
            the probability that it terminates, each `[E * N]`.
        """
        state, discrete, own = self._as_seen(acted)
        members = self.num_members
        ahead = self.learner.model(*(part.unflatten(0, (members, -1)) for part in (state, discrete, own)))
        now = (with_option(acted, self.specs.num_options) if self.specs.num_options else acted)[keys.OBSERVATION]
        next_predicted = ahead.next_state.flatten(0, 1)[:, self.places]
        rest = self._inputs_of_rest(now, next_predicted) @ self.weight
        after = now[:, : self.specs.observation_dim].clone()
        after[:, self.predicted], after[:, self.rest] = next_predicted, rest.float()
        scale = self.learner.options.reward_scale
        return (
            after,
            ahead.terminating.flatten() / scale,
            ahead.continuing.flatten() / scale,
            ahead.logit.flatten().sigmoid(),
        )

    def _as_seen(self, rows: TensorDictBase) -> tuple[Tensor, Tensor, Tensor]:
        """Return what the model is given of rows `[B]`: states, numbered choices and their own parameters."""
        if self.specs.num_options and rows[keys.OBSERVATION].shape[-1] == self.specs.observation_dim:
            rows = with_option(rows, self.specs.num_options)
        joint = self.learner.policy.joint
        number = joint.number(rows[keys.DISCRETE])
        own = joint.own(number, self.specs.to_unit(rows[keys.PARAMETERS], rows).clamp(-1.0, 1.0))
        return rows[keys.OBSERVATION][:, self.learner.entries], number, own

    @torch.no_grad()
    def inputs(self, rows: TensorDictBase) -> Tensor:
        """Return what the model's networks see of rows `[B]`, `[B, in]`."""
        return self.learner.model.inputs(*self._as_seen(rows))

    def _neighbours(self, shown: TensorDict) -> tuple[Tensor, float]:
        """Return inputs of the model in the data, `[K, *]`, and how near its neighbour most of them have."""
        some = shown[torch.randperm(len(shown), device=shown.device)[:_MOST_NEIGHBOURS]]
        known = self.inputs(some)
        nearest = torch.cdist(known, known).fill_diagonal_(torch.inf).amin(-1)
        return known, float(nearest.quantile(_IN_DATA)) if len(known) > 1 else 0.0

    def is_covered(self, acted: TensorDictBase) -> Tensor:
        """Return whether there is such an action in such a state in the data, bool `[B]`."""
        known, most = self._known
        return torch.cdist(self.inputs(acted), known).amin(-1) <= most

    @torch.no_grad()
    def roll_out(self, agent: HierarchicalAgent, tracker: DecisionTracker, starts: Tensor, max_steps: int) -> Rollout:
        """Let an agent act greedily from starts `[N, observation_dim]`, in every member's model."""
        num = self.num_members * len(starts)
        observation = starts.repeat(self.num_members, 1)
        goes_on = torch.ones(num, dtype=torch.float32, device=starts.device)
        total, steps, covered = (torch.zeros_like(goes_on) for _ in range(3))
        begins = torch.ones(num, dtype=torch.bool, device=starts.device)
        last: TensorDictBase | None = None
        for _ in range(max_steps):
            seen = tracker.follow(TensorDict({keys.OBSERVATION: observation}, [num]), last, begins)
            for key in (*agent.choice_keys, *agent.router.state_keys):
                if last is not None and last.get(key, None) is not None:
                    seen.set(key, last.get(key))
            seen.set(keys.DONE, (goes_on < _OVER).unsqueeze(-1))
            with acting(ExplorationType.DETERMINISTIC):
                last = agent.policy(seen)
            last.set(keys.DONE, torch.zeros_like(last.get(keys.DONE)))
            observation, terminating, continuing, ends = self.step(last)
            total += goes_on * (ends * terminating + (1.0 - ends) * continuing)
            steps += goes_on
            covered += goes_on * self.is_covered(last)
            goes_on = goes_on * (1.0 - ends)
            begins = torch.zeros_like(begins)
            if (goes_on < _OVER).all():
                break
        return Rollout(
            total.unflatten(0, (self.num_members, -1)),
            float(steps.mean()),
            float(covered.sum() / steps.sum()),
            float(goes_on.mean()),
        )


def greedy_actions(
    agent: HierarchicalAgent, tracker: DecisionTracker, observation: Tensor, option: Tensor | None = None
) -> TensorDictBase:
    """Return what an agent without a memory does in states, `[B]`.

    Args:
        agent: the agent, which acts greedily.
        tracker: of the agent.
        observation: of the states, `[B, observation_dim]`.
        option: the options that are held there, `[B]`. If None, an episode begins, and the agent chooses.
    """
    num = len(observation)
    begins = torch.ones(num, dtype=torch.bool, device=observation.device)
    seen = tracker.follow(TensorDict({keys.OBSERVATION: observation}, [num]), None, begins)
    with acting(ExplorationType.DETERMINISTIC), torch.no_grad():
        return agent.policy(seen) if option is None else agent.router(seen.set(keys.OPTION, option))


def starts_of(rows: TensorDict, num: int, seed: int) -> tuple[Tensor, np.ndarray | None]:
    """Return the first observations of some recorded episodes `[N, observation_dim]`, and whose they are, if known."""
    firsts = rows[rows[keys.IS_DECISION].squeeze(-1)]
    generator = torch.Generator().manual_seed(seed)
    some = firsts[torch.randperm(len(firsts), generator=generator)[:num].to(rows.device)]
    return some[keys.OBSERVATION], some[PERSON].cpu().numpy() if PERSON in some.keys() else None
