"""Recognise the limits of a process or of a machine in the errors of any library."""

from __future__ import annotations

import errno
from typing import Literal

Limit = Literal["files", "processes", "space", "memory"]
_CODES: dict[int, Limit] = {
    errno.EMFILE: "files",
    errno.ENFILE: "files",
    errno.EAGAIN: "processes",
    errno.ENOSPC: "space",
    errno.EDQUOT: "space",
    errno.ENOMEM: "memory",
}
# Messages of libraries about these limits, in errors without a number.
_SIGNS: dict[str, Limit] = {
    "Too many open files": "files",
    "received 0 items of ancdata": "files",
    "can't start new thread": "processes",
    "Resource temporarily unavailable": "processes",
    "No space left on device": "space",
    "annot allocate memory": "memory",
    "failed to map segment": "memory",
}


def limit_in(error: BaseException) -> Limit | None:
    """Return the limit that an error is about; None if it is about no limit."""
    if isinstance(error, MemoryError):
        return "memory"
    code = getattr(error, "errno", None)
    if code in _CODES:
        return _CODES[code]
    text = str(error) if isinstance(error, OSError | RuntimeError | ImportError) else ""
    return next((limit for sign, limit in _SIGNS.items() if sign in text), None)
