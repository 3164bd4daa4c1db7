"""The Gymnasium ids of Hard Move, one for each number of actuators."""

from hpamdp.env.registration import batched

IDS = {f"hpamdp/HardMove{n}-v0": batched("hpamdp.env.hard_move.environment:HardMoveEnv", n=n) for n in (4, 6, 8, 10)}
