"""The Gymnasium ids of circuit design, one for each task."""

from __future__ import annotations

from hpamdp.env.registration import register_batched_env

CIRCUIT_IDS = {
    "hadamard": "hpamdp/CircuitHadamard-v0",
    "random_state": "hpamdp/CircuitRandomState-v0",
    "bell": "hpamdp/CircuitBell-v0",
    "ghz": "hpamdp/CircuitGHZ-v0",
    "random_unitary": "hpamdp/CircuitRandomUnitary-v0",
    "toffoli": "hpamdp/CircuitToffoli-v0",
}


def register() -> None:
    """Register the ids with Gymnasium; calling it again changes nothing."""
    for task, env_id in CIRCUIT_IDS.items():
        register_batched_env(env_id, "hpamdp.env.circuit.environment:CircuitEnv", task=task)
