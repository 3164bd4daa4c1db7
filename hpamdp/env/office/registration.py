"""The Gymnasium id of Office."""

from hpamdp.env.registration import batched

IDS = {"hpamdp/Office-v0": batched("hpamdp.env.office.environment:OfficeEnv")}
