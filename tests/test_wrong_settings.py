"""The wrong settings that experiments/reliability/settings.py tries."""

from pathlib import Path

import pytest
from scripts import load_script

FOLDER = Path(__file__).resolve().parent.parent / "experiments" / "reliability"


@pytest.fixture(scope="module")
def script():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(FOLDER))
        yield load_script(FOLDER / "settings.py")


def test_wrong_values_are_made_for_settings_that_only_the_class_has(script):
    words = script.generated()
    assert {"low=hppo low.clip=banana", "low=hppo low.epochs=1.5", "high=ucb high.exploration=nan"} <= {*words}
    assert "low=hppo low.anneal_steps=banana" in words  # which the yaml has


def test_warm_ups_of_a_class_are_shortened(script):
    assert "low.minibatch_size=8" in script.short(["low=hppo"])
    assert "low.warmup_steps=8" in script.short(["low=hyar"])
