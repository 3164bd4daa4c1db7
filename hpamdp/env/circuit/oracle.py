"""Circuits that are known to be best: the textbook's for the fixed targets, the compiler's in the native sets."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from hpamdp.env.circuit import compiler, rules
from hpamdp.env.circuit.gates import PHASE, matrices, published
from hpamdp.env.circuit.known_circuits import CIRCUITS
from hpamdp.env.circuit.rules import TASK_OF, CircuitState, Design
from hpamdp.env.planning_oracle import PlanningOracle


def beginnings(task: str) -> tuple[Tensor, Tensor]:
    """Return the parts of a known circuit before each of its gates, and the depths of their wires.

    Returns:
        Operators or states, complex64 `[L, R, C]`, and int32 `[L, n]`, with a row for each of the L gates.
    """
    sizes = TASK_OF[task]
    gate_set = published(sizes.n)
    table = {gate.name: (gate, matrix) for gate, matrix in zip(gate_set, matrices(gate_set, sizes.n), strict=True)}
    made = torch.eye(1 << sizes.n, dtype=torch.complex64)
    depths = torch.zeros(sizes.n, dtype=torch.int32)
    circuits, levels = [], []
    for name, angle in CIRCUITS[task]:
        circuits.append(made if sizes.is_operator else made[:, :1])
        levels.append(depths)
        gate, (fixed, of_cosine, of_sine) = table[name]
        turn = angle if gate.kind == PHASE else 0.5 * angle
        made = (fixed + math.cos(turn) * of_cosine + math.sin(turn) * of_sine) @ made
        is_taken = torch.tensor([bool(gate.wires >> wire & 1) for wire in range(sizes.n)])
        depths = torch.where(is_taken, depths[is_taken].max() + 1, depths).int()
    return torch.stack(circuits), torch.stack(levels)


def best_scores(state: CircuitState, design: Design) -> np.ndarray:
    """Return the best possible score of each set for the targets of native designs, `[N, S]`."""
    return np.stack([plans.score for plans in _compiled(state, design)], -1)


def _compiled(state: CircuitState, design: Design) -> list[compiler.Plans]:
    _, target = rules.circuit_and_target(state, design)
    states = target.squeeze(-1).cpu().numpy()
    return [compiler.best(states, gate_set) for gate_set in design.gate_sets]


class CircuitOracle(PlanningOracle):
    """Keep the best circuit of every option, found at the start of an episode, with the stop at its end.

    Args:
        num_envs: number of environments.
        design: settings of the circuits; native, or with the fixed target of `task`.
        task: name of the task.
        device: of the tensors.
    """

    saved_names = ("gates", "angles")

    def __init__(self, num_envs: int, design: Design, task: str, device: torch.device | None) -> None:
        if design.is_native:
            length = max(len(form) for gate_set in design.gate_sets for form in compiler.forms(gate_set))
        else:
            length = len(CIRCUITS[task])
        num_gates, num_sets = len(design.gate_sets[0]), len(design.gate_sets)
        num_options = num_sets if num_sets > 1 else 0
        super().__init__((num_envs, num_sets, length + 1), num_gates, (-math.pi, math.pi), num_options, device)
        self.design = design
        self.discrete.fill_(num_gates - 1)
        if not design.is_native:
            names = [gate.name for gate in design.gate_sets[0]]
            for place, (name, angle) in enumerate(CIRCUITS[task]):
                self.discrete[..., place], self.parameters[..., place] = names.index(name), angle
        self._known_gates, self._known_angles = self.discrete[0, 0].clone(), self.parameters[0, 0].clone()

    def plan(self, state: CircuitState, rows: Tensor) -> None:
        """Find the circuits for the environments of `rows`, bool `[N]`, which begin."""
        if not rows.any():
            return
        if self.design.beginnings is not None:
            self._leave_out_begun(state, rows, self.design.beginnings[0])
        if not self.design.is_native:
            return
        plans = _compiled(type(state)(*(column[rows] for column in state)), self.design)
        device = self.option.device
        self.option[rows] = torch.from_numpy(np.stack([each.score for each in plans], -1).argmax(-1)).to(device)
        for number, each in enumerate(plans):
            used = each.gates.shape[-1]
            self.discrete[rows, number, :used] = torch.from_numpy(each.gates).to(device)
            self.parameters[rows, number, :used] = torch.from_numpy(each.angles).float().to(device)

    def _leave_out_begun(self, state: CircuitState, rows: Tensor, beginnings: Tensor) -> None:
        """Keep of the known circuit what follows the gates that are there: one of its beginnings `[L, R, C]`."""
        begun, _ = rules.circuit_and_target(state, self.design)
        distance = (begun[rows].unsqueeze(1) - beginnings.to(begun.device)).abs().sum((-2, -1))
        num = self._known_gates.shape[-1]
        least, there = distance.min(-1, keepdim=True)
        there = torch.where(least < 0.1, there, num - 1)  # of the whole circuit, or of another one, the stop is left
        place = torch.arange(num, device=begun.device) + there - state.steps[rows].unsqueeze(-1)
        place = place.clamp(0, num - 1)  # `read` adds the steps
        self.discrete[rows] = self._known_gates[place].unsqueeze(1)
        self.parameters[rows] = self._known_angles[place].unsqueeze(1)
