"""The Gymnasium ids of unknown boats, one for each family."""

from __future__ import annotations

from hpamdp.env.registration import register_batched_env

UNSEEN_BOATS_IDS = {
    "turned": "hpamdp/BoatDockUnseen-v0",
    "any": "hpamdp/BoatDockUnseenAny-v0",
    "strength": "hpamdp/BoatDockUnseenStrength-v0",
}


def register() -> None:
    """Register the ids with Gymnasium; calling it again changes nothing."""
    for family, env_id in UNSEEN_BOATS_IDS.items():
        register_batched_env(env_id, "hpamdp.env.boatdock_unseen.environment:UnseenBoatsEnv", family=family)
