"""Read the package's docstrings as they are meant, before mkdocstrings parses them.

A line may describe several arguments, `low, high: bounds of ...`, which the parser takes for one name; and a list may
follow its sentence without an empty line, which Markdown takes for one paragraph.
"""

from __future__ import annotations

import re
from typing import Any

import griffe

# A line of a section with two or more names, and the deeper lines that go on from it.
SHARED = re.compile(r"^(?P<indent> +)(?P<names>\w+(?:, \w+)+): (?P<text>.*(?:\n(?P=indent) +.*)*)$", re.MULTILINE)
# A line that is no part of a list, before an item of one.
BEFORE_LIST = re.compile(r"^(?P<indent> *)(?![- ])(?P<text>.+)\n(?=(?P=indent)- )", re.MULTILINE)


class Docstrings(griffe.Extension):
    """Rewrite every docstring."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """Rewrite the docstring of an object."""
        if obj.docstring is not None:
            obj.docstring.value = SHARED.sub(_one_line_each, BEFORE_LIST.sub(r"\g<0>\n", obj.docstring.value))


def _one_line_each(found: re.Match[str]) -> str:
    return "\n".join(f"{found['indent']}{name}: {found['text']}" for name in found["names"].split(", "))
