"""The uniformly random agent."""

from __future__ import annotations

import torch

from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.policies.high_level.uniform import Uniform
from hpamdp.policies.low_level.random import Random
from hpamdp.specs import PAMDPSpecs


def random_agent(specs: PAMDPSpecs, device: torch.device) -> HierarchicalAgent:
    """Return the uniformly random agent, the reference "random" of every table and figure.

    Options, allowed discrete actions and parameters are uniform.

    Args:
        specs: of the problem; if it has no options, the agent has no selector.
        device: where the agent acts.
    """
    selector = Uniform(specs) if specs.num_options > 0 else None
    if specs.option_actions is None:
        return HierarchicalAgent(selector, [Random(specs)], specs).to(device)
    return HierarchicalAgent(selector, [Random(specs.with_option_observed())], specs, is_shared=True).to(device)
