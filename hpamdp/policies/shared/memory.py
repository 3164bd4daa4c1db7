"""What a policy remembers of earlier observations: the last few, or the state of a GRU.

The state of a memory is one vector `[*B, size]` in the tensordict. In a step it is the state after that step's
observation. An empty memory, which has seen nothing, is zeros.

Sources: Mnih et al. 2015, *Human-level control through deep reinforcement learning*, Nature 518 (stacked observations);
Cho et al. 2014, arXiv 1406.1078 (GRU); Hausknecht and Stone 2015, *Deep Recurrent Q-Learning for Partially Observable
MDPs*, arXiv 1507.06527; Kapturowski et al. 2019, *Recurrent Experience Replay in Distributed Reinforcement Learning*
(R2D2: stored states and burn-in). The policy of an option may depend on what happened since the option began: Sutton,
Precup and Singh 1999, *Between MDPs and semi-MDPs*, section 2.

TorchRL's GRUModule does not fit: it writes the next state under `next`. Neither the router of the options nor
`Agent.act` looks there for what a policy carries from step to step.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn


class Stack(nn.Module):
    """The last observations side by side, the oldest first; zeros where the history is shorter.

    Args:
        num_inputs: entries of an observation.
        num_steps: how many observations.

    Attributes:
        size: entries of the state.
        num_features: entries of the features, which are the state.
        name: key of its state in a tensordict.
    """

    is_recurrent = False

    def __init__(self, num_inputs: int, num_steps: int) -> None:
        super().__init__()
        self.num_inputs = num_inputs
        self.size = self.num_features = num_inputs * num_steps
        self.name = f"stack_{self.size}"

    def step(self, seen: Tensor, held: Tensor) -> Tensor:
        """Return the states `[N, size]` after observations `[N, num_inputs]`, given the states before."""
        return torch.cat([held[..., self.num_inputs :], seen], -1)

    def features(self, seen: Tensor, state: Tensor) -> Tensor:
        """Return the features `[N, num_features]` of observations and the states after them."""
        return state

    def state_in(self, features: Tensor) -> Tensor:
        """Return the states `[N, size]` of which features `[N, num_features]` were made."""
        return features


class GRU(nn.Module):
    """A gated recurrent unit; the features are its state and the observation.

    Args:
        num_inputs: entries of an observation.
        size: entries of the state.

    Attributes:
        size: entries of the state.
        num_features: entries of the features.
        name: key of its state in a tensordict.
    """

    is_recurrent = True

    def __init__(self, num_inputs: int, size: int) -> None:
        super().__init__()
        self.size = size
        self.num_features = size + num_inputs
        self.name = f"gru_{size}"
        self.net = nn.GRU(num_inputs, size, batch_first=True, dtype=torch.float32)

    def step(self, seen: Tensor, held: Tensor) -> Tensor:
        """Return the states `[N, size]` after observations `[N, num_inputs]`, given the states before."""
        return self.unrolled(seen.unsqueeze(1), held).squeeze(1)

    def features(self, seen: Tensor, state: Tensor) -> Tensor:
        """Return the features `[N, num_features]` of observations and the states after them."""
        return torch.cat([state, seen], -1)

    def state_in(self, features: Tensor) -> Tensor:
        """Return the states `[N, size]` of which features `[N, num_features]` were made."""
        return features[..., : self.size]

    def unrolled(self, seen: Tensor, held: Tensor) -> Tensor:
        """Return the states `[N, L, size]` after each of the observations `[N, L, num_inputs]`.

        Args:
            seen: the observations.
            held: the states before the first ones, `[N, size]`.
        """
        # In float32 even if matrix products are computed in bfloat16: errors would add up over the steps.
        with torch.autocast(seen.device.type, enabled=False):
            states: Tensor = self.net(seen.float(), held.unsqueeze(0).contiguous())[0]
        return states
