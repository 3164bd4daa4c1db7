"""Sequences of steps, or of decisions, from which a recurrent memory learns.

Source: Kapturowski et al. 2019, *Recurrent Experience Replay in Distributed Reinforcement Learning* (R2D2), section 3:
stored states and burn-in.

Differs from the source:
- each stored row is drawn with the same probability, not sequences by their priority;
- in replay only the last row of a sequence has a loss, not all rows after the burn-in.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.data import ReplayBuffer

from hpamdp.policies.shared.perception import Perception
from hpamdp.policies.shared.sized_by_data import SizedByData


def sequence_starts(begins: Tensor, mask: Tensor, length: int) -> Tensor:
    """Return where sequences start among the rows in a mask, bool `[N]`.

    Sequences start where a history or the batch begins, and then after every `length` rows.

    Args:
        begins: where a history begins, bool `[*B, T]`.
        mask: the rows, bool `[*B, T]`.
        length: the most rows of a sequence.
    """
    own = mask.flatten(0, -2)
    number = torch.arange(len(own), device=mask.device).unsqueeze(-1)
    environment = number.expand_as(own)[own]
    continues = ~begins[mask]
    continues[:1] = False
    continues[1:] &= environment[1:] == environment[:-1]
    place = torch.arange(len(continues), device=mask.device)
    # Of each row, the place of the first row of its history in this batch.
    first = torch.where(continues, 0, place).cummax(0).values
    return (place - first) % length == 0


class HistoryLinks(SizedByData):
    """Says which stored row precedes each row in the same history, so that sequences can be followed backwards.

    Rows are numbered as they are stored, from 0. A history may span several batches, and never leaves its environment.

    Attributes:
        last_rows: number of the row that each environment stored last, or -1.
    """

    def __init__(self) -> None:
        super().__init__()
        self.last_rows: Tensor = nn.Buffer(torch.zeros(0, dtype=torch.long))

    def forward(self, begins: Tensor, mask: Tensor, num_stored: int) -> Tensor:
        """Return the number of the row before each row of a batch, `[*B, T]`; -1 for the first row of a history.

        Args:
            begins: where a history begins, bool `[*B, T]`.
            mask: the rows that are now stored, in this order, bool `[*B, T]`.
            num_stored: how many rows were stored before, including those that have been overwritten.
        """
        own = mask.flatten(0, -2)
        numbers = (num_stored - 1 + own.flatten().cumsum(0)).reshape(own.shape)
        numbers = torch.where(own, numbers, -1)
        if self.last_rows.shape != numbers.shape[:1] or num_stored == 0:
            self.last_rows = torch.full_like(numbers[:, 0], -1)
        # A number beyond the stored rows belongs to an earlier buffer, which this one replaced.
        first = torch.where(self.last_rows < num_stored, self.last_rows, -1)
        newest = torch.cat([first.unsqueeze(-1), numbers], -1).cummax(-1).values
        self.last_rows = newest[:, -1].clone()
        previous = newest[:, :-1].reshape(mask.shape)
        return torch.where(begins, -1, previous)


def ancestors(newest: Tensor, previous: Tensor, num_stored: int, num_steps: int) -> tuple[Tensor, Tensor]:
    """Follow histories backwards from rows of a ring buffer.

    Args:
        newest: numbers of the rows to begin with, `[N]`.
        previous: numbers by `HistoryLinks` of the rows in the buffer, by their places, `[len(buffer)]`.
        num_stored: how many rows were stored in all; a full buffer holds the last `len(previous)` of them.
        num_steps: the most rows to find, including the first one.

    Returns:
        The places of the rows in the buffer, int64 `[N, num_steps]`, the oldest first and padded at the end, and how
        many there are, `[N]`.
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


def sample_with_past(buffer: ReplayBuffer, num: int, num_steps: int) -> TensorDict:
    """Return random rows `[num]` of a buffer, each with the rows before it in its history, see `past_of`.

    Each row is drawn with the same probability, and its sequence ends with it. TorchRL's SliceSampler draws histories
    with the same probability instead, so it would learn too seldom from the last step of a long one.

    Args:
        buffer: has the columns `state`, `memory`, `begins`, and `previous` of `HistoryLinks`.
        num: how many rows.
        num_steps: the most rows of a sequence.
    """
    stored = buffer[:]
    place = torch.randint(len(stored), (num,), device=stored["previous"].device)
    sample: TensorDict = stored[place]
    return sample.update(past_of(buffer, place, num_steps))


def past_of(buffer: ReplayBuffer, place: Tensor, num_steps: int) -> TensorDict:
    """Return the sequences that end with the rows at places `[N]` of a buffer.

    Args:
        buffer: as in `sample_with_past`.
        place: of the last rows of the sequences.
        num_steps: the most rows of a sequence.

    Returns:
        `past`, the states of the sequence `[N, num_steps, *]`, padded at the end; `num_past`, how many there are; and
        `first_memory` and `first_begins`, the entries of the sequence's first row.
    """
    stored, num_stored = buffer[:], buffer.write_count
    # The number of the row at a place: the largest one below `num_stored` that the ring buffer keeps there.
    newest = num_stored - 1 - (num_stored - 1 - place) % len(stored)
    places, num_past = ancestors(newest, stored["previous"], num_stored, num_steps)
    first = {f"first_{name}": stored[name][places[:, 0]] for name in ("memory", "begins")}
    return TensorDict({"past": stored["state"][places], "num_past": num_past, **first}, [len(place)])


def states_of_past(sample: TensorDictBase, perception: Perception, burn_in: int) -> Tensor:
    """Return a recurrent memory's states `[B, size]` after the sequences of `sample_with_past`.

    A sequence starts from the stored state of its first row, or from an empty memory if the history begins there. The
    gradient flows through the last rows, at most `num_steps - burn_in` of them. The rows before these have none.

    Args:
        sample: the rows, `[B]`.
        perception: has the memory.
        burn_in: rows without a gradient in the longest sequences.
    """
    past, num_past = sample["past"], sample["num_past"]
    length = past.shape[1] - burn_in
    is_fresh = sample["first_begins"]
    held = torch.where(is_fresh.unsqueeze(-1), 0.0, sample["first_memory"])
    has_seen = ~is_fresh
    num_burnt = (num_past - length).clamp(min=0)
    if burn_in > 0:
        with torch.no_grad():
            burnt = perception.states(past[:, :burn_in], held, has_seen)
        is_burnt = num_burnt > 0
        held = torch.where(is_burnt.unsqueeze(-1), _at(burnt, (num_burnt - 1).clamp(min=0)), held)
        has_seen = has_seen & ~is_burnt
    places = num_burnt.unsqueeze(-1) + torch.arange(length, device=past.device)
    places = places.clamp(max=past.shape[1] - 1)
    recent = past.gather(1, places.unsqueeze(-1).expand(-1, -1, past.shape[-1]))
    return _at(perception.states(recent, held, has_seen), num_past - num_burnt - 1)


def _at(states: Tensor, place: Tensor) -> Tensor:
    """Return the states `[B, size]` at places `[B]` of sequences `[B, L, size]`."""
    return states[torch.arange(len(place), device=place.device), place]
