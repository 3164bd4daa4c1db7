"""Circuit design as a batched TorchRL environment: build a circuit gate by gate for a target state or operator.

Source: Altmann et al. 2023, arXiv:2312.11337; see `hpamdp.env.circuit.rules`, also for the differences.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, TensorSpec

from hpamdp import keys
from hpamdp.env import counter_rng
from hpamdp.env.base import Metric
from hpamdp.env.batched_env import KernelEnv
from hpamdp.env.circuit import gates, kernel, rules
from hpamdp.env.circuit.known_circuits import CIRCUITS
from hpamdp.env.circuit.options import CARDS, NATIVE_SETS, CircuitOptions
from hpamdp.env.circuit.oracle import CircuitOracle, beginnings, best_scores
from hpamdp.env.circuit.rules import TASK_OF, CircuitState, Design
from hpamdp.env.state_columns import check_range
from hpamdp.geometry import PlaneGeometry
from hpamdp.settings import SettingError

_SIMILARITY, _COST = "similarity", "cost"

# Final scores of the best published learner, read off a figure, to within 0.02: means of 8 seeds after 1.05 million
# steps. A run there has one random target, in training as in the evaluation.
_PUBLISHED = {
    "hadamard": 0.88,
    "random_state": 0.84,
    "bell": 0.95,
    "ghz": 0.68,
    "random_unitary": 0.27,
    "toffoli": 0.295,
}
# Mean scores of a circuit without gates over random targets.
_NOTHING = {"random_state": 0.25, "random_unitary": 0.2187}


class CircuitEnv(KernelEnv[CircuitState]):
    """Design `num_envs` circuits of quantum gates at once.

    Action leaves:
    - `("action", "discrete")` int64 `[N]`: a gate on certain wires, one of `discrete_names`; the last one stops;
    - `("action", "parameters")` float32 `[N, P]`: the angle in [-pi, pi] of each gate that has one;
    - with `gate_set="choose"`, `option` int64 `[N]` (0 superconducting, 1 ion): read at an episode's first gate and
      held until its end.

    The score of a circuit is its similarity to the target less the cost of its depth or, in the native sets, of its
    gates. An episode ends with the stop, once the circuit has the depth of the task, or after `max_steps` actions. So
    none is truncated.

    Only random targets are random. For the constructor's arguments and errors see `BatchedEnv`.
    """

    Options = CircuitOptions
    card = CARDS["CircuitEnv"]
    options: CircuitOptions
    outcomes: ClassVar[tuple[str, ...]] = rules.OUTCOMES
    extra_names = (_SIMILARITY, _COST)
    result_keys = (keys.OUTCOME, _SIMILARITY, _COST)
    row_kernel = staticmethod(kernel.advance)
    table_metrics: ClassVar[tuple[Metric, ...]] = (
        Metric("score", "score"),
        Metric("similarity", "similarity to the target"),
        Metric("success", "similarity of 0.99", "share"),
        Metric("cost", "cost of depth or gates"),
        Metric("steps", "steps a circuit", "count"),
        Metric("option_ion", "gates of ions", "share"),
        Metric("oracle_agreement", "better gate set", "share"),
        Metric("optimality_gap", "gap to the ceiling"),
    )
    curve_metrics: ClassVar[tuple[Metric, ...]] = (
        Metric("score", "Score"),
        Metric("success", "Circuits with a similarity of 0.99", "share"),
        Metric("oracle_agreement", "Better gate set chosen", "share"),
    )

    def _prepare(self) -> None:
        options, task = self.options, TASK_OF[self.options.task]
        self.max_steps = options.max_steps or 2 * task.n * task.depth
        self.design = Design(
            task=task,
            gate_sets=_gate_sets(options),
            target=_target(options),
            is_native=options.gate_set != "published",
            reward=options.reward,
            floor=options.floor,
            observes_depth=options.observe_depth,
            beginnings=beginnings(options.task) if options.begin == "known" else None,
            begin_episodes=options.begin_episodes if options.begin == "known" else 0,
            begin_gates=options.begin_gates if options.begin == "near_target" else 0,
        )
        self.state_type = self.design.state_type
        self.num_columns = len(self.design.entry_names) + 3, task.n + 5
        depths = [f"depth_{wire}" for wire in range(task.n)] if options.observe_depth else []
        self.observation_names = (*self.design.entry_names, *depths)
        of_each = [*zip(*self.design.gate_sets, strict=True)]
        self.discrete_names = tuple("|".join(dict.fromkeys(gate.name for gate in same)) for same in of_each)
        # An action has a parameter if it is a gate with an angle in some set.
        self.parameter_dims = tuple(int(any(gate.angle is None for gate in same)) for same in of_each)
        if self._has_oracle and not options.has_known_circuits:
            raise SettingError(f"task={options.task}: nobody knows its best circuits with the published gates")
        if self._has_oracle and options.begin == "near_target":
            raise SettingError("begin=near_target: nobody knows the best circuits from there; use begin=known or empty")
        if self._has_oracle:
            self.planning_oracle = CircuitOracle(self.num_envs, self.design, options.task, self.device)
        num = sum(self.parameter_dims)
        self.parameter_low, self.parameter_high = (-math.pi,) * num, (math.pi,) * num

    @property
    def training_begins_elsewhere(self) -> bool:
        """Whether training circuits begin with gates."""
        return self.options.begin != "empty"

    def kernel_settings(self) -> Sequence[float]:
        """Return the design in numbers."""
        return kernel.settings_of(self.design)

    @property
    def observation_bounds(self) -> tuple[Sequence[float], Sequence[float]]:
        """The lowest and the highest observation, `[D]` each."""
        dim = len(self.observation_names)
        return [-1.0] * dim, [1.0] * dim

    @property
    def geometry(self) -> PlaneGeometry:
        """The complex entries of states and operators as vectors of the plane.

        The products of these vectors include the overlap's parts and do not depend on the global phase.
        """
        num = self.design.num_numbers
        real = (2 * num * of_target + place for of_target in (0, 1) for place in range(num))
        return PlaneGeometry(vectors=tuple((entry, num + entry) for entry in real))

    def extra_spec(self, name: str) -> TensorSpec:
        """Return the spec of similarity and cost, float32 `[N, 1]`."""
        highest = self.max_steps if name == _COST else 1.0
        return Bounded(0.0, highest, shape=(self.num_envs, 1), device=self.device, dtype=torch.float32)

    def results(self, last: TensorDictBase) -> dict[str, Tensor]:
        """Return `similarity`, `cost`, their difference `score`, and `success` `[M]` of circuits."""
        similarity, cost = last.get(_SIMILARITY).squeeze(-1), last.get(_COST).squeeze(-1)
        return {
            "success": last.get(keys.OUTCOME) == rules.MATCHED,
            "score": similarity - cost,
            "similarity": similarity,
            "cost": cost,
        }

    def describe(self) -> dict[str, Tensor]:
        """Return `optimum` `[N, S]`, the best possible score in each native set, or nothing with the published gates.

        It takes milliseconds per target.
        """
        if not self.design.is_native:
            return {}
        return {"optimum": torch.from_numpy(best_scores(self.state, self.design))}

    def measure(self, played: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Return the means of similarity and cost, and what is known of the best scores.

        - `ceiling`: the best possible mean score, with a native set or for a fixed target.

        If the agent chose:
        - `option_NAME`: the fraction of circuits in that gate set.
        - `oracle_agreement`: the fraction of circuits in the better set for their target.
        - `oracle_agreement_weighted`: how much the agent's choices gained over the worse ones, as a fraction of the
          gain of the better ones.
        """
        means = {name: float(played[name].mean()) for name in (_SIMILARITY, _COST)}
        if not self.design.is_native:
            return {**means, "ceiling": 1.0} if self.options.task in CIRCUITS else means
        if "optimum" not in played:
            return means
        optimum = played["optimum"]
        means["ceiling"] = float(optimum.max(-1).mean())
        if "option" not in played or not self.has_choice:
            return means
        chosen = played["option"].astype(int)
        of_choice = np.take_along_axis(optimum, chosen[:, None], 1)[:, 0]
        best, worst = optimum.max(-1), optimum.min(-1)
        at_stake = float((best - worst).sum())
        means |= {f"option_{name}": float((chosen == number).mean()) for number, name in enumerate(NATIVE_SETS)}
        means["oracle_agreement"] = float((of_choice == best).mean())
        means["oracle_agreement_weighted"] = float((of_choice - worst).sum()) / at_stake if at_stake > 0.0 else 1.0
        return means

    def references(self, measured: Mapping[str, float]) -> dict[str, dict[str, float]]:
        """Return the scores of a circuit without gates, of the best published learner, and the best possible one."""
        task, target = self.options.task, self.design.target
        if target is None:
            nothing = _NOTHING[task]
        else:
            nothing = float(rules.similarity(rules.without_gates(self.design, target.device), target, self.design))
        known = {"no gates": {"score": nothing}}
        if not self.design.is_native:
            known["published"] = {"score": _PUBLISHED[task]}
        ceiling = super().references(measured)
        if ceiling and self.has_choice:
            ceiling["ceiling"]["oracle_agreement"] = 1.0
        return {**known, **ceiling}

    def check_env_state(self, columns: Mapping[str, Tensor]) -> None:
        """Refuse gates, gate sets, depths, counters and outcomes that do not exist.

        Raises:
            ValueError: a number is invalid.
        """
        super().check_env_state(columns)
        limits = {"gate_set": (0, len(self.design.gate_sets)), "gate": (-1, len(self.discrete_names))}
        depths = {f"depth_{wire}": (0, self.design.task.depth + 1) for wire in range(self.design.task.n)}
        check_range(columns, limits | depths)

    def draw(self, track: Sequence[CircuitState]) -> np.ndarray:
        """Return a picture of the circuit so far, uint8 `[480, 480, 3]`."""
        from hpamdp.env.circuit import rendering

        return rendering.draw(track, self.design)


def _gate_sets(options: CircuitOptions) -> tuple[tuple[gates.Gate, ...], ...]:
    """Return the gate sets in use: one, or with `choose` both native sets."""
    n = TASK_OF[options.task].n
    if options.gate_set == "published":
        return (gates.published(n),)
    native = {"superconducting": gates.superconducting, "ion": gates.ion}
    chosen = NATIVE_SETS if options.gate_set == "choose" else (options.gate_set,)
    return tuple(native[name](n, *options.costs(name)) for name in chosen)


def _target(options: CircuitOptions) -> Tensor | None:
    """Return the target of all episodes; None if each has its own."""
    if options.target_number is None:
        return rules.fixed_target(options.task)
    # The key is of the evaluation stream, so no training episode has this target, whatever its seed.
    number = torch.tensor([options.target_number], dtype=torch.int32)
    key = counter_rng.rng_key(counter_rng.seed_tensor(0), counter_rng.EVALUATION, torch.zeros_like(number), number)
    return rules.random_target(key, TASK_OF[options.task])[0]
