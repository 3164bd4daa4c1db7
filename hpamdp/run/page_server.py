"""Serve a problem's page: a handful of files, and one address that takes episodes.

The server uses only the standard library, since five files and one POST need no framework. So the page works after
every installation. The server is meant for the user's own computer and listens on the loopback address by default.
"""

from __future__ import annotations

import errno
import ipaddress
import json
import os
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import IO, Any

from filelock import FileLock

from hpamdp.env.play_page import EpisodeError, PlayPage
from hpamdp.files import read_regular, regular_size
from hpamdp.json_lines import MAX_LINE_BYTES, LineError, left_out, lines_of, read_json
from hpamdp.messages import one_line, reason_of, warn

DATA_NAME = "data.js"
_EPISODES_PATH = "/episodes"
_MAX_FILE = 1 << 28  # bytes
_PATIENCE = 10.0  # s that a connection may keep silent
_LOCK_PATIENCE = 4.0  # s that an episode waits for the file's lock
_NAME_LENGTH = 200  # letters of the file's name in the name of its lock
_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
}
_HEADERS = {
    # No content from other sites, and no frame of another site. Alone in its process, the page has a finer clock.
    "Content-Security-Policy": "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data:; "
    "frame-ancestors 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Embedder-Policy": "require-corp",
    "Cross-Origin-Resource-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}


def as_script(data: Mapping[str, Any]) -> bytes:
    """Return `data.js`. The data are a script because a page that is opened from a file may load nothing else."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return f"window.HPAMDP_DATA = {text};\n".encode()


class EpisodeFile:
    """A file of episodes, one JSON object per line, to which several threads and processes may add.

    Args:
        path: the file, which is created at the first episode.
        page: the page, which recognises equal episodes.

    Attributes:
        added: the episodes that were added through this object.

    Raises:
        EpisodeError: the file holds no episode, cannot be written, or its folder is missing.
    """

    def __init__(self, path: Path, page: PlayPage) -> None:
        self.path = path
        self.page = page
        self.added: list[Mapping[str, Any]] = []
        self._lock = threading.Lock()
        lock_path = path.parent / f".{path.name[:_NAME_LENGTH]}.lock"
        self._file_lock = FileLock(lock_path)
        self._known: set[str] = set()
        self._read_to = 0  # bytes of the file whose episodes are known
        self._inode: int | None = None
        try:
            if not path.parent.is_dir():
                raise EpisodeError(f"{path}: there is no folder {path.parent}")
            if lock_path.is_symlink():  # it would be emptied
                raise EpisodeError(f"{lock_path}: is a link; remove it")
            self._check_file()
        except OSError as error:
            raise EpisodeError(f"{path}: {reason_of(error)}") from error

    def add(self, episode: Mapping[str, Any]) -> bool:
        """Add a checked episode to the disk, and return whether it is new.

        Raises:
            TimeoutError: another program holds the file's lock.
            OSError: the episode cannot be written; the file is as it was.
        """
        identity = self.page.identity(episode)
        line = json.dumps(episode, separators=(",", ":"), allow_nan=False).encode() + b"\n"
        until = time.monotonic() + _LOCK_PATIENCE
        if not self._lock.acquire(timeout=_LOCK_PATIENCE):
            raise TimeoutError
        try:
            with self._file_lock.acquire(timeout=max(until - time.monotonic(), 0.0)):
                is_new = self._append(identity, line)
                if is_new:
                    self.added.append(episode)
                return is_new
        finally:
            self._lock.release()

    def _append(self, identity: str, line: bytes) -> bool:
        """Add a line, unless its episode is already in the file. The caller must hold both locks."""
        with suppress(FileNotFoundError):
            regular_size(self.path)
        # Without a buffer, nothing remains to be written after an error.
        with self.path.open("a+b", buffering=0) as file:
            size = file.seek(0, os.SEEK_END)
            inode = os.fstat(file.fileno()).st_ino
            if inode != self._inode or size < self._read_to:  # it was replaced, or its lines were removed
                self._known.clear()
                self._read_to, self._inode = 0, inode
            file.seek(self._read_to)
            added = file.read(size - self._read_to)
            self._known |= {identity for _, identity in self._identities(added) if identity is not None}
            self._read_to = size
            if identity in self._known:
                return False
            if size and not _ends_line(file, size):  # a line that was cut short stays a separate line
                line = b"\n" + line
            try:
                if file.write(line) < len(line):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                os.fsync(file.fileno())
            except OSError:
                with suppress(OSError):
                    file.truncate(size)
                raise
            self._read_to = size + len(line)
        self._known.add(identity)
        return True

    def _check_file(self) -> None:
        """Read the file, if it exists, and warn about lines without an episode.

        Raises:
            EpisodeError: no line is an episode.
            OSError: it cannot be read or written.
        """
        is_there = self.path.exists() or self.path.is_symlink()
        data = read_regular(self.path, _MAX_FILE) if is_there else b""
        files = [self.path, Path(self._file_lock.lock_file)]
        for place in dict.fromkeys(file if file.exists() else file.parent for file in files):
            if not os.access(place, os.W_OK):
                raise PermissionError(errno.EACCES, f"{place} cannot be written to")
        if not is_there:
            return
        lines = [*self._identities(data)]
        problems = {number: "no episode" for number, identity in lines if identity is None}
        if lines and not any(self._is_episode(line) for _, line in lines_of(data)):
            raise EpisodeError(f"{self.path}: no line is an episode; take another file")
        if problems:
            warn(f"{self.path}: {left_out(len(lines), problems)}")
        self._known = {identity for _, identity in lines if identity is not None}
        self._inode = self.path.stat().st_ino
        self._read_to = data.rfind(b"\n") + 1  # another server may be about to write the rest of the last line

    def _is_episode(self, line: bytes) -> bool:
        try:
            self.page.check(read_json(line))
        except (LineError, EpisodeError):
            return False
        return True

    def _identities(self, data: bytes) -> Iterator[tuple[int, str | None]]:
        """Yield the number of each line and the identity of its episode, or None if it holds no episode."""
        for number, line in lines_of(data):
            try:
                yield number, self.page.identity(read_json(line))
            except (ValueError, TypeError, KeyError):
                yield number, None


def _ends_line(file: IO[bytes], size: int) -> bool:
    file.seek(size - 1)
    return file.read(1) == b"\n"


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

    daemon_threads = True
    allow_reuse_address = True
    request_queue_size = 128  # with the default of 5, browsers that connect at the same time wait for seconds

    def __init__(
        self, address: tuple[str, int], page: PlayPage, data: Mapping[str, Any], episodes: EpisodeFile
    ) -> None:
        self.page = page
        self.episodes = episodes
        self.contents = {f"/{name}": file.read_bytes() for name, file in page.files.items()}
        self.contents["/"] = self.contents["/index.html"]
        self.contents[f"/{DATA_NAME}"] = as_script(data)
        super().__init__(address, _Handler)
        host, port = str(self.server_address[0]), self.server_port
        self.is_local = ipaddress.ip_address(host).is_loopback
        self.address = f"http://{host}:{port}/"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore a broken connection, and continue to serve the others."""


class _Handler(BaseHTTPRequestHandler):
    """One connection."""

    server: PageServer
    timeout = _PATIENCE
    protocol_version = "HTTP/1.1"
    server_version = "hpamdp"
    sys_version = ""

    def do_GET(self) -> None:
        """Send a file of the page."""
        self._send_file(with_body=True)

    def do_HEAD(self) -> None:
        """Send the headers of a file of the page."""
        self._send_file(with_body=False)

    def do_POST(self) -> None:
        """Check an episode and store it."""
        self.close_connection = True  # the rest of a refused body may remain
        refusal = self._refusal()
        if refusal is not None:
            self._answer(*refusal)
            return
        length = int(self.headers["Content-Length"])
        try:
            body = self.rfile.read(length)
        except OSError:
            return  # the client is gone, or silent
        if len(body) < length:
            self._answer(HTTPStatus.BAD_REQUEST, "the body is shorter than its Content-Length")
            return
        try:
            episode = self.server.page.check(read_json(body))
        except EpisodeError as error:
            self._answer(HTTPStatus.UNPROCESSABLE_ENTITY, str(error))
            return
        except LineError:
            self._answer(HTTPStatus.BAD_REQUEST, "the body is no JSON")
            return
        self._answer(*self._stored(episode))

    def _stored(self, episode: Mapping[str, Any]) -> tuple[HTTPStatus, str]:
        """Store an episode and return the answer."""
        file = self.server.episodes
        try:
            is_new = file.add(episode)
        except TimeoutError:
            held = f"another program holds the lock of {file.path.name}"
            return HTTPStatus.SERVICE_UNAVAILABLE, f"the episode was not stored: {held}"
        except OSError as error:
            return HTTPStatus.INSUFFICIENT_STORAGE, f"the episode was not stored: {reason_of(error)}"
        return HTTPStatus.CREATED if is_new else HTTPStatus.OK, "stored"

    def _refusal(self) -> tuple[HTTPStatus, str] | None:
        """Return the status and the reason if a POST is refused before its body is read, else None."""
        length = self.headers.get("Content-Length", "")
        if not self._is_from_here():
            return HTTPStatus.FORBIDDEN, "only the page itself may send episodes"
        if self.path != _EPISODES_PATH:
            return HTTPStatus.NOT_FOUND, f"nothing takes a POST but {_EPISODES_PATH}"
        if self.headers.get("Transfer-Encoding") is not None or not (length.isascii() and length.isdecimal()):
            return HTTPStatus.LENGTH_REQUIRED, "a Content-Length is required"
        if len(length) > 10 or int(length) > MAX_LINE_BYTES:
            return HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"an episode has at most {MAX_LINE_BYTES} bytes"
        if self.headers.get_content_type() != "application/json":
            return HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "an episode is application/json"
        return None

    def _is_from_here(self) -> bool:
        """Return whether the request comes from the page itself, and not from another site in the browser.

        A request of another site carries its Origin.
        """
        host = self.headers.get("Host", "")
        origin = self.headers.get("Origin")
        # A web server in front of this one may use https.
        return origin is None or origin in (f"http://{host}", f"https://{host}")

    def _send_file(self, *, with_body: bool) -> None:
        if not self._is_from_here():
            self._answer(HTTPStatus.FORBIDDEN, "ask for this page by its own address")
            return
        # The server sends only entries of the dictionary, and never looks up a path on the disk.
        name = self.path.partition("?")[0]
        content = self.server.contents.get(name)
        if content is None:
            is_post = name == _EPISODES_PATH
            status = HTTPStatus.METHOD_NOT_ALLOWED if is_post else HTTPStatus.NOT_FOUND
            self._answer(status, "episodes are sent here, not read" if is_post else "there is no such page")
            return
        self._respond(HTTPStatus.OK, _TYPES[Path(name).suffix or ".html"], content, with_body=with_body)

    def _answer(self, status: HTTPStatus, line: str) -> None:
        self._respond(status, "text/plain; charset=utf-8", f"{one_line(line)[:400]}\n".encode())

    def _respond(self, status: HTTPStatus, content_type: str, content: bytes, *, with_body: bool = True) -> None:
        try:
            self.send_response(status)
            self.send_header("Content-Type", content_type)
            self.send_header("Content-Length", str(len(content)))
            for name, value in _HEADERS.items():
                self.send_header(name, value)
            if self.close_connection:
                self.send_header("Connection", "close")
            self.end_headers()
            if with_body and self.command != "HEAD":
                self.wfile.write(content)
        except OSError:  # the client is gone
            self.close_connection = True

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Refuse other methods and malformed requests in one line, instead of the base class's page."""
        self.close_connection = True
        status = HTTPStatus.METHOD_NOT_ALLOWED if code == HTTPStatus.NOT_IMPLEMENTED else HTTPStatus(code)
        self._answer(status, message or status.phrase)

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing: the terminal shows what the user should see."""
