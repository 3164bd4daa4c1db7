"""The Gymnasium ids of circuit design, one for each task."""

from hpamdp.env.registration import batched

_ENV = "hpamdp.env.circuit.environment:CircuitEnv"
IDS = {
    "hpamdp/CircuitHadamard-v0": batched(_ENV, task="hadamard"),
    "hpamdp/CircuitRandomState-v0": batched(_ENV, task="random_state"),
    "hpamdp/CircuitBell-v0": batched(_ENV, task="bell"),
    "hpamdp/CircuitGHZ-v0": batched(_ENV, task="ghz"),
    "hpamdp/CircuitRandomUnitary-v0": batched(_ENV, task="random_unitary"),
    "hpamdp/CircuitToffoli-v0": batched(_ENV, task="toffoli"),
}
