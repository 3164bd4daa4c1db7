"""Registration of the problems' Gymnasium ids."""

from __future__ import annotations

import importlib
import importlib.util
import pkgutil

import hpamdp.env


def register() -> None:
    """Register the Gymnasium ids of all problems; calling it again changes nothing.

    A problem with a Gymnasium interface has a module `registration` in its folder, with a function `register()`. Since
    every import of the package calls it, it must import neither torch nor TorchRL: Gymnasium takes the environment's
    class as text, `package.module:Class`, and imports it when it is made.
    """
    for problem in pkgutil.iter_modules(hpamdp.env.__path__, "hpamdp.env."):
        name = f"{problem.name}.registration"
        if problem.ispkg and importlib.util.find_spec(name) is not None:
            importlib.import_module(name).register()
