"""The Gymnasium id of Catch Point."""

from __future__ import annotations

from hpamdp.env.registration import register_batched_env

CATCH_POINT_ID = "hpamdp/CatchPoint-v0"


def register() -> None:
    """Register the id with Gymnasium; calling it again changes nothing."""
    register_batched_env(CATCH_POINT_ID, "hpamdp.env.catch_point.environment:CatchPointEnv")
