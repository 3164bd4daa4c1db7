#!/usr/bin/env bash
# TorchRL 0.14.1: ClipPPOLoss clips the product of the probability ratios of a composite action, not each of them.
#
# Guess: each head's ratio is clipped by itself, as its example examples/agents/composite_ppo.py says: "ClipPPO will clip
# individual weights (not the aggregate)". So a head whose ratio is 2 gets no gradient from a positive advantage.
# Behaviour: the log-ratios of all heads are added, and their sum is clipped.
# Seen: with ratios of 2 and 0.5, whose product is 1, nothing is clipped, and both heads get a gradient. With ratios of 2
# and 1 neither gets one, though the second head's ratio is inside the limits.
# The script fails if this changes.
# Why it matters: a choice and its number hold each other back, or hide each other, and the more heads, the more is
# clipped.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv --without-pip "$folder/venv"
python3 -m pip --python "$folder/venv/bin/python" install --quiet --disable-pip-version-check torch==2.13.0 torchrl==0.14.1
"$folder/venv/bin/python" -W ignore - <<'PYTHON'
import math
import sys

import torch
from tensordict import TensorDict
from tensordict.nn import CompositeDistribution, TensorDictModule, set_composite_lp_aggregate
from torch import nn
from torch.distributions import Categorical
from torchrl.modules import ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss

set_composite_lp_aggregate(False).set()


class Heads(nn.Module):
    """Two heads of two equally probable actions each."""

    def __init__(self):
        super().__init__()
        self.first, self.second = nn.Parameter(torch.zeros(2)), nn.Parameter(torch.zeros(2))

    def forward(self, observation):
        return self.first.expand(len(observation), 2), self.second.expand(len(observation), 2)


def gradients(*ratios):
    """Return whether the heads get a gradient where these are their ratios of new and old probability."""
    heads = Heads()
    actor = ProbabilisticActor(
        TensorDictModule(heads, ["observation"], [("params", "first", "logits"), ("params", "second", "logits")]),
        in_keys=["params"],
        distribution_class=CompositeDistribution,
        distribution_kwargs={"distribution_map": {"first": Categorical, "second": Categorical}},
        return_log_prob=True,
    )
    loss = ClipPPOLoss(actor, ValueOperator(nn.Linear(1, 1), ["observation"]), clip_epsilon=0.2, entropy_bonus=False)
    old = [torch.tensor([math.log(0.5 / ratio)]) for ratio in ratios]
    row = {"observation": torch.zeros(1, 1), "advantage": torch.ones(1, 1), "value_target": torch.zeros(1, 1)}
    row |= {"first": torch.zeros(1, dtype=torch.long), "second": torch.zeros(1, dtype=torch.long)}
    row |= {"first_log_prob": old[0], "second_log_prob": old[1]}
    loss(TensorDict(row, [1]))["loss_objective"].backward()
    return [bool(head.grad is not None and head.grad.abs().sum() > 0) for head in (heads.first, heads.second)]


seen = {ratios: gradients(*ratios) for ratios in ((2.0, 0.5), (2.0, 1.0), (1.0, 1.0))}
for ratios, moved in seen.items():
    print("ratios", ratios, "heads with a gradient:", moved)
sys.exit(list(seen.values()) != [[True, True], [False, False], [True, True]])
PYTHON
