"""Load the scripts of the studies, which are no package, as modules."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType


def load(script: Path) -> ModuleType:
    """Return a script as a module, named after its folder and file. Each call runs it anew."""
    spec = importlib.util.spec_from_file_location(f"{script.parent.name}_{script.stem}", script)
    if spec is None or spec.loader is None:
        raise ImportError(f"{script} is no Python file")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
