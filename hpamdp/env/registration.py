"""The Gymnasium ids of all problems, in one table."""

from __future__ import annotations

from typing import Any

import gymnasium

# Every import of the package reads this table, so classes are texts: Gymnasium imports them when it makes them.
#
# For each id `hpamdp/NAME-v0` of a `BatchedEnv`, its class and the settings that the id fixes.
_BATCHED: dict[str, tuple[str, dict[str, Any]]] = {
    "BoatDockUnseen": ("boatdock_unseen.environment:UnseenBoatsEnv", {"family": "turned"}),
    "BoatDockUnseenAny": ("boatdock_unseen.environment:UnseenBoatsEnv", {"family": "any"}),
    "BoatDockUnseenStrength": ("boatdock_unseen.environment:UnseenBoatsEnv", {"family": "strength"}),
    "CatchPoint": ("catch_point.environment:CatchPointEnv", {}),
    "CircuitHadamard": ("circuit.environment:CircuitEnv", {"task": "hadamard"}),
    "CircuitRandomState": ("circuit.environment:CircuitEnv", {"task": "random_state"}),
    "CircuitBell": ("circuit.environment:CircuitEnv", {"task": "bell"}),
    "CircuitGHZ": ("circuit.environment:CircuitEnv", {"task": "ghz"}),
    "CircuitRandomUnitary": ("circuit.environment:CircuitEnv", {"task": "random_unitary"}),
    "CircuitToffoli": ("circuit.environment:CircuitEnv", {"task": "toffoli"}),
    "Goal": ("goal.environment:GoalEnv", {}),
    "HardGoal": ("goal.environment:HardGoalEnv", {}),
    **{f"HardMove{n}": ("hard_move.environment:HardMoveEnv", {"n": n}) for n in (4, 6, 8, 10)},
    "Moving": ("gym_hybrid.environment:MovingEnv", {}),
    "Sliding": ("gym_hybrid.environment:SlidingEnv", {}),
    "Office": ("office.environment:OfficeEnv", {}),
    "PinballSimple": ("pinball.environment:PinballEnv", {"map": "simple"}),
    "PinballHard": ("pinball.environment:PinballEnv", {"map": "hard"}),
    "Platform": ("platform.environment:PlatformEnv", {}),
}
# For each other id, the arguments of `gymnasium.register`. Most environments end their episodes themselves, so these
# have no `max_episode_steps`.
_MANIPULATION, _LIGHTS = "primitives.manipulation:Manipulation", "traffic.lights:TrafficLights"
_OTHERS: dict[str, dict[str, Any]] = {
    "BoatDock": {
        "entry_point": "boatdock.gymnasium_adapter:BoatDock",
        "vector_entry_point": "hpamdp.env.boatdock.gymnasium_adapter:BoatDockVector",
    },
    "LunarLander": {"entry_point": "lunar_lander.lander:HybridLunarLander", "max_episode_steps": 1000},
    "DrawerClose": {"entry_point": _MANIPULATION, "kwargs": {"task": "drawer_close"}},
    "Soccer": {"entry_point": _MANIPULATION, "kwargs": {"task": "soccer"}},
    "PegUnplugSide": {"entry_point": _MANIPULATION, "kwargs": {"task": "peg_unplug_side"}},
    "SweepInto": {"entry_point": _MANIPULATION, "kwargs": {"task": "sweep_into"}},
    "Assembly": {"entry_point": _MANIPULATION, "kwargs": {"task": "assembly"}},
    "Disassemble": {"entry_point": _MANIPULATION, "kwargs": {"task": "disassemble"}},
    "RDDL": {"entry_point": "rddl.problem:RDDLProblem"},
    "TrafficCrossing": {"entry_point": _LIGHTS, "kwargs": {"network": "crossing"}},
    "TrafficCorridor": {"entry_point": _LIGHTS, "kwargs": {"network": "corridor"}},
}


def problem_of(env_id: str) -> str | None:
    """Return the class of the batched problem of an id, as `module:class`; None for other ids."""
    name = env_id.removeprefix("hpamdp/").removesuffix("-v0")
    return f"hpamdp.env.{_BATCHED[name][0]}" if name in _BATCHED else None


def register() -> None:
    """Register the Gymnasium ids of all problems; calling it again changes nothing."""
    adapter = "hpamdp.env.batched_adapter:BatchedEnv"
    table = {name: {**rest, "entry_point": f"hpamdp.env.{rest['entry_point']}"} for name, rest in _OTHERS.items()}
    for name, (problem, settings) in _BATCHED.items():
        table[name] = {
            "entry_point": f"{adapter}Adapter",
            "vector_entry_point": f"{adapter}VectorAdapter",
            "kwargs": {"problem": f"hpamdp.env.{problem}", **settings},
        }
    for name, arguments in table.items():
        if f"hpamdp/{name}-v0" not in gymnasium.registry:
            gymnasium.register(f"hpamdp/{name}-v0", **arguments)
