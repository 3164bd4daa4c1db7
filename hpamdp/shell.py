"""Quote commands for the shell and for Hydra's grammar, so that a user can paste them."""

from __future__ import annotations

import re
import shlex
import sys
from pathlib import Path

# Texts that need no quotes in Hydra's grammar or in a shell.
_PLAIN = re.compile(r"(?=.*/|[A-Za-z])[A-Za-z0-9_./-]+")
_NO_TEXT = ("null", "true", "false", "inf", "nan")


def program() -> str:
    """Return the command that started this program."""
    started = Path(sys.argv[0])
    if started.name == "run.py":
        return f"python {for_shell(sys.argv[0])}"
    is_module = started.name == "__main__.py" and started.parent.name == "hpamdp"
    return "python -m hpamdp" if is_module else "hpamdp"


def setting(name: str, text: str) -> str:
    """Return `name=text` as one word for the shell, whatever letters the text has."""
    is_plain = _PLAIN.fullmatch(text) and text.lower() not in _NO_TEXT
    return f"{name}={text}" if is_plain else for_shell(f"{name}={for_hydra(text)}")


def path_setting(name: str, path: Path) -> str:
    """Return `name=path` as one word for the shell. A leading ~ is part of the path's name."""
    return setting(name, f"./{path}" if str(path).startswith("~") else str(path))


def for_shell(word: str) -> str:
    """Return a word in a POSIX shell's quotes if it needs them."""
    return shlex.quote(word)


def for_hydra(text: str) -> str:
    """Return a text in double quotes, in which only quotes, `${` and backslashes before them are special."""
    text = re.sub(r'(\\*)"', r'\1\1\\"', escaped(text))
    return f'"{text}{_trailing_backslashes(text)}"'


def escaped(text: str) -> str:
    """Return a text in which `${` begins no interpolation in a config."""
    return re.sub(r"(\\*)\$\{", r"\1\1\\${", text)


def _trailing_backslashes(text: str) -> str:
    return text[len(text.rstrip("\\")) :]
