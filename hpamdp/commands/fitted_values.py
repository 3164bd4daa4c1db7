"""Fitted Q evaluation: fit the value of an agent's actions to recorded transitions.

The value Q(s, k, x) of discrete action k with its own parameters x is fitted to r + Q(s', k', x'). There k' and x' are
what the agent does greedily in s', under the option that was held. If the step terminated, the target is r alone. A
time limit does not terminate. Nothing is discounted.

Source: Le, Voloshin and Yue 2019, *Batch Policy Learning under Constraints*, arXiv 1903.08738, algorithm 3.

Differs from the source:
- a target network that follows slowly replaces the regression to the end for each new target;
- two networks are fitted, and their mean counts;
- Q sees what the ensemble of `RecordedProblem` sees. If the problem declares its geometry, states are turned until the
  discrete action points along +x. This biases the value of an agent that acts differently in turned states.

FQE in d3rlpy and SCOPE-RL takes discrete or continuous actions, not both in one.
"""

from __future__ import annotations

import copy

import torch
from tensordict import TensorDict
from torch import Tensor

from hpamdp import keys
from hpamdp.commands.recorded_problem import RecordedProblem, greedy_actions
from hpamdp.env.decisions import DecisionTracker
from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.policies.shared.gradients import adam, descend
from hpamdp.policies.shared.networks import EnsembleMLP, polyak_update

_NUM_NETWORKS, _HIDDEN_DIMS = 2, (64, 64)
_LR, _BATCH_SIZE = 1e-3, 256
_TAU = 0.01  # fraction of the way that the target network moves at each update


def fitted_values(
    problem: RecordedProblem,
    rows: TensorDict,
    agent: HierarchicalAgent,
    tracker: DecisionTracker,
    starts: Tensor,
    num_updates: int,
) -> Tensor:
    """Return the values of an agent's own first actions in starts `[N, observation_dim]`, `[N]`.

    Args:
        problem: knows what networks see of the rows.
        rows: the transitions `[M]`, as in `Demonstrations`.
        agent: without a memory; its options last a whole episode.
        tracker: of the agent.
        starts: the first states.
        num_updates: updates of the networks.
    """
    reward, goes_on = rows["next", keys.REWARD].squeeze(-1), ~rows["next", keys.TERMINATED].squeeze(-1)
    acted = greedy_actions(agent, tracker, rows["next", keys.OBSERVATION], rows.get(keys.OPTION, None))
    now, following = problem.inputs(rows), problem.inputs(acted)
    networks = EnsembleMLP(_NUM_NETWORKS, now.shape[-1], _HIDDEN_DIMS, 1).to(now.device)
    targets = copy.deepcopy(networks).requires_grad_(False)
    optimizer = adam(_LR, networks)
    for _ in range(num_updates):
        some = torch.randint(len(rows), (_BATCH_SIZE,), device=now.device)
        target = reward[some] + goes_on[some] * targets(following[some]).squeeze(-1)
        descend(optimizer, (networks(now[some]).squeeze(-1) - target).square().mean(-1).sum())
        polyak_update(targets, networks, _TAU)
    with torch.no_grad():
        return networks(problem.inputs(greedy_actions(agent, tracker, starts))).squeeze(-1).mean(0)
