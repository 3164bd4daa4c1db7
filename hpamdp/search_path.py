"""Make Python look for modules in the working directory last."""

from __future__ import annotations

import os
import sys


def is_command_line() -> bool:
    """Return whether this package is being imported to run its command line."""
    started = sys.argv[0] if sys.argv else ""
    if started == "-m":  # until Python has found the module
        return any(word.partition(".")[0] == "hpamdp" for word in sys.orig_argv)
    return os.path.basename(started) == "hpamdp" or os.path.realpath(started) == os.path.join(_root(), "run.py")


def put_working_directory_last() -> None:
    """Keep files of the working directory, such as `torch.py`, from replacing installed packages.

    Python still finds the user's own classes there. If this package lies there, as in a clone, the order stays.
    """
    directory = os.getcwd()
    if not is_clone(directory):
        sys.path[:] = [entry for entry in sys.path if os.path.realpath(entry) != directory]
    if directory not in map(os.path.realpath, sys.path):
        sys.path.append(directory)


def is_clone(directory: str) -> bool:
    """Return whether a directory is a clone of the repository from which this package is imported."""
    return directory == _root()


def _root() -> str:
    return os.path.dirname(os.path.dirname(os.path.realpath(__file__)))
