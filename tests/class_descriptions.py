"""Describe classes by their settings and facts; run as a script, it reads the classes with stand-ins for torch."""

import json
import sys

from hpamdp.config.components import SUPPLIED_ARGUMENTS, defaults_of, load_class, settings_model
from hpamdp.config.stand_ins import quick_imports

# Facts of classes that the rules of `hpamdp.run.compatibility` read.
FACTS = ("modes", "needs", "is_bandit", "ends_options", "asks_learners", "value_setting", "guarded_settings")
FACTS += ("needs_evaluations", "changes", "explores_with", "counts_durations")


def described(cls: type, group: str) -> dict:
    """Return the settings' defaults and the facts of a class as JSON values."""
    facts = {name: getattr(cls, name, None) for name in FACTS}
    facts = {name: sorted(value) if isinstance(value, tuple | frozenset) else value for name, value in facts.items()}
    return {"defaults": defaults_of(settings_model(cls, SUPPLIED_ARGUMENTS.get(group, ()))), "facts": facts}


if __name__ == "__main__":
    before = set(sys.modules)
    with quick_imports():
        classes = {target: (load_class(target), group) for target, group in json.loads(sys.argv[1])}
    rooms = ("hpamdp.env", "hpamdp.policies", "hpamdp.run", "torch", "tensordict")
    left = sorted(name for name in set(sys.modules) - before if name.startswith(rooms))
    print(json.dumps({"described": {target: described(*each) for target, each in classes.items()}, "left": left}))
