"""The Gymnasium ids of Hard Move, one for each number of actuators."""

from __future__ import annotations

from hpamdp.env.registration import register_batched_env

HARD_MOVE_IDS = {n: f"hpamdp/HardMove{n}-v0" for n in (4, 6, 8, 10)}


def register() -> None:
    """Register the ids with Gymnasium; calling it again changes nothing."""
    for n, env_id in HARD_MOVE_IDS.items():
        register_batched_env(env_id, "hpamdp.env.hard_move.environment:HardMoveEnv", n=n)
