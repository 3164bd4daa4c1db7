"""The uniformly random agent: the reference `random` of every table and figure."""

from __future__ import annotations

import torch

from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.policies.high_level.uniform import Uniform
from hpamdp.policies.low_level.random import Random
from hpamdp.specs import PAMDPSpecs


def random_agent(specs: PAMDPSpecs, device: torch.device) -> HierarchicalAgent:
    """Return an agent whose options, discrete actions and parameters are uniformly random."""
    selector = Uniform(specs) if specs.num_options else None
    return HierarchicalAgent(selector, [Random(specs)], specs).to(device)
