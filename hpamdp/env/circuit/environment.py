"""Circuit design as a batched TorchRL environment: build a circuit gate by gate for a target state or operator.

Source: Altmann et al. 2023, arXiv:2312.11337; see `hpamdp.env.circuit.rules`, also for the differences.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import torch
from pydantic import Field, NonNegativeInt, PositiveInt, model_validator
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, TensorSpec
from typing_extensions import Self

from hpamdp import keys
from hpamdp.env import counter_rng
from hpamdp.env.base import Metric
from hpamdp.env.batched_env import Action, BatchedEnv
from hpamdp.env.circuit import gates, kernel, rules
from hpamdp.env.circuit.gates import NATIVE_SETS, GateSet
from hpamdp.env.circuit.oracle import CIRCUITS, CircuitOracle, beginnings, best_scores
from hpamdp.env.circuit.rules import RANDOM_TASKS, TASK_OF, CircuitState, Design, RewardName, TaskName
from hpamdp.env.counter_rng import RngKey
from hpamdp.env.facts import ProblemFacts
from hpamdp.env.state_columns import check_range
from hpamdp.geometry import PlaneGeometry
from hpamdp.settings import FromList, OnlyWith, SettingError, Settings

_NATIVE_TASKS = ("bell", "random_state")  # whose best circuits the compiler finds
_SIMILARITY, _COST = "similarity", "cost"
_PLAN = "plan_"  # before the names of the known circuits in an `env_state`

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


Costs = Annotated[tuple[float, float], FromList]


class CircuitOptions(Settings):
    """Settings of `CircuitEnv`."""

    task: TaskName = "bell"
    """What to build: the operators `hadamard`, `random_unitary` and `toffoli`, or the states `bell`, `ghz` and
    `random_state`."""
    gate_set: GateSet = "published"
    """The gates: the source's, or a machine's native set, `superconducting` (RZ, SX, CX) or `ion` (RX, RY, XX).

    `choose` lets the agent choose one of the two native sets for each episode. Native sets are for states of two wires.
    """
    superconducting_costs: Annotated[Costs, OnlyWith("gate_set", "choose", "superconducting")] = (0.005, 0.3)
    """Costs of an SX and of a CX, which are subtracted from the score. RZ is free."""
    ion_costs: Annotated[Costs, OnlyWith("gate_set", "choose", "ion")] = (0.03, 0.05)
    """Costs of an RX or RY and of an XX."""
    reward: RewardName = "final"
    """`final`: the score, once, at the end. `progress`: its change with each gate, which adds up to the final score
    less a constant. `gain`: how much the final score exceeds `floor`, at least 0, so that trying gates costs nothing.
    """
    floor: Annotated[float, Field(ge=0.0, lt=1.0)] | None = None
    """With `reward=gain`: the score from which the gain counts. Local maxima below it are not rewarded.

    If null, the score of no gates.
    """
    target_number: NonNegativeInt | None = None
    """With random targets: number of the one target of all episodes, as in the published runs.

    If null, each episode has its own.
    """
    begin: Literal["empty", "known", "near_target"] = "empty"
    """How training episodes begin. `empty`: without gates, as evaluation always does.

    `known`: with the first gates of the circuit that makes the fixed target, from none of them to all but one.
    `near_target`: with the target after a few random gates, which the agent has to undo.
    """
    begin_episodes: Annotated[int, Field(ge=0, le=2**30), OnlyWith("begin", "known")] = 0
    """Episodes of an environment after which training circuits may lack one gate more; at first they lack the last one.

    From the start, a random quarter of the episodes may lack any number of gates. If 0, all episodes may.
    """
    begin_gates: Annotated[int, Field(ge=1, le=100), OnlyWith("begin", "near_target")] = 6
    """Largest number of random gates. The number is uniform from 0 to this.

    If the number is 0, the episode begins with an empty circuit, not at the target.
    """
    observe_depth: bool = False
    """Whether the observation ends in the depth of each wire, as a fraction of the limit."""
    max_steps: PositiveInt | None = None
    """Actions after which a circuit is finished. If null, twice the number of wires times the depth limit.

    No circuit reaches that.
    """

    @property
    def has_known_circuits(self) -> bool:
        """Whether the best circuits are known: those of fixed targets and, in the native sets, of all."""
        return self.gate_set != "published" or self.task in CIRCUITS

    def costs(self, gate_set: str) -> tuple[float, float]:
        """Return the costs of a native set: a gate on one wire, a gate on two."""
        return self.superconducting_costs if gate_set == "superconducting" else self.ion_costs

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.floor is not None and self.reward != "gain":
            raise ValueError(f"floor={self.floor}: needs reward=gain, not reward={self.reward}")
        if self.gate_set != "published" and self.task not in _NATIVE_TASKS:
            raise ValueError(
                f"gate_set={self.gate_set}: native sets are for task={' and '.join(_NATIVE_TASKS)}, "
                f"not task={self.task}"
            )
        if self.begin == "known" and (self.gate_set != "published" or self.task not in CIRCUITS):
            raise ValueError(
                f"begin=known: needs gate_set=published and a target with a known circuit, task={' or '.join(CIRCUITS)}"
            )
        if self.begin == "near_target" and self.gate_set != "published":
            raise ValueError(f"begin=near_target: needs gate_set=published, not gate_set={self.gate_set}")
        for name in NATIVE_SETS:
            one, two = self.costs(name)
            if not 0.001 <= one <= two <= 1.0:
                raise ValueError(
                    f"{name}_costs={[one, two]}: must lie between 0.001 and 1, and the second must not be the smaller"
                )
        if self.target_number is not None and self.task not in RANDOM_TASKS:
            raise ValueError(f"target_number={self.target_number}: task={self.task} has one target; leave it out")
        return self


class CircuitEnv(BatchedEnv[CircuitState]):
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
    options: CircuitOptions
    outcomes: ClassVar[tuple[str, ...]] = rules.OUTCOMES
    extra_names = (_SIMILARITY, _COST)
    result_keys = (keys.OUTCOME, _SIMILARITY, _COST)
    row_kernel = staticmethod(kernel.advance)
    choice_setting: ClassVar[str] = "env.gate_set=choose env.task=random_state"
    no_choice_setting: ClassVar[str] = "env.gate_set=published (or superconducting, ion)"
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

    @classmethod
    def facts(cls, options: Any) -> ProblemFacts:
        """Return the facts about the problem under these settings."""
        is_choice = options.gate_set == "choose"
        return ProblemFacts(
            title=cls.__name__,
            option_names=NATIVE_SETS if is_choice else (),
            has_choice=is_choice,
            can_change_option=False,
            has_oracle=True,  # if the best circuits are known, see `_prepare`
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
            max_steps=self.max_steps,
            beginnings=beginnings(options.task) if options.begin == "known" else None,
            begin_episodes=options.begin_episodes if options.begin == "known" else 0,
            begin_gates=options.begin_gates if options.begin == "near_target" else 0,
        )
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
        self._oracle = (
            CircuitOracle(self.num_envs, self.design, options.task, self.device) if self._has_oracle else None
        )
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

    def start(self, episode: Tensor, rng: RngKey) -> CircuitState:
        """Return circuits without gates or, in training, what `begin` says."""
        return rules.start(episode, rng, self.design, is_training=self._streams[0] == counter_rng.TRAINING)

    def act(self, state: CircuitState, action: Action, rng: RngKey, is_idle: Tensor) -> tuple[CircuitState, Tensor]:
        """Return the states after one gate, and the rewards `[N]`."""
        return rules.act(state, action.option, action.discrete, action.parameters.squeeze(-1), self.design)

    def observe(self, state: CircuitState) -> Tensor:
        """Return the observations `[N, D]`."""
        return rules.observe(state, self.design)

    def extras(self, state: CircuitState) -> Sequence[Tensor]:
        """Return similarity and cost."""
        return state.similarity, state.cost

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

    def env_state(self) -> dict[str, Tensor]:
        """Return the columns of the state and, with `oracle`, the known circuits, first dimension `N`."""
        known = {} if self._oracle is None else {_PLAN + name: plan for name, plan in self._oracle.plans().items()}
        return {**self.state._asdict(), **known}

    def check_env_state(self, columns: Mapping[str, Tensor]) -> None:
        """Refuse gates, gate sets, depths, counters and outcomes that do not exist.

        Raises:
            ValueError: a number is invalid.
        """
        super().check_env_state(columns)
        limits = {"gate_set": (0, len(self.design.gate_sets)), "gate": (-1, len(self.discrete_names))}
        depths = {f"depth_{wire}": (0, self.design.task.depth + 1) for wire in range(self.design.task.n)}
        check_range(columns, limits | depths)

    def set_env_state(self, columns: Mapping[str, Tensor]) -> None:
        """Continue from an `env_state`.

        Raises:
            ValueError: it is not the state of this many environments.
        """
        super().set_env_state({name: column for name, column in columns.items() if not name.startswith(_PLAN)})
        plans = {name.removeprefix(_PLAN): plan for name, plan in columns.items() if name.startswith(_PLAN)}
        if self._oracle is not None and plans:
            self._oracle.set_plans(plans)

    def _on_start(self, mask: Tensor) -> None:
        if self._oracle is not None:
            self._oracle.plan(self._state, mask)

    def _knowledge_specs(self) -> dict[str, TensorSpec]:
        return {} if self._oracle is None else {"oracle": self._oracle.spec()}

    def _knowledge(self) -> dict[str, Any]:
        return {} if self._oracle is None else {"oracle": self._oracle.read(self._state)}

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
