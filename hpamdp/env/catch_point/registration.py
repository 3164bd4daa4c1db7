"""The Gymnasium id of Catch Point."""

from hpamdp.env.registration import batched

IDS = {"hpamdp/CatchPoint-v0": batched("hpamdp.env.catch_point.environment:CatchPointEnv")}
