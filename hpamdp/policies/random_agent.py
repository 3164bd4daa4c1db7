"""The uniformly random agent."""

from __future__ import annotations

import torch

from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.policies.high_level.uniform import Uniform
from hpamdp.policies.low_level.random import Random
from hpamdp.specs import PAMDPSpecs


def random_agent(specs: PAMDPSpecs, device: torch.device) -> HierarchicalAgent:
    """Return the uniformly random agent, the reference "random" of every table and figure.

    Options, discrete actions and parameters are uniform and independent of the observation.

    Args:
        specs: of the problem; if it has no options, the agent has no selector.
        device: where the agent acts.
    """
    selector = Uniform(specs) if specs.num_options > 0 else None
    return HierarchicalAgent(selector, [Random(specs)], specs).to(device)
