"""Weighted importance sampling: the mean recorded return, weighted by how much likelier an agent makes each episode.

The weight of an episode is the product over its steps of the agent's density of the recorded action, divided by the
density of those who acted. The effective sample size (sum w)^2 / sum w^2 says how many episodes the mean rests on.

The agents act greedily and have no density. A Gaussian around their parameters stands for it, so that an episode counts
if its discrete actions and its option are the agent's and its parameters are near. The density of those who acted is a
clone of theirs, fitted to all transitions, times the option's frequency. This is an approximation where those who
acted chose by the state.

Episodes that a gap or a time limit cut are left out, which favours short successes.

Sources: Precup, Sutton and Singh 2000, *Eligibility Traces for Off-Policy Policy Evaluation*, section 3; Thomas 2015,
*Safe Reinforcement Learning*, section 3.6. The Gaussian: Kallus and Zhou 2018, *Policy Evaluation and Optimization with
Continuous Treatments*, arXiv 1802.06037.
"""

from __future__ import annotations

import math

import torch
from tensordict import TensorDict
from torch import Tensor

from hpamdp import keys
from hpamdp.commands.recorded_problem import greedy_actions
from hpamdp.data.row_checks import TRAJECTORY
from hpamdp.env.decisions import DecisionTracker
from hpamdp.policies.agent import HierarchicalAgent, with_option
from hpamdp.policies.shared.gradients import adam, descend
from hpamdp.policies.shared.hybrid_actor import HybridActor
from hpamdp.policies.shared.hybrid_distribution import HybridDistribution
from hpamdp.specs import PAMDPSpecs

_WIDTH = 0.05  # standard deviation of the Gaussian around an agent's parameters, whose bounds are [-1, 1]
_NUM_UPDATES = 200  # of the clone, which with more learns single rows by heart: the loss on other people rises
_HIDDEN_DIMS, _SCALES = (128, 128), (0.05, 1.0)
_LR, _WEIGHT_DECAY, _BATCH_SIZE = 1e-3, 1e-2, 512


class RecordedEpisodes:
    """The episodes without a gap after their first transition that terminate, and how likely those who acted made them.

    Args:
        specs: of the problem, which forbids no actions.
        rows: the transitions `[M]`, as in `Demonstrations`.

    Attributes:
        rows: the transitions of these episodes, `[W]`.
        returns: of the episodes, `[E]`.
        num_recorded: the number of all episodes.
    """

    def __init__(self, specs: PAMDPSpecs, rows: TensorDict) -> None:
        self.specs = specs
        seen = specs.with_option_observed() if specs.num_options else specs
        actor = HybridActor(seen, _HIDDEN_DIMS, _SCALES, has_values=False).to(rows.device)
        optimizer = adam(_LR, actor, weight_decay=_WEIGHT_DECAY)
        for _ in range(_NUM_UPDATES):
            some = rows[torch.randint(len(rows), (_BATCH_SIZE,), device=rows.device)]
            descend(optimizer, -self._log_density(self._cloned(actor, some), some).mean())
        self.rows = rows[is_whole(rows)]
        self.num_recorded = len(rows[TRAJECTORY].unique())
        last = self.rows["next", keys.DONE].squeeze(-1)
        self.returns = self.rows["next", keys.OPTION_RETURN].squeeze(-1)[last]
        self.number = self.rows[TRAJECTORY].unique(return_inverse=True)[1]
        self.firsts = self.rows[self.rows[keys.IS_DECISION].squeeze(-1)]
        with torch.no_grad():
            self.log_density = self._log_density(self._cloned(actor, self.rows), self.rows)
        self.log_frequency = torch.zeros_like(self.returns)
        if specs.num_options:
            option = self.firsts[keys.OPTION]
            self.log_frequency = (option.bincount() / len(option)).log()[option]

    def estimate(self, agent: HierarchicalAgent, tracker: DecisionTracker) -> tuple[float, float]:
        """Return an agent's weighted mean return, NaN if no episode is like its own, and the effective sample size."""
        if not len(self.returns):
            return math.nan, 0.0
        option = self.rows.get(keys.OPTION, None)
        acted = greedy_actions(agent, tracker, self.rows[keys.OBSERVATION], option)
        specs = self.specs
        unit = specs.to_unit(acted[keys.PARAMETERS], acted)
        is_chosen = specs.components.is_chosen(acted[keys.DISCRETE])
        width = torch.full_like(unit, math.log(_WIDTH))
        owner = specs.parameter_owner.to(unit.device)
        density = HybridDistribution(is_chosen.float().log(), unit, width, owner, specs.components)
        log_ratio = self._log_density(density, self.rows) - self.log_density
        log_weight = (-self.log_frequency).index_add(0, self.number, log_ratio)
        if specs.num_options:
            chosen = greedy_actions(agent, tracker, self.firsts[keys.OBSERVATION])[keys.OPTION]
            log_weight = log_weight.masked_fill(chosen != self.firsts[keys.OPTION], -torch.inf)
        return weighted_mean(log_weight, self.returns)

    def _cloned(self, actor: HybridActor, rows: TensorDict) -> HybridDistribution:
        shown = with_option(rows, self.specs.num_options) if self.specs.num_options else rows
        return actor(shown[keys.OBSERVATION])

    def _log_density(self, distribution: HybridDistribution, rows: TensorDict) -> Tensor:
        """Return the log-densities of the rows' actions, `[B]`."""
        unit = self.specs.to_unit(rows[keys.PARAMETERS], rows)
        discrete, own = distribution.log_prob(rows[keys.DISCRETE], unit)
        return self.specs.components.total(discrete) + self.specs.components.total(own)


def is_whole(rows: TensorDict) -> Tensor:
    """Return which transitions `[M]` are of episodes without a gap after the first one that terminate, bool `[M]`."""
    episode = rows[TRAJECTORY]
    is_fine = rows["next", keys.TERMINATED].squeeze(-1).clone()
    meets = torch.isclose(rows["next", keys.OBSERVATION][:-1], rows[keys.OBSERVATION][1:], atol=1e-4).all(-1)
    is_fine[:-1] |= meets & (episode[:-1] == episode[1:])
    return ~torch.isin(episode, episode[~is_fine])


def weighted_mean(log_weight: Tensor, values: Tensor) -> tuple[float, float]:
    """Return the weighted mean of values `[E]`, NaN if all weights are 0, and the effective sample size."""
    if not log_weight.isfinite().any():
        return math.nan, 0.0
    weight = log_weight.double().softmax(0)
    return float((weight * values).sum()), float(1.0 / weight.square().sum())
