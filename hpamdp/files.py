"""Write files as a whole or not at all, and never through a link."""

from __future__ import annotations

import glob
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield an empty file beside `path`, which takes the place of `path` when the block ends.

    The new file has the same ending, is flushed to the disk, and is renamed in one step. If the block fails, or is
    killed, `path` stays as it was. If `path` is a link, the link is replaced, not the file that it leads to. Files that
    a killed process left beside `path` are removed.

    Raises:
        OSError: the disk is full, or the folder is gone or cannot be written to.
    """
    start = f".{path.name[:40]}."
    for leftover in path.parent.glob(f"{glob.escape(start)}*.partial{glob.escape(path.suffix)}"):
        with suppress(OSError):
            leftover.unlink()
    partial = path.with_name(f"{start}{secrets.token_hex(8)}.partial{path.suffix}")
    os.close(os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o666))
    try:
        yield partial
        with partial.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def remove_link(path: Path) -> None:
    """Remove a symbolic or hard link, so that nobody writes through it; keep a file that has no other name."""
    with suppress(FileNotFoundError):
        if path.is_symlink() or (path.lstat().st_nlink > 1 and path.is_file()):
            path.unlink()
