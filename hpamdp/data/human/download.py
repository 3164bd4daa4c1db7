"""Download of the released file into the user's cache, with a check of its checksum."""

from __future__ import annotations

import ftplib
import logging
import sys
from pathlib import Path

import pooch

from hpamdp.data import DataError
from hpamdp.data.human.options import SHA256
from hpamdp.data.human.released_file import check_sum, default_path, load_bytes
from hpamdp.messages import reason_of


def download(url: str, target: Path | None = None, *, checksum: str = SHA256) -> Path:
    """Fetch the file and return its path. An existing file is only checked.

    The file appears at the target when the download is complete and its checksum is right. A failed download leaves
    nothing behind, and the next call starts again (the file has 4 MB).

    Args:
        url: address of any kind that pooch supports, such as `https://…` or `doi:…/<file>`.
        target: the file to make. If None, `released_file.default_path`.
        checksum: the SHA-256 that the file must have.

    Raises:
        DataError: the file cannot be fetched, or it has another checksum.
    """
    target = default_path() if target is None else target
    try:
        is_there = target.exists()
    except OSError as error:
        raise DataError(f"{target}: {reason_of(error)}") from error
    if is_there:
        check_sum(load_bytes(target), checksum, target)
        return target
    pooch.get_logger().setLevel(logging.WARNING)  # silence pooch's lines about each download
    try:
        pooch.retrieve(
            url,
            known_hash=f"sha256:{checksum}",
            fname=target.name,
            path=target.parent,
            progressbar=sys.stderr.isatty(),
        )
    # The requests library raises OSErrors, an unexpected reply of an archive a LookupError.
    except (OSError, ValueError, EOFError, LookupError, ftplib.Error) as error:
        raise DataError(f"{url}: cannot be fetched ({error}); you can also put the file at {target} by hand") from error
    return target
