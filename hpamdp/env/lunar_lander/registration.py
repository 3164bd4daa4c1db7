"""Registration of Hybrid LunarLander's Gymnasium id."""

from __future__ import annotations

import gymnasium

ENV_ID = "hpamdp/LunarLander-v0"
MAX_STEPS = 1000


def register() -> None:
    """Register the id; calling it again changes nothing."""
    if ENV_ID not in gymnasium.registry:
        entry_point = "hpamdp.env.lunar_lander.lander:HybridLunarLander"
        gymnasium.register(ENV_ID, entry_point=entry_point, max_episode_steps=MAX_STEPS)
