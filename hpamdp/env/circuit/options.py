"""The settings and the card of quantum circuits."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, NonNegativeInt, PositiveInt, model_validator
from typing_extensions import Self

from hpamdp.cards import ProblemCard
from hpamdp.env.circuit.known_circuits import CIRCUITS
from hpamdp.env.facts import ProblemFacts, ProblemOptions
from hpamdp.settings import FromList, OnlyWith

TaskName = Literal["hadamard", "random_state", "bell", "ghz", "random_unitary", "toffoli"]
RewardName = Literal["final", "progress", "gain"]
RANDOM_TASKS = ("random_state", "random_unitary")
NATIVE_SETS = ("superconducting", "ion")
GateSet = Literal["published", "choose", "superconducting", "ion"]
_NATIVE_TASKS = ("bell", "random_state")  # whose best circuits the compiler finds
Costs = Annotated[tuple[float, float], FromList]


class CircuitOptions(ProblemOptions):
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

    def facts(self, title: str) -> ProblemFacts:
        """Return what these settings tell of the problem, which errors call `title`."""
        is_choice = self.gate_set == "choose"
        return ProblemFacts(
            title=title,
            option_names=NATIVE_SETS if is_choice else (),
            has_choice=is_choice,
            can_change_option=False,
            has_oracle=True,  # if the best circuits are known, see `CircuitEnv`
        )


CARDS = {
    "CircuitEnv": ProblemCard(
        options=CircuitOptions,
        choice_setting="env.gate_set=choose env.task=random_state",
        no_choice_setting="env.gate_set=published (or superconducting, ion)",
    ),
}
