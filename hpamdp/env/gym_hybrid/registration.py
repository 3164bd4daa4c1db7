"""The Gymnasium ids of Moving and Sliding."""

from __future__ import annotations

from hpamdp.env.registration import register_batched_env

MOVING_ID, SLIDING_ID = "hpamdp/Moving-v0", "hpamdp/Sliding-v0"


def register() -> None:
    """Register the ids with Gymnasium; calling it again changes nothing."""
    register_batched_env(MOVING_ID, "hpamdp.env.gym_hybrid.environment:MovingEnv")
    register_batched_env(SLIDING_ID, "hpamdp.env.gym_hybrid.environment:SlidingEnv")
