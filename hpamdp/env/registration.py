"""The Gymnasium ids of our environments, apart from the environments so that registering them loads no torch."""

from __future__ import annotations

import gymnasium

BOAT_DOCK_ID = "hpamdp/BoatDock-v0"


def register() -> None:
    """Register our ids with Gymnasium; calling it again changes nothing."""
    if BOAT_DOCK_ID not in gymnasium.registry:
        # No max_episode_steps: the environment itself truncates after its last press.
        gymnasium.register(
            id=BOAT_DOCK_ID,
            entry_point="hpamdp.env.boatdock.gymnasium_faces:BoatDock",
            vector_entry_point="hpamdp.env.boatdock.gymnasium_faces:BoatDockVector",
        )
