"""The released file fetched into the user's cache: resumed where it stopped, kept only if it is the right one."""

from __future__ import annotations

import contextlib
import http.client
import urllib.error
import urllib.request
from pathlib import Path

from hpamdp.data.errors import DataError
from hpamdp.data.human.released_file import SHA256, check_sum, default_path, load_bytes

_CHUNK = 1 << 16
_MAX_BYTES = 64 * 2**20
_TIMEOUT = 30.0  # seconds without a byte
_PARTIAL = 206
_RANGE_NOT_SATISFIABLE = 416


def download(url: str, target: Path | None = None, *, checksum: str = SHA256) -> Path:
    """Fetch the file from `url` and return where it lies; a file that is there and right is kept.

    What arrived of an interrupted download stays beside the target as `.part`, and the next call goes on from there.

    Raises:
        DataError: it cannot be had, or is not the released file.
    """
    target = default_path() if target is None else target
    if target.exists():
        check_sum(load_bytes(target), checksum, target)
        return target
    part = target.with_name(target.name + ".part")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        _fetch(url, part)
        data = load_bytes(part)
    except OSError as error:  # urllib's errors are OSErrors, too
        reason = getattr(error, "reason", None) or error.strerror or error
        kept = part.stat().st_size if part.exists() else 0
        raise DataError(
            f"{url}: cannot be fetched ({reason}); {kept} bytes are kept in {part}. Without a network, put the file at "
            f"{target} by hand"
        ) from error
    except (http.client.HTTPException, ValueError) as error:
        raise DataError(f"{url}: cannot be fetched ({error})") from error
    try:
        check_sum(data, checksum, part)
    except DataError:
        part.unlink()  # it would be gone on with for ever
        raise
    part.replace(target)
    return target


def _fetch(url: str, part: Path) -> None:
    """Write what `url` gives to `part`, from where `part` ends on if the server can."""
    there = part.stat().st_size if part.exists() else 0
    request = urllib.request.Request(url, headers={"Range": f"bytes={there}-"} if there else {})
    try:
        response = urllib.request.urlopen(request, timeout=_TIMEOUT)
    except urllib.error.HTTPError as error:
        if error.code == _RANGE_NOT_SATISFIABLE:  # all of it is there
            return
        raise
    with contextlib.closing(response):
        is_rest = getattr(response, "status", None) == _PARTIAL
        expected = response.headers.get("Content-Length")
        received = 0
        with part.open("ab" if is_rest else "wb") as file:
            while chunk := response.read(_CHUNK):
                received += len(chunk)
                if received > _MAX_BYTES:
                    raise ValueError(f"more than {_MAX_BYTES} bytes, which no recording has")
                file.write(chunk)
    if expected is not None and received < int(expected):
        raise ConnectionError(f"the connection broke after {received} of {expected} bytes")
