"""Files that users name, opened only if they are regular: a named pipe blocks for ever, a device never ends."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

_KINDS = {
    stat.S_IFDIR: "is a folder",
    stat.S_IFIFO: "is a named pipe",
    stat.S_IFSOCK: "is a socket",
    stat.S_IFCHR: "is a device",
    stat.S_IFBLK: "is a device",
    stat.S_IFLNK: "is a link",
}


def regular_size(path: Path, *, follow_links: bool = True) -> int:
    """Return the size of a regular file in bytes.

    Raises:
        OSError: the file is missing or not regular; `strerror` says what it is.
    """
    try:
        found = os.stat(path, follow_symlinks=follow_links)
    except ValueError as error:  # a null byte in the name
        raise OSError(errno.EINVAL, "is no file name", str(path)) from error
    kind = stat.S_IFMT(found.st_mode)
    if kind != stat.S_IFREG:
        raise OSError(errno.EINVAL, f"{_KINDS.get(kind, 'is no file')}, but must be a regular file", str(path))
    return found.st_size


def read_regular(path: Path, max_bytes: int, *, follow_links: bool = True) -> bytes:
    """Return the contents of a regular file.

    Raises:
        OSError: the file is missing, not regular, unreadable or larger than `max_bytes`; `strerror` says which.
    """
    size = regular_size(path, follow_links=follow_links)
    with path.open("rb") as file:
        data = file.read(max_bytes + 1) if size <= max_bytes else b""
    if max(size, len(data)) > max_bytes:
        raise OSError(errno.EFBIG, f"has {size} bytes, but may have at most {max_bytes}", str(path))
    return data
