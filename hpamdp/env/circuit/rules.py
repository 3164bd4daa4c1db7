"""What circuits are designed for: the tasks, their targets, and the state. The rules of a step are in `kernel`.

Source: Altmann et al. 2023, *Challenges for Reinforcement Learning in Quantum Circuit Design*, arXiv:2312.11337. Gates,
tasks and rewards are those of its package qcd-gym 0.2.0.
Differs from the source:
- An action is a discrete one with an angle. There it is a box of four numbers, three of which are rounded down.
- Every episode has a new random target, unless `target_number` says otherwise. There a run has one target.
- A circuit of full depth terminates the episode. There it truncates it, with the same reward.
- The rewards `progress` and `gain` are new here; the score is the source's.
- The native gate sets are new here. Their costs take the place of the cost of depth.
- Training episodes may begin within the known circuit, or near the target (Florensa et al. 2017, *Reverse Curriculum
  Generation for Reinforcement Learning*, arXiv:1707.05300).
"""

from __future__ import annotations

import math
from collections import namedtuple
from dataclasses import dataclass
from functools import cache, cached_property
from typing import NamedTuple, Protocol, get_args

import torch
from torch import Tensor

from hpamdp.env import counter_rng
from hpamdp.env.batched_env import EpisodeColumns
from hpamdp.env.circuit.gates import Gate
from hpamdp.env.circuit.options import RewardName, TaskName
from hpamdp.env.counter_rng import RngKey

TASKS: tuple[TaskName, ...] = get_args(TaskName)
REWARDS: tuple[RewardName, ...] = get_args(RewardName)
OUTCOMES = ("building", "matched", "missed", "time limit")
BUILDING, MATCHED, MISSED, TIME_LIMIT = range(4)
MATCH = 0.99  # similarity from which on a finished circuit matches its target
# Fraction of training circuits that may lack any number of gates, whatever `begin_episodes` says. Without them the
# policy would grow sure of its actions in states that it has not met, and would no longer explore once it meets them.
ANY_BEGINNING = 0.25
NEAR_TARGET = 1000  # first of the random numbers of a circuit that begins near its target; targets take lower ones


class Task(NamedTuple):
    """A task of the source.

    Attributes:
        n: number of wires (qubits).
        depth: depth at which a circuit is full.
        is_operator: whether the target is an operator instead of a state.
    """

    n: int
    depth: int
    is_operator: bool


TASK_OF = {
    "hadamard": Task(1, 9, True),
    "random_state": Task(2, 12, False),
    "bell": Task(2, 12, False),
    "ghz": Task(3, 15, False),
    "random_unitary": Task(2, 12, True),
    "toffoli": Task(3, 63, True),
}


class CircuitState(EpisodeColumns, Protocol):
    """The state of N environments, columns `[N]`.

    The first float columns are what the source observes: the real parts of the circuit's state or operator, row by row,
    its imaginary parts, then both of the target. `similarity`, `cost` and `angle` follow. The integer columns begin
    with the depth of each wire.
    """

    similarity: Tensor
    cost: Tensor
    angle: Tensor  # of the last gate
    gate_set: Tensor  # number of the set in use
    gate: Tensor  # last discrete action; -1 before the first


@dataclass(frozen=True)
class Design:
    """What the settings say of circuits.

    Attributes:
        task: sizes of the task.
        gate_sets: the sets that an option stands for; one set if there is no choice.
        target: the target of all episodes, complex128 `[2^n, 1]` or `[2^n, 2^n]`; None if each episode has its own.
        is_native: whether gates cost instead of depth.
        reward: what is rewarded; see `CircuitOptions`.
        floor: score that `gain` counts from; None for that of no gates.
        observes_depth: whether the depths of the wires are observed.
        beginnings: circuits that training episodes begin with, and the depths of their wires, complex64 `[B, R, C]`
            and int32 `[B, n]`; None if they begin without gates.
        begin_episodes: episodes of an environment after which training circuits may lack one gate more; 0 if they may
            lack any number from the start.
        begin_gates: most random gates after the target that training episodes begin with; 0 if they do not.
    """

    task: Task
    gate_sets: tuple[tuple[Gate, ...], ...]
    target: Tensor | None
    is_native: bool
    reward: RewardName
    floor: float | None
    observes_depth: bool
    beginnings: tuple[Tensor, Tensor] | None = None
    begin_episodes: int = 0
    begin_gates: int = 0

    @property
    def num_rows(self) -> int:
        """Number of rows of states and operators."""
        return 1 << self.task.n

    @property
    def num_columns(self) -> int:
        """Number of columns: 1 for a state, as many as rows for an operator."""
        return self.num_rows if self.task.is_operator else 1

    @property
    def num_numbers(self) -> int:
        """Number of entries of a state or an operator."""
        return self.num_rows * self.num_columns

    @cached_property
    def entry_names(self) -> tuple[str, ...]:
        """Names of what the source observes."""
        n = self.task.n
        labels = [f"{row:0{n}b}" for row in range(self.num_rows)]
        places = [f"{row}_{column}" for row in labels for column in labels] if self.task.is_operator else labels
        kind = "operator" if self.task.is_operator else "state"
        return tuple(f"{of}_{part}_{place}" for of in (kind, "target") for part in ("re", "im") for place in places)

    @cached_property
    def state_type(self) -> type[CircuitState]:
        """The class of the states."""
        return _state_type(self.entry_names, self.task.n)


@cache
def _state_type(entries: tuple[str, ...], n: int) -> type[CircuitState]:
    levels = (f"depth_{wire}" for wire in range(n))
    names = (*entries, "similarity", "cost", "angle", *levels, "gate_set", "gate", "steps", "outcome", "episode")
    return namedtuple("CircuitState", names)  # type: ignore[return-value]


def fixed_target(name: str) -> Tensor | None:
    """Return the target of a task, complex128 `[2^n, 1]` or `[2^n, 2^n]`; None if it is random."""
    n = TASK_OF[name].n
    num = 1 << n
    if name == "hadamard":
        return torch.tensor([[1.0, 1.0], [1.0, -1.0]], dtype=torch.complex128) / math.sqrt(2.0)
    if name == "toffoli":
        # Wires 0 and 1 control wire 2.
        return torch.eye(num, dtype=torch.complex128)[[0, 1, 2, 7, 4, 5, 6, 3]]
    if name in ("bell", "ghz"):
        target = torch.zeros(num, 1, dtype=torch.complex128)
        target[0] = target[-1] = math.sqrt(0.5)
        return target
    return None


def random_target(rng: RngKey, task: Task) -> Tensor:
    """Return uniformly random states, complex128 `[N, 2^n, 1]`, or operators, `[N, 2^n, 2^n]`.

    The columns of a complex normal matrix are made orthonormal one after another, which gives the Haar measure.
    """
    num = 1 << task.n
    columns: list[Tensor] = []
    for column in range(num if task.is_operator else 1):
        numbers = [[counter_rng.normal(rng, 2 * (column * num + row) + part) for row in range(num)] for part in (0, 1)]
        real, imaginary = (torch.stack(part, -1).double() for part in numbers)
        drawn = torch.complex(real, imaginary)
        for earlier in columns:
            drawn = drawn - (earlier.conj() * drawn).sum(-1, keepdim=True) * earlier
        columns.append(drawn / drawn.norm(dim=-1, keepdim=True))
    return torch.stack(columns, -1)


def without_gates(design: Design, device: torch.device) -> Tensor:
    """Return the state or operator of a circuit without gates, complex64 `[R, C]`."""
    empty = torch.zeros(design.num_rows, design.num_columns, dtype=torch.complex64, device=device)
    return empty.fill_diagonal_(1.0)


def circuit_and_target(state: CircuitState, design: Design) -> tuple[Tensor, Tensor]:
    """Return the circuits' states or operators and the targets, complex64 `[N, R, C]`."""
    num = design.num_numbers
    parts = torch.stack([*state][: 4 * num], -1).reshape(-1, 4, design.num_rows, design.num_columns)
    return torch.complex(parts[:, 0], parts[:, 1]), torch.complex(parts[:, 2], parts[:, 3])


def similarity(made: Tensor, target: Tensor, design: Design) -> Tensor:
    """Return how well circuits match their targets, `[N]`: 1 is the best.

    For states it is the fidelity, for operators 1 - 2 arctan(Frobenius norm of the difference) / pi.
    """
    if design.task.is_operator:
        distance = (made - target).abs().square().sum((-2, -1)).sqrt()
        return 1.0 - 2.0 * distance.atan() / math.pi
    return (made.conj() * target).sum((-2, -1)).abs().square().clamp(max=1.0)
