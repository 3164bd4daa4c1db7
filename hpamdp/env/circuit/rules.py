"""The rules of circuit design as pure functions on columns: tasks, gates, fidelity, depth and reward.

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
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import NamedTuple, Protocol, get_args

import torch
from torch import Tensor

from hpamdp.env import counter_rng
from hpamdp.env.batched_env import EpisodeColumns
from hpamdp.env.circuit import gates
from hpamdp.env.circuit.gates import Gate
from hpamdp.env.circuit.options import RewardName, TaskName
from hpamdp.env.counter_rng import RngKey
from hpamdp.env.state_columns import replaced

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
        max_steps: steps after which a circuit is finished.
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
    max_steps: int
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

    @cached_property
    def tables(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """What gates do, `[S K, ...]`: matrices, factors of the angle, fixed angles, taken wires and costs."""
        every = [gate for each in self.gate_sets for gate in each]
        factors = torch.tensor([1.0 if gate.kind == gates.PHASE else 0.5 for gate in every], dtype=torch.float32)
        angles = torch.tensor([math.nan if gate.angle is None else gate.angle for gate in every], dtype=torch.float32)
        wires = torch.tensor([[gate.wires >> wire & 1 for wire in range(self.task.n)] for gate in every])
        costs = torch.tensor([gate.cost for gate in every], dtype=torch.float32)
        return gates.matrices(tuple(every), self.task.n), factors, angles, wires.bool(), costs


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


def start(episode: Tensor, rng: RngKey, design: Design, *, is_training: bool) -> CircuitState:
    """Return the initial states of the episodes with these numbers, int32 `[N]`: a circuit without gates.

    In training it is one of the design's `beginnings` or a circuit `near_target`, if the design says so.
    """
    num = len(episode)
    none, nothing = torch.zeros_like(episode), torch.zeros_like(episode, dtype=torch.float32)
    drawn = random_target(rng, design.task) if design.target is None else design.target.to(episode.device)
    target = drawn.to(torch.complex64).expand(num, -1, -1)
    if is_training and design.beginnings is not None:
        circuits, depths = (table.to(episode.device) for table in design.beginnings)
        number = _beginning(episode, rng, design)
        begun, levels = circuits[number], [*depths[number].unbind(-1)]
        cost = depth_cost(depths[number].amax(-1), design.task.depth)
    else:
        begun, levels, cost = without_gates(design, episode.device).expand(num, -1, -1), [none] * design.task.n, nothing
        if is_training and design.begin_gates > 0:
            begun = near_target(target, rng, design)
    return design.state_type(
        *_entries(begun),
        *_entries(target),
        similarity(begun, target, design),
        cost,
        nothing,
        *levels,
        none,
        none - 1,
        none,
        none,
        episode,
    )


def _beginning(episode: Tensor, rng: RngKey, design: Design) -> Tensor:
    """Return numbers of `Design.beginnings` for episodes with these numbers `[N]`, int64 `[N]`.

    A later one lacks fewer gates. With `begin_episodes`, training comes to the earlier ones gradually.
    """
    assert design.beginnings is not None
    num, wait = len(design.beginnings[0]), design.begin_episodes
    most = torch.full_like(episode, num)
    if wait > 0:
        is_any = counter_rng.uniform(rng, 1) < ANY_BEGINNING
        most = torch.where(is_any, most, (1 + episode.clamp(min=0) // wait).clamp(max=num))
    return num - most + _below(counter_rng.uniform(rng, 0), most)


def near_target(target: Tensor, rng: RngKey, design: Design) -> Tensor:
    """Return circuits near their targets `[N, R, C]`, complex64 `[N, R, C]`.

    A circuit is its target after 0 to `begin_gates` random gates with random angles. The same gates with the opposite
    angles, the last one first, make the target again. If no gate is drawn, the circuit begins without gates.
    """
    most, num_gates = design.begin_gates, len(design.gate_sets[0]) - 1
    number = _below(counter_rng.uniform(rng, NEAR_TARGET), most + 1)
    begun = torch.where((number == 0)[:, None, None], without_gates(design, target.device), target)
    for i in range(most):
        gate = _below(counter_rng.uniform(rng, NEAR_TARGET + 1 + 2 * i), num_gates)
        angle = (counter_rng.uniform(rng, NEAR_TARGET + 2 + 2 * i) * 2.0 - 1.0) * math.pi
        begun = torch.where((number > i)[:, None, None], _with_gate(begun, gate, angle, design)[0], begun)
    return begun


def _below(uniform: Tensor, num: int | Tensor) -> Tensor:
    """Return whole numbers from 0 to `num - 1` for uniform ones in (0, 1), int64 `[N]`."""
    return (uniform * num).long().clamp(max=num - 1)


def _with_gate(made: Tensor, number: Tensor, angle: Tensor, design: Design) -> tuple[Tensor, Tensor]:
    """Return circuits `[N, R, C]` after the gates with these numbers in `Design.tables`, and the angles used, `[N]`."""
    matrices, factors, angles, _, _ = (table.to(angle.device) for table in design.tables)
    used = torch.where(angles[number].isnan(), angle, angles[number])
    turn = (factors[number] * used)[:, None, None]
    fixed, of_cosine, of_sine = matrices[number].unbind(1)
    return (fixed + turn.cos() * of_cosine + turn.sin() * of_sine) @ made, used


def without_gates(design: Design, device: torch.device) -> Tensor:
    """Return the state or operator of a circuit without gates, complex64 `[R, C]`."""
    empty = torch.zeros(design.num_rows, design.num_columns, dtype=torch.complex64, device=device)
    return empty.fill_diagonal_(1.0)


def _entries(matrix: Tensor) -> list[Tensor]:
    """Return the columns of the state for a complex matrix `[N, R, C]`: real parts, then imaginary parts."""
    flat = matrix.flatten(1)
    return [*flat.real.unbind(-1), *flat.imag.unbind(-1)]


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


def depth_cost(depth: Tensor, limit: int) -> Tensor:
    """Return the cost of depths `[N]`: a third of the limit is free."""
    return (depth.float() - limit / 3.0).clamp(min=0.0) / (1.5 * limit)


def act(
    state: CircuitState, option: Tensor | None, discrete: Tensor, angle: Tensor, design: Design
) -> tuple[CircuitState, Tensor]:
    """Return the states after one action in every environment, and the rewards `[N]`.

    Args:
        state: states before the action.
        option: gate sets, int64 `[N]`, read at the first action of an episode; None if there is no choice.
        discrete: actions, int64 `[N]`; the last one stops.
        angle: angle of the gate in [-pi, pi], `[N]`; ignored if the gate has none.
        design: settings of the circuits.
    """
    _, _, _, wires, costs = (table.to(angle.device) for table in design.tables)
    chosen = state.gate_set if option is None else torch.where(state.steps == 0, option.int(), state.gate_set)
    number = chosen.long() * len(design.gate_sets[0]) + discrete
    made, target = circuit_and_target(state, design)
    made, used = _with_gate(made, number, angle, design)
    # A gate stands one level above the highest gate on its wires.
    is_taken = wires[number]
    levels = torch.stack([state._asdict()[name] for name in _level_names(design)], -1)
    level = 1 + torch.where(is_taken, levels, 0).amax(-1, keepdim=True)
    levels = torch.where(is_taken, level, levels)
    depth = levels.amax(-1)

    similar = similarity(made, target, design)
    cost = state.cost + costs[number] if design.is_native else depth_cost(depth, design.task.depth)
    is_stop = discrete == len(design.gate_sets[0]) - 1
    has_ended = is_stop | (depth >= design.task.depth) | (state.steps + 1 >= design.max_steps)
    outcome = torch.where(similar >= MATCH, MATCHED, MISSED)
    score = similar - cost
    if design.reward == "progress":
        reward = score - (state.similarity - state.cost)
    elif design.reward == "gain":
        nothing = similarity(without_gates(design, target.device), target, design)
        floor = nothing if design.floor is None else design.floor
        reward = torch.where(has_ended, (score - floor).clamp(min=0.0), 0.0)
    else:
        reward = torch.where(has_ended, score, 0.0)
    after = replaced(
        state,
        **dict(zip(design.entry_names, _entries(made), strict=False)),
        similarity=similar,
        cost=cost,
        angle=used,
        **dict(zip(_level_names(design), levels.unbind(-1), strict=True)),
        gate_set=chosen,
        gate=discrete.int(),
        steps=state.steps + 1,
        outcome=torch.where(has_ended, outcome, BUILDING).int(),
    )
    return after, reward


def _level_names(design: Design) -> Sequence[str]:
    return [f"depth_{wire}" for wire in range(design.task.n)]


def observe(state: CircuitState, design: Design) -> Tensor:
    """Return the observations `[N, D]`: circuit and target and, if so set, the wires' depths as parts of the limit."""
    seen = [*state][: len(design.entry_names)]
    if design.observes_depth:
        seen += [state._asdict()[name] / design.task.depth for name in _level_names(design)]
    return torch.stack(seen, -1)
