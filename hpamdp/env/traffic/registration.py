"""Registration of the Gymnasium ids of traffic lights."""

from __future__ import annotations

import gymnasium

ENV_IDS = {"crossing": "hpamdp/TrafficCrossing-v0", "corridor": "hpamdp/TrafficCorridor-v0"}


def register() -> None:
    """Register the ids; calling it again changes nothing."""
    for network, env_id in ENV_IDS.items():
        if env_id not in gymnasium.registry:
            # No max_episode_steps: the environment itself truncates after its `minutes`.
            entry_point = "hpamdp.env.traffic.lights:TrafficLights"
            gymnasium.register(env_id, entry_point=entry_point, kwargs={"network": network})
