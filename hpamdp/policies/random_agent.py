"""The uniformly random agent."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.policies.high_level.uniform import Uniform
from hpamdp.policies.low_level.random import Random
from hpamdp.specs import PAMDPSpecs


def random_agent(specs: PAMDPSpecs, device: torch.device, option_lengths: Sequence[int] = ()) -> HierarchicalAgent:
    """Return the uniformly random agent, the reference "random" of every table and figure.

    Options, their lengths, allowed discrete actions and parameters are uniform.

    Args:
        specs: of the problem; if it has no options, the agent has no selector.
        device: where the agent acts.
        option_lengths: the lengths of options, if they are chosen.
    """
    selector_specs = specs.with_option_lengths(option_lengths) if option_lengths else specs
    selector = Uniform(selector_specs) if specs.num_options > 0 else None
    is_shared = specs.option_actions is not None
    learner = Random(specs.with_option_observed() if is_shared else specs)
    return HierarchicalAgent(selector, [learner], specs, is_shared, option_lengths=option_lengths).to(device)
