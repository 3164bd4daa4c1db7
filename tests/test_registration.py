"""A problem registers its own Gymnasium ids."""

import sys

import gymnasium

import hpamdp.env
from hpamdp.env.registration import register

REGISTRATION = """
IDS = {"MadeUp-v0": {"entry_point": "nowhere:MadeUp"}}
"""


def test_a_registration_module_in_a_problems_folder_is_all_that_it_takes(tmp_path, monkeypatch):
    problem = tmp_path / "made_up"
    problem.mkdir()
    (problem / "__init__.py").touch()
    (problem / "registration.py").write_text(REGISTRATION)
    (tmp_path / "without_ids").mkdir()
    (tmp_path / "without_ids" / "__init__.py").touch()
    monkeypatch.setattr(hpamdp.env, "__path__", [*hpamdp.env.__path__, str(tmp_path)])
    try:
        register()
        assert "MadeUp-v0" in gymnasium.registry
    finally:
        gymnasium.registry.pop("MadeUp-v0", None)
        for name in ("made_up", "made_up.registration", "without_ids"):
            sys.modules.pop(f"hpamdp.env.{name}", None)
