"""The Gymnasium ids of Pinball, one for each map of the source."""

from __future__ import annotations

from hpamdp.env.registration import register_batched_env

PINBALL_IDS = {"simple": "hpamdp/PinballSimple-v0", "hard": "hpamdp/PinballHard-v0"}


def register() -> None:
    """Register the ids with Gymnasium; calling it again changes nothing."""
    for name, env_id in PINBALL_IDS.items():
        register_batched_env(env_id, "hpamdp.env.pinball.environment:PinballEnv", map=name)
