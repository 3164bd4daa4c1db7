"""Serve a problem's page: a handful of files, and one address that takes episodes.

The server uses only the standard library and is meant for the user's own computer. It sends nothing but the page.
"""

from __future__ import annotations

import errno
import fcntl
import ipaddress
import json
import os
from collections.abc import Mapping
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from hpamdp.env.play_page import EpisodeError, PlayPage
from hpamdp.files import read_regular
from hpamdp.json_lines import MAX_LINE_BYTES, LineError, lines_of, read_json
from hpamdp.messages import one_line, reason_of

DATA_NAME = "data.js"
_EPISODES_PATH = "/episodes"
_MAX_FILE = 1 << 28  # bytes
_TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript"}
# Alone in its process, the page has a finer clock.
_HEADERS = {
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Embedder-Policy": "require-corp",
    "Cache-Control": "no-store",
}


def as_script(data: Mapping[str, Any]) -> bytes:
    """Return `data.js`. The data are a script because a page that is opened from a file may load nothing else."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return f"window.HPAMDP_DATA = {text};\n".encode()


class EpisodeFile:
    """A file of episodes, one JSON object per line, to which several threads and processes may add.

    Args:
        path: the file, which is created if it does not exist.
        page: the page, which recognises episodes.

    Attributes:
        added: the episodes that were added through this object.

    Raises:
        EpisodeError: the file has lines, but none is an episode.
        OSError: the file cannot be read or written.
    """

    def __init__(self, path: Path, page: PlayPage) -> None:
        self.path = path
        self.page = page
        self.added: list[Mapping[str, Any]] = []
        with suppress(FileNotFoundError):
            lines = [line for _, line in lines_of(read_regular(path, _MAX_FILE))]
            if lines and not any(self._is_episode(line) for line in lines):
                raise EpisodeError(f"{path}: no line is an episode; take another file")
        path.open("ab").close()

    def add(self, episode: Mapping[str, Any]) -> bool:
        """Add a checked episode to the disk, and return whether it is new.

        Raises:
            OSError: the episode cannot be written. The file is as it was.
        """
        line = json.dumps(episode, separators=(",", ":"), allow_nan=False).encode() + b"\n"
        # Without a buffer, nothing remains to be written after an error. The lock ends when the file is closed.
        with self.path.open("a+b", buffering=0) as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            file.seek(0)
            stored = file.read()
            if b"\n" + line in b"\n" + stored:
                return False
            # If the last line was cut short, it stays a separate line.
            added = line if not stored or stored.endswith(b"\n") else b"\n" + line
            try:
                if file.write(added) < len(added):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                os.fsync(file.fileno())
            except OSError:
                with suppress(OSError):
                    file.truncate(len(stored))
                raise
        self.added.append(episode)
        return True

    def _is_episode(self, line: bytes) -> bool:
        try:
            self.page.check(read_json(line))
        except (LineError, EpisodeError):
            return False
        return True


class PageServer(ThreadingHTTPServer):
    """Serves a page and takes its episodes.

    Args:
        address: host and port. If the port is 0, any free one.
        page: the page, with its files and the check of episodes.
        data: data of the page's script.
        episodes: file for checked episodes.

    Attributes:
        address: address of the page.
        is_local: whether only this computer reaches the address.

    Raises:
        OSError: the server cannot listen on the address.
    """

    request_queue_size = 128  # with the default of 5, browsers that connect at the same time wait for seconds

    def __init__(
        self, address: tuple[str, int], page: PlayPage, data: Mapping[str, Any], episodes: EpisodeFile
    ) -> None:
        self.page = page
        self.episodes = episodes
        self.contents = {f"/{name}": file.read_bytes() for name, file in page.files.items()}
        self.contents[f"/{DATA_NAME}"] = as_script(data)
        super().__init__(address, _Handler)
        host = str(self.server_address[0])
        self.is_local = ipaddress.ip_address(host).is_loopback
        self.address = f"http://{host}:{self.server_port}/"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore a broken connection, and continue to serve the others."""


class _Handler(BaseHTTPRequestHandler):
    """One request."""

    server: PageServer
    timeout = 10.0  # s that a connection may keep silent

    def do_GET(self) -> None:
        """Send a file of the page."""
        # The server sends only entries of the dictionary, and never looks up a path on the disk.
        path = self.path.partition("?")[0]
        name = "/index.html" if path == "/" else path
        if name in self.server.contents:
            self._respond(HTTPStatus.OK, _TYPES[Path(name).suffix], self.server.contents[name])
        else:
            self._answer(HTTPStatus.NOT_FOUND, "there is no such page")

    def do_POST(self) -> None:
        """Check an episode and store it."""
        length = self.headers.get("Content-Length", "")
        if self.path != _EPISODES_PATH:
            self._answer(HTTPStatus.NOT_FOUND, f"episodes are sent to {_EPISODES_PATH}")
        # A page of another site cannot send this type without asking first, and nothing here answers such a question.
        elif self.headers.get_content_type() != "application/json":
            self._answer(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "an episode is application/json")
        elif not (length.isascii() and length.isdecimal()):
            self._answer(HTTPStatus.LENGTH_REQUIRED, "a Content-Length is required")
        elif int(length) > MAX_LINE_BYTES:
            self._answer(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"an episode has at most {MAX_LINE_BYTES} bytes")
        else:
            self._store(self.rfile.read(int(length)))

    def _store(self, body: bytes) -> None:
        try:
            is_new = self.server.episodes.add(self.server.page.check(read_json(body)))
        except EpisodeError as error:
            self._answer(HTTPStatus.UNPROCESSABLE_ENTITY, str(error))
        except LineError as error:
            self._answer(HTTPStatus.BAD_REQUEST, f"the body: {error}")
        except OSError as error:
            self._answer(HTTPStatus.INSUFFICIENT_STORAGE, f"the episode was not stored: {reason_of(error)}")
        else:
            self._answer(HTTPStatus.CREATED if is_new else HTTPStatus.OK, "stored")

    def _answer(self, status: HTTPStatus, line: str) -> None:
        self._respond(status, "text/plain", f"{one_line(line)[:400]}\n".encode())

    def _respond(self, status: HTTPStatus, content_type: str, content: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Type", f"{content_type}; charset=utf-8")
        self.send_header("Content-Length", str(len(content)))
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing: the terminal shows what the user should see."""
