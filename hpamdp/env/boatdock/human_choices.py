"""The probability that people choose each controller in a layout."""

from __future__ import annotations

import torch
from torch import Tensor
from torchrl.data import Bounded, Composite

from hpamdp.env.boatdock import harbour
from hpamdp.env.boatdock.reference import HUMAN_CONGRUENT_BY_OFFSET, OFFSET_EDGES
from hpamdp.env.boatdock.task import BoatState


def human_spec(num_envs: int, device: torch.device) -> Composite:
    """Return the spec of `choice_probabilities`, as the entry `option`."""
    shape = (num_envs, len(harbour.CONTROLLERS))
    probabilities = Bounded(0.0, 1.0, shape=shape, device=device, dtype=torch.float32)
    return Composite(option=probabilities, shape=(num_envs,))


def choice_probabilities(state: BoatState) -> Tensor:
    """Return the probabilities that people choose the incongruent and the congruent controller, `[N, 2]`.

    They depend on the bearing offset of the layout.
    """
    layout = harbour.Layout(state.start_x, state.start_y, state.goal_x, state.goal_y)
    offset = harbour.bearing_offset(layout)
    bins = torch.bucketize(offset, offset.new_tensor(OFFSET_EDGES[1:-1]))
    congruent = offset.new_tensor(HUMAN_CONGRUENT_BY_OFFSET)[bins]
    return torch.stack([1.0 - congruent, congruent], -1)
