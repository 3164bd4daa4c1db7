"""Scripts of the repository that are not part of the package, loaded as modules."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest


def load_script(file: Path) -> ModuleType:
    """Return a script as a module; skip the test where the script is missing."""
    if not file.exists():
        pytest.skip(f"{file.name} is in the repository, not in the source distribution", allow_module_level=True)
    spec = importlib.util.spec_from_file_location(f"script_{file.parent.name}_{file.stem}", file)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look for the names in their annotations
    spec.loader.exec_module(module)
    return module
