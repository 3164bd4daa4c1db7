"""What a policy remembers of the observations of its history, and where that history begins.

The state of a memory is one vector `[*B, size]` in the tensordict. In a step it is the state after that step's
observation. Zeros are a fresh memory, which has seen nothing.

Sources: Mnih et al. 2015, *Human-level control through deep reinforcement learning*, Nature 518 (stacked observations);
Cho et al. 2014, arXiv 1406.1078 (GRU); Hausknecht and Stone 2015, *Deep Recurrent Q-Learning for Partially Observable
MDPs*, arXiv 1507.06527; Kapturowski et al. 2019, *Recurrent Experience Replay in Distributed Reinforcement Learning*
(R2D2: stored states and burn-in). The policy of an option may depend on what happened since the option began: Sutton,
Precup and Singh 1999, *Between MDPs and semi-MDPs*, section 2.

TorchRL's GRUModule does not fit: it writes the next state under `next`, where neither the router of the options nor
`Agent.act` looks for what a policy carries from step to step.
"""

from __future__ import annotations

from typing import Annotated, Literal

import torch
from pydantic import Field, NonNegativeInt, PositiveInt, model_validator
from torch import Tensor, nn
from typing_extensions import Self

from hpamdp.policies.shared.sized_by_data import SizedByData
from hpamdp.settings import Settings

MemoryKind = Literal["none", "stack", "gru"]


class MemoryOptions(Settings):
    """Settings of a memory."""

    memory: MemoryKind = "none"
    """What the networks see beside the observation: nothing, the observations before it, or the state of a GRU."""
    memory_size: PositiveInt = 64
    """With `memory=gru`: numbers in its state."""
    stack_steps: Annotated[int, Field(ge=2, le=1000)] = 4
    """With `memory=stack`: observations that the networks see, with the present one; zeros before the first."""
    sequence_length: PositiveInt = 16
    """With `memory=gru`: steps through which gradients flow back in time."""

    @model_validator(mode="after")
    def _check_memory(self) -> Self:
        for name in ("vector_products", "augment"):  # what a problem declares of its observation, not of its features
            if self.memory != "none" and getattr(self, name, False) is True:
                raise ValueError(f"{name}=true: does not go with memory={self.memory}; use {name}=false or memory=none")
        return self


class ReplayMemoryOptions(MemoryOptions):
    """Settings of a memory that learns from a replay buffer."""

    burn_in: NonNegativeInt = 8
    """With `memory=gru`: further steps before these, from which today's networks compute the state to begin with."""


class Stack(nn.Module):
    """The last observations side by side, the oldest first; zeros where the history is shorter.

    Args:
        num_inputs: entries of an observation.
        num_steps: how many observations.

    Attributes:
        size: entries of the state.
        num_features: entries of the features, which are the state.
        name: of its state in a tensordict.
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


class GRU(nn.Module):
    """A gated recurrent unit; the features are its state and the observation.

    Args:
        num_inputs: entries of an observation.
        size: entries of the state.

    Attributes:
        size: entries of the state.
        num_features: entries of the features.
        name: of its state in a tensordict.
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

    def unrolled(self, seen: Tensor, held: Tensor) -> Tensor:
        """Return the states `[N, L, size]` after each of observations `[N, L, num_inputs]`, given those before."""
        # Also where matrix products are computed in bfloat16: errors would add up over the steps.
        with torch.autocast(seen.device.type, enabled=False):
            states: Tensor = self.net(seen.float(), held.unsqueeze(0).contiguous())[0]
        return states


class HistoryLinks(SizedByData):
    """Says which stored row precedes each row in the same history, so that sequences can be followed backwards.

    Rows are numbered as they are stored, from 0. A history may span several batches, and never leaves its environment.

    Attributes:
        last_rows: number of the row that each environment stored last, if its history may go on, else -1.
    """

    last_rows: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("last_rows", torch.zeros(0, dtype=torch.long))

    def forward(self, begins: Tensor, mask: Tensor, num_stored: int) -> Tensor:
        """Return the numbers `[*B, T]` of the rows before the rows of a batch; -1 if there is none.

        Args:
            begins: where a history begins, bool `[*B, T]`.
            mask: the rows that are now stored, in this order, bool `[*B, T]`.
            num_stored: how many rows were stored before, now forgotten ones included.
        """
        own = mask.flatten(0, -2)
        numbers = (num_stored - 1 + own.flatten().cumsum(0)).reshape(own.shape)
        numbers = torch.where(own, numbers, -1)
        if self.last_rows.shape != numbers.shape[:1] or num_stored == 0:
            self.last_rows = torch.full_like(numbers[:, 0], -1)
        # A row that is yet to be stored is of a buffer that was given up.
        first = torch.where(self.last_rows < num_stored, self.last_rows, -1)
        previous = torch.cat([first.unsqueeze(-1), numbers[:, :-1]], -1)
        self.last_rows = numbers[:, -1].clone()
        return torch.where(begins, -1, previous.reshape(mask.shape))


def ancestors(newest: Tensor, previous: Tensor, num_stored: int, num_steps: int) -> tuple[Tensor, Tensor]:
    """Follow histories backwards from rows of a ring buffer.

    Args:
        newest: numbers of the rows to begin with, `[N]`.
        previous: `HistoryLinks` of the rows in the buffer, by their places, `[len(buffer)]`.
        num_stored: how many rows were stored in all; a full buffer holds the last `len(previous)` of them.
        num_steps: the most rows to find, with the first.

    Returns:
        The places of the rows in the buffer, int64 `[N, num_steps]`, the oldest first and padded behind, and how many
        there are, `[N]`.
    """
    capacity = len(previous)
    oldest = num_stored - capacity
    numbers = [newest]
    for _ in range(num_steps - 1):
        number = numbers[-1]
        before = previous[number.clamp(min=0) % capacity]
        is_there = (number >= 0) & (before >= oldest) & (before < number)
        numbers.append(torch.where(is_there, before, -1))
    backwards = torch.stack(numbers, -1)
    length = (backwards >= 0).sum(-1)
    order = length.unsqueeze(-1) - 1 - torch.arange(num_steps, device=newest.device)
    return backwards.gather(-1, order.clamp(min=0)) % capacity, length
