"""Registration of the Gymnasium ids of manipulation by primitives."""

from __future__ import annotations

import gymnasium

IDS = {
    "drawer_close": "hpamdp/DrawerClose-v0",
    "soccer": "hpamdp/Soccer-v0",
    "peg_unplug_side": "hpamdp/PegUnplugSide-v0",
    "sweep_into": "hpamdp/SweepInto-v0",
    "assembly": "hpamdp/Assembly-v0",
    "disassemble": "hpamdp/Disassemble-v0",
}


def register() -> None:
    """Register an id for each task; calling it again changes nothing."""
    for task, env_id in IDS.items():
        if env_id not in gymnasium.registry:
            # No max_episode_steps: the environment itself terminates after its last action.
            entry_point = "hpamdp.env.primitives.manipulation:Manipulation"
            gymnasium.register(env_id, entry_point=entry_point, kwargs={"task": task})
