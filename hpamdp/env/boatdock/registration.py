"""The Gymnasium ids of the boats."""

BOAT_DOCK_ID = "hpamdp/BoatDock-v0"

# No max_episode_steps: the environment itself truncates after its last press.
IDS = {
    BOAT_DOCK_ID: {
        "entry_point": "hpamdp.env.boatdock.gymnasium_adapter:BoatDock",
        "vector_entry_point": "hpamdp.env.boatdock.gymnasium_adapter:BoatDockVector",
    }
}
