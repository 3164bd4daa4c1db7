"""Write files as a whole or not at all, never through a link; read regular files only.

A named pipe would block forever, and a device never ends.
"""

from __future__ import annotations

import errno
import glob
import io
import os
import secrets
import stat
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

_ABANDONED_S = 3600.0  # after which nobody still writes to a file
_MAX_KEPT_BYTES = 2**26  # of an array in the cache
_DIGEST_BYTES = 32  # of the array's SHA-256, which its file begins with


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield an empty file beside `path`, which takes the place of `path` when the block ends.

    The new file has the same ending, is flushed to the disk, and is renamed in one step. If the block fails, or is
    killed, `path` stays as it was. If `path` is a link, the link is replaced, not the file that it leads to.

    Files that a killed process left beside `path` are removed after an hour.

    Raises:
        OSError: the disk is full, or `path` is a folder, a pipe, a socket or a device. Or the folder around it is gone
            or cannot be written to. The error names `path`, even if it is about the file beside it.
    """
    with suppress(FileNotFoundError):
        kind = stat.S_IFMT(path.lstat().st_mode)
        if kind not in (stat.S_IFREG, stat.S_IFLNK):
            raise _not_regular(path)
    start = f".{path.name[:40]}."
    for leftover in path.parent.glob(f"{glob.escape(start)}*.partial{glob.escape(path.suffix)}"):
        with suppress(OSError):
            if time.time() - leftover.stat().st_mtime > _ABANDONED_S:
                leftover.unlink()
    partial = path.with_name(f"{start}{secrets.token_hex(8)}.partial{path.suffix}")
    try:
        os.close(os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o666))
        try:
            yield partial
            with partial.open("rb+") as file:
                os.fsync(file.fileno())
            os.replace(partial, path)
        finally:
            partial.unlink(missing_ok=True)
    except OSError as error:
        if error.filename is None or os.fsdecode(error.filename) != str(partial):
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error
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


def _not_regular(path: Path) -> OSError:
    return OSError(errno.EINVAL, "is a folder, a pipe or a device, but must be a regular file", str(path))


def regular_size(path: Path, *, follow_links: bool = True) -> int:
    """Return the size of a regular file in bytes.

    Raises:
        OSError: the file is missing or not regular; `strerror` says which.
    """
    found = os.stat(path, follow_symlinks=follow_links)
    if not stat.S_ISREG(found.st_mode):
        raise _not_regular(path)
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


def kept_in_cache(kind: str, depends_on: bytes, compute: Callable[[], np.ndarray]) -> np.ndarray:
    """Return an array that takes seconds to compute, and keep it in the user's cache for later runs.

    If the cache cannot be read or written, or a file there was damaged, the array is computed.

    Args:
        kind: name of the array's folder in the cache.
        depends_on: all that the array depends on, the source code included.
        compute: makes the array.
    """
    import numpy as np
    from platformdirs import user_cache_path

    file = user_cache_path("hpamdp") / kind / f"{sha256(depends_on).hexdigest()}.bin"
    with suppress(OSError):
        kept = read_regular(file, _MAX_KEPT_BYTES)
        digest, data = kept[:_DIGEST_BYTES], kept[_DIGEST_BYTES:]
        if sha256(data).digest() == digest:
            read: np.ndarray = np.load(io.BytesIO(data), allow_pickle=False)
            return read
    array = compute()
    written = io.BytesIO()
    np.save(written, array)
    with suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        with replacing(file) as partial:
            partial.write_bytes(sha256(written.getvalue()).digest() + written.getvalue())
    return array
