"""The Gymnasium ids of the boats."""

from __future__ import annotations

import gymnasium

BOAT_DOCK_ID = "hpamdp/BoatDock-v0"


def register() -> None:
    """Register the ids with Gymnasium; calling it again changes nothing."""
    if BOAT_DOCK_ID in gymnasium.registry:
        return
    # No max_episode_steps: the environment itself truncates after its last press.
    gymnasium.register(
        id=BOAT_DOCK_ID,
        entry_point="hpamdp.env.boatdock.gymnasium_adapter:BoatDock",
        vector_entry_point="hpamdp.env.boatdock.gymnasium_adapter:BoatDockVector",
    )
