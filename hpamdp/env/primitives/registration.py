"""The Gymnasium ids of manipulation by primitives, one for each task."""

_NAMES = {
    "drawer_close": "DrawerClose",
    "soccer": "Soccer",
    "peg_unplug_side": "PegUnplugSide",
    "sweep_into": "SweepInto",
    "assembly": "Assembly",
    "disassemble": "Disassemble",
}
# No max_episode_steps: the environment itself terminates after its last action.
IDS = {
    f"hpamdp/{name}-v0": {"entry_point": "hpamdp.env.primitives.manipulation:Manipulation", "kwargs": {"task": task}}
    for task, name in _NAMES.items()
}
