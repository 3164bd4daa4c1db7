"""Make hostile requests to the server of a problem's page: bodies, headers and bytes that no page sends."""

from __future__ import annotations

import json
import random
import socket
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hpamdp.env.boatdock.play import episodes as played
from hpamdp.env.boatdock.play.boat_page import BoatPage
from hpamdp.run.page_server import EpisodeFile, PageServer

from .case import ACCEPTED, HARM, SILENT, Case
from .data_sets import LINES, VALUES, _change, _places, docked

HEADERS = (
    "Host: 127.0.0.1", "Host: evil.example", "Host: [::1", "Host: " + "a" * 70_000, "Origin: null",
    "Origin: http://evil.example", "Content-Length: -1", "Content-Length: 99999999999999999999", "Content-Length: 1e3",
    "Content-Length: \u0663", "Transfer-Encoding: chunked", "Content-Type: text/plain", "Expect: 100-continue",
    "Cookie: " + "x" * 60_000, ": nothing", "\x00: 1", "Content-Type: application/json; charset=utf-16",
)  # fmt: skip
LINES_OF_REQUEST = (
    "GET /../../etc/passwd HTTP/1.1", "GET /%2e%2e/%2e%2e/etc/passwd HTTP/1.1", "GET //etc/passwd HTTP/1.1",
    "POST /episodes/../x HTTP/1.1", "PUT /episodes HTTP/1.1", "DELETE /episodes HTTP/1.1", "GET / HTTP/9.9", "GET",
    "\x16\x03\x01", "GET / HTTP/1.1 extra", "POST /episodes HTTP/1.0", "OPTIONS * HTTP/1.1", "CONNECT x:1 HTTP/1.1",
    "GET /" + "a" * 70_000 + " HTTP/1.1", "get / http/1.1",
)  # fmt: skip


def cases(number: int, seed: int) -> Iterator[Case]:
    """Yield `number` changed episodes, and all strange bodies, headers and lines."""
    chance = random.Random(seed)
    episodes = docked(6)
    for line in LINES:
        yield Case("requests to a page", f"body {line[:30]!r}", _Request(_post(line)), must_be_refused=False)
    for header in HEADERS:
        body = json.dumps(episodes[0]).encode()
        yield Case(
            "requests to a page", f"header {header[:40]!r}", _Request(_post(body, header)), must_be_refused=False
        )
    for line in LINES_OF_REQUEST:
        text = f"{line}\r\nHost: 127.0.0.1\r\n\r\n".encode()
        yield Case("requests to a page", f"line {line[:40]!r}", _Request(text), must_be_refused=False)
    for _ in range(number):
        episode = json.loads(json.dumps(chance.choice(episodes)))
        path = chance.choice([*_places(episode)])
        value = chance.choice([*VALUES, "missing"])
        _change(episode, path, value)
        name = f"{'.'.join(map(str, path))} is {str(value)[:40]!r}"
        body = json.dumps(episode).encode()
        yield Case("requests to a page", name, _Request(_post(body)), must_be_refused=False)


def _post(body: bytes, *headers: str) -> bytes:
    given = {"host": "Host: 127.0.0.1", "content-type": "Content-Type: application/json"}
    given["content-length"] = f"Content-Length: {len(body)}"
    for header in headers:
        given[header.partition(":")[0].lower()] = header
    return "\r\n".join(["POST /episodes HTTP/1.1", *given.values(), "", ""]).encode() + body


@dataclass(frozen=True)
class _Request:
    """Send bytes to a server, which must answer or close, keep its file right, and serve the next request."""

    text: bytes

    def __call__(self, folder: Path) -> str:
        file = folder / "played.jsonl"
        page = BoatPage(seed=0)
        server = PageServer(("127.0.0.1", 0), page, {}, EpisodeFile(file, page))
        server.RequestHandlerClass.timeout = 3.0
        threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        answer = self._send(server, self.text)
        status = answer.split(b"\r\n", 1)[0]
        if b" 500 " in status or b"Traceback" in answer:
            return f"{SILENT}: {status!r}"
        if b"root:" in answer:
            return f"{HARM}: a file of the machine was sent"
        if file.exists():
            try:
                for episode in played.read(file).values():
                    played.check(episode.model_dump(mode="json"))
            except Exception as error:
                return f"{HARM}: the file holds what nobody played: {str(error)[:100]}"
        if b" 200 " not in self._send(server, b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"):
            return f"{HARM}: the server serves no more"
        return ACCEPTED

    def _send(self, server: Any, text: bytes) -> bytes:
        with socket.create_connection(("127.0.0.1", server.server_port), timeout=10.0) as connection:
            answer = b""
            try:
                connection.sendall(text)
                connection.shutdown(socket.SHUT_WR)
                while part := connection.recv(65536):
                    answer += part
            except (ConnectionResetError, BrokenPipeError):
                pass
        return answer
