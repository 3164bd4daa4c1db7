"""The Gymnasium id of Platform."""

from hpamdp.env.registration import batched

IDS = {"hpamdp/Platform-v0": batched("hpamdp.env.platform.environment:PlatformEnv")}
