"""The server of a page: what it serves, what it stores, and all that it refuses."""

import http.client
import json
import resource
import socket
import socketserver
import threading
import urllib.request
from contextlib import contextmanager

import pytest
from play_players import docked

from hpamdp.commands.page_server import EpisodeFile, PageServer
from hpamdp.env.boatdock.play.boat_page import BoatPage
from hpamdp.env.boatdock_unseen.play.session_page import SessionPage
from hpamdp.env.play_page import EpisodeError

EPISODES = docked(6)
JSON = {"Content-Type": "application/json"}


@contextmanager
def serving(path, page=None, data=None):
    """Serve a page, that of people's two boats unless another is given, and store its episodes in a file."""
    page = BoatPage(seed=0) if page is None else page
    server = PageServer(("127.0.0.1", 0), page, {"answer": 42} if data is None else data, EpisodeFile(path, page))
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    with serving(tmp_path_factory.mktemp("played") / "played.jsonl") as running:
        yield running


def ask(server, method, path, body=None, headers=None):
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=10)
    try:
        connection.request(method, path, body, headers or {})
        answer = connection.getresponse()
        return answer.status, answer.read().decode(), answer
    finally:
        connection.close()


def send(server, episode, **headers):
    return ask(server, "POST", "/episodes", json.dumps(episode), {**JSON, **headers})


def raw(server, text):
    """Send bytes and return what comes back."""
    with socket.create_connection(("127.0.0.1", server.server_port), timeout=10) as connection:
        connection.sendall(text)
        connection.shutdown(socket.SHUT_WR)
        answer = b""
        try:
            while part := connection.recv(65536):
                answer += part
        except ConnectionResetError:
            pass
        return answer.decode(errors="replace")


def test_the_page_and_its_data_are_served(server):
    status, text, answer = ask(server, "GET", "/")
    assert status == 200 and "game.js" in text and answer.headers["Cross-Origin-Opener-Policy"] == "same-origin"
    assert ask(server, "GET", "/data.js")[1] == 'window.HPAMDP_DATA = {"answer":42};\n'
    for name in BoatPage.files:
        assert ask(server, "GET", f"/{name}?version=1")[0] == 200


def test_the_page_names_no_other_site():
    for file in (BoatPage.files | SessionPage.files).values():
        text = file.read_text()
        assert "https://" not in text and "//cdn" not in text
        assert [line for line in text.splitlines() if "http://" in line and "www.w3.org" not in line] == []


def test_an_episode_is_stored_once_however_often_it_is_sent(tmp_path):
    with serving(tmp_path / "a.jsonl") as server:
        assert [send(server, episode)[0] for episode in EPISODES[:2]] == [201, 201]
        assert send(server, EPISODES[0])[0] == 200
    with serving(tmp_path / "a.jsonl") as server:  # and after a new start
        assert send(server, EPISODES[1])[0] == 200 and send(server, EPISODES[2])[0] == 201
    lines = (tmp_path / "a.jsonl").read_text().splitlines()
    assert [json.loads(line) for line in lines] == EPISODES[:3]


def test_two_pages_at_once_lose_nothing(tmp_path):
    first, second = docked(8, player="a" * 16), docked(8, player="b" * 16)
    with serving(tmp_path / "a.jsonl") as one, serving(tmp_path / "a.jsonl") as other:
        jobs = [
            threading.Thread(target=lambda page=page, server=server: [send(server, episode) for episode in page])
            for page, server in ((first, one), (second, other))
        ]
        for job in jobs:
            job.start()
        for job in jobs:
            job.join()
    stored = [json.loads(line) for line in (tmp_path / "a.jsonl").read_text().splitlines()]
    found = {(episode["player"], episode["index"]) for episode in stored}
    assert len(stored) == 16 and found == {(player * 16, index) for player in "ab" for index in range(8)}


def test_a_line_that_was_cut_short_stays_one_line(tmp_path):
    path = tmp_path / "a.jsonl"
    path.write_text(json.dumps(EPISODES[0]) + "\n" + json.dumps(EPISODES[1])[:50])
    with serving(path) as server:
        assert send(server, EPISODES[1])[0] == 201
    lines = path.read_text().splitlines()
    assert [json.loads(lines[0]), json.loads(lines[2])] == EPISODES[:2] and len(lines) == 3


@pytest.mark.parametrize("text", ["dear diary", "{}", "\0\0\0"])
def test_a_file_without_an_episode_is_refused_and_left_as_it_is(tmp_path, text, command):
    path = tmp_path / "notes.txt"
    path.write_text(text)
    with pytest.raises(EpisodeError, match="no line is an episode; take another file"):
        EpisodeFile(path, BoatPage(seed=0))
    assert path.read_text() == text and [*tmp_path.iterdir()] == [path]


def test_two_servers_store_an_episode_once(tmp_path):
    path = tmp_path / "a.jsonl"
    with serving(path) as one, serving(path) as other:
        assert [send(server, EPISODES[0])[0] for server in (one, other, one)] == [201, 200, 200]
        assert [send(server, EPISODES[1])[0] for server in (other, one)] == [201, 200]
        path.rename(tmp_path / "kept.jsonl")  # and a file that is taken away begins again
        assert send(one, EPISODES[0])[0] == 201
    assert len(path.read_text().splitlines()) == 1 and len((tmp_path / "kept.jsonl").read_text().splitlines()) == 2


@pytest.mark.parametrize("after", [0, 500])
def test_a_disk_that_is_full_in_the_middle_of_a_line_leaves_the_file_as_it_was(tmp_path, after):
    path = tmp_path / "a.jsonl"
    with serving(path) as server:
        assert send(server, EPISODES[0])[0] == 201
        before = path.read_bytes()
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) + after, limits[1]))  # as a full disk: a short write
        try:
            status, text, _ = send(server, EPISODES[1])
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert status == 507 and text.startswith("the episode was not stored: ") and path.read_bytes() == before
        assert send(server, EPISODES[1])[0] == 201
    assert [json.loads(line) for line in path.read_text().splitlines()] == EPISODES[:2]


@pytest.mark.parametrize(
    "path",
    [
        *("/../../etc/passwd", "/..%2f..%2fetc%2fpasswd", "//etc/passwd", "/page/../../boat_page.py"),
        *("/.", "/..", "/boat_page.py", "/played.jsonl", "/episodes"),
    ],
)
def test_nothing_but_the_files_of_the_page_is_sent(server, path):
    status, text, _ = ask(server, "GET", path)
    assert status == 404 and text.count("\n") == 1


@pytest.mark.parametrize(
    ("body", "headers", "status"),
    [
        ("{}", {"Content-Type": "text/plain"}, 415),  # as a form of another site could send
        ("{" * 50_000, JSON, 400),
        (json.dumps({**EPISODES[0], "score": 4.9}), JSON, 422),
    ],
)
def test_what_is_no_episode_is_refused_in_a_line(server, body, headers, status):
    found, text, _ = ask(server, "POST", "/episodes", body, headers)
    assert found == status and text.count("\n") == 1 and len(text) < 500
    assert server.episodes.path.read_bytes() == b""


def test_an_oversized_episode_is_refused_before_it_is_read(server):
    head = f"POST /episodes HTTP/1.1\r\nHost: localhost:{server.server_port}\r\nContent-Type: application/json\r\n"
    assert " 413 " in raw(server, f"{head}Content-Length: 99999999\r\n\r\n".encode())
    assert " 411 " in raw(server, f"{head}Transfer-Encoding: chunked\r\n\r\n5\r\nhello\r\n0\r\n\r\n".encode())


def test_the_page_is_written_as_files_that_need_no_server(tmp_path, monkeypatch, command):
    monkeypatch.setattr("hpamdp.env.boatdock.play.boat_page.NUM_BLOCKS", 1)
    code, out, _ = command("play", "--export", str(tmp_path / "site"), "--agent", "none")
    assert code == 0 and "index.html" in out
    assert {file.name for file in (tmp_path / "site").iterdir()} == {*BoatPage.files, "data.js"}
    script = (tmp_path / "site" / "data.js").read_text()
    data = json.loads(script.removeprefix("window.HPAMDP_DATA = ").rstrip(";\n"))
    assert data["has_server"] is False and len(data["layouts"]["round"]) == 60


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["env=platform"], "there is no page"),
        (["env.slip=0.5"], "env: BoatDockEnv: slip=0.5, but the page has 0.0"),
        (
            ["--agent", "hppo_hard_move_8"],
            "--agent hppo_hard_move_8: was trained on env=hard_move, but the page is of env=boatdock\n",
        ),
    ],
)
def test_play_tells_a_mistake_in_one_line(monkeypatch, command, words, said):
    monkeypatch.setattr("hpamdp.env.boatdock.play.boat_page.NUM_BLOCKS", 0)
    code, _, err = command("play", *words)
    assert code == 2 and said in err and err.count("\n") == 1


@pytest.mark.parametrize(("host", "is_told"), [("localhost", False), ("0.0.0.0", True)])
def test_only_an_address_that_others_reach_is_warned_of(tmp_path, monkeypatch, command, host, is_told):
    monkeypatch.setattr("hpamdp.env.boatdock.play.boat_page.NUM_BLOCKS", 0)
    asked = []

    def serve_until_interrupted(server, poll_interval):
        thread = threading.Thread(target=socketserver.BaseServer.serve_forever, args=(server, 0.02), daemon=True)
        thread.start()
        with urllib.request.urlopen(server.address) as answer:
            asked.append(answer.status)
        server.shutdown()
        thread.join()
        raise KeyboardInterrupt

    monkeypatch.setattr(PageServer, "serve_forever", serve_until_interrupted)
    words = ["--agent", "none", "--no-browser", "--port", "0", "--host", host, "--to", str(tmp_path / "a.jsonl")]
    code, _, err = command("play", *words)
    assert code == 0 and asked == [200] and ("others who reach this address" in err) == is_told
