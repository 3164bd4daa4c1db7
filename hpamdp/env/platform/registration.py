"""The Gymnasium id of Platform."""

from __future__ import annotations

from hpamdp.env.registration import register_batched_env

PLATFORM_ID = "hpamdp/Platform-v0"


def register() -> None:
    """Register the id with Gymnasium; calling it again changes nothing."""
    register_batched_env(PLATFORM_ID, "hpamdp.env.platform.environment:PlatformEnv")
