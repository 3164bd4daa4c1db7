"""The page in a real browser, by its own key, touch and focus events; skipped where there is no Chromium
(Debian: `apt-get install chromium`) or no Playwright (`hpamdp[browser]`)."""

import json
import shutil
import statistics
import time

import pytest
from test_page_server import serving

from hpamdp.commands.play import export
from hpamdp.env.boatdock.play import episodes
from hpamdp.env.boatdock.play.boat_page import BoatPage
from hpamdp.env.boatdock_unseen.options import UnseenBoatsOptions
from hpamdp.env.boatdock_unseen.play.session_page import SessionPage

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright")
pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")]

KEYS = "jkl"
DOWN_THE_MIDDLE = {"start": [0, 60], "goal": [0, -60]}  # key 2 of the congruent controller (K) goes there


@pytest.fixture(scope="module")
def browser():
    with sync_api.sync_playwright() as playwright:
        launched = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield launched
        launched.close()


@pytest.fixture(scope="module")
def page_data():
    return BoatPage(seed=0).data([], has_server=True)


class Player:
    """Somebody at the page."""

    def __init__(self, context, address, *, consents=True, mode="free"):
        self.page = context.new_page()
        self.keyboard = context.new_cdp_session(self.page)
        self.errors = []
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.goto(address)
        if consents:
            self.page.check("#consent")
        self.page.click(f"[data-mode={mode}]")

    def get(self, expression):
        return self.page.evaluate(f"hpamdpGame.{expression}")

    def until(self, expression, seconds=8.0):
        """Wait; the page's policy forbids what Playwright waits with."""
        deadline = time.monotonic() + seconds
        while not self.get(expression):
            assert time.monotonic() < deadline, (expression, self.get("screen"), self.page.inner_text("#notice"))
            time.sleep(0.02)

    def board(self, boat="congruent", layout=None):
        """Choose a boat, and put the episode on another layout before."""
        self.until("screen === 'choose'")
        if layout is not None:
            self.page.evaluate("(layout) => Object.assign(hpamdpGame.layout, layout)", layout)
        self.page.click(f"[data-boat={boat}]")

    def send(self, kind, key, time_):
        """Tell the browser of a key, and when the system saw it (s since 1970); the page gets this time."""
        event = {"type": kind, "timestamp": time_, "code": f"Key{key.upper()}", "key": key}
        self.keyboard.send("Input.dispatchKeyEvent", {**event, "windowsVirtualKeyCode": ord(key.upper())})

    def hold(self, key, seconds, begun=None):
        """Hold a key for exactly so long, however busy this machine is, and return when it was released."""
        begun = time.time() if begun is None else begun
        self.send("keyDown", key, begun)
        time.sleep(max(0.0, begun + seconds - time.time()))
        self.send("keyUp", key, begun + seconds)
        return begun + seconds

    def ends(self):
        self.until("screen === 'result'")
        return self.get("results.free.at(-1)") if self.get("mode") == "free" else self.get("results.round.at(-1)")


@pytest.fixture
def player(browser, page_data, tmp_path):
    with serving(tmp_path / "played.jsonl", data=page_data) as server:
        context = browser.new_context(viewport={"width": 1100, "height": 900})
        one = Player(context, server.address)
        one.file = tmp_path / "played.jsonl"
        yield one
        assert one.errors == []
        context.close()


def stored(player, num):
    deadline = time.monotonic() + 5.0
    while time.monotonic() < deadline:
        lines = player.file.read_text().splitlines() if player.file.exists() else []
        if len(lines) >= num:
            return [json.loads(line) for line in lines]
        time.sleep(0.02)
    raise AssertionError(f"{len(lines)} episodes instead of {num}: {player.page.inner_text('#notice')}")


def test_the_boat_moves_while_a_key_is_down_glides_when_it_is_released_and_docks(player):
    player.board(layout=DOWN_THE_MIDDLE)
    begun = time.time()
    player.send("keyDown", "k", begun)
    places = []
    while time.time() - begun < 0.8:
        places.append(player.get("state && hpamdpGame.state.y"))
        time.sleep(0.02)
    moving = [y for y in places if y is not None]
    assert len(set(moving)) > 5 and moving == sorted(moving, reverse=True) and moving[-1] < moving[0] - 5.0
    assert player.get("state.isPressed")
    time.sleep(max(0.0, 1.23 - (time.time() - begun)))
    player.send("keyUp", "k", begun + 1.23)
    released = player.get("state.y")
    result = player.ends()
    assert result["outcome"] == "success" and result["score"] > 3.5
    assert player.get("state.y") < released - 10.0  # it glided
    (episode,) = stored(player, 1)
    assert episodes.check(episode).outcome == "success"


def test_durations_are_those_of_the_keys_within_five_milliseconds_however_late_the_page_hears_of_them(player):
    wanted = [0.05, 0.12, 0.2, 0.3, 0.08, 0.25] * 4
    player.board(layout=DOWN_THE_MIDDLE)
    for turn, seconds in enumerate(wanted):
        begun = time.time()
        player.send("keyDown", KEYS[turn % 3], begun)
        time.sleep(max(0.0, begun + seconds + 0.02 - time.time()))
        player.send("keyUp", KEYS[turn % 3], begun + seconds)
        time.sleep(0.03)
    found = [press["duration"] for press in player.page.evaluate("hpamdpGame.state.presses")]
    num = len(found) - 1  # the last one may have run the tank dry
    errors = [abs(one - other) for one, other in zip(found[:num], wanted[:num], strict=True)]
    assert num > 15 and statistics.median(errors) < 0.005, sorted(errors)
    print(f"durations: median error {1e3 * statistics.median(errors):.2f} ms, largest {1e3 * max(errors):.2f} ms")


def test_a_new_press_ends_the_one_before_and_a_lost_focus_ends_it_too(player):
    player.board(layout=DOWN_THE_MIDDLE)
    begun = time.time()
    player.send("keyDown", "j", begun)
    time.sleep(0.2)
    player.send("keyDown", "l", begun + 0.2)  # while the other is down
    time.sleep(0.2)
    player.send("keyUp", "j", begun + 0.4)
    time.sleep(0.1)
    told = time.time()
    player.page.evaluate("window.dispatchEvent(new Event('blur'))")
    lost = time.time()
    time.sleep(0.3)
    player.send("keyUp", "l", time.time())
    player.until("state.presses.length === 2")
    first, second = player.page.evaluate("hpamdpGame.state.presses")
    assert (first["key"], second["key"]) == (0, 2)
    assert second["start"] == pytest.approx(first["start"] + first["duration"], abs=1e-6)
    assert first["duration"] == pytest.approx(0.2, abs=0.005)
    assert told - 0.005 < begun + 0.2 + second["duration"] < lost + 0.005
    assert player.get("events.map((event) => event.type)") == ["down", "down", "up", "blur", "up"]


def test_auto_repeat_is_no_press(player):
    player.board(layout=DOWN_THE_MIDDLE)
    for _ in range(5):
        player.page.keyboard.down("k")  # from the second on the browser calls it a repeat
        time.sleep(0.05)
    player.page.keyboard.up("k")
    assert player.get("events.length") == 2


def test_fingers_steer_on_a_narrow_screen_on_which_everything_fits(browser, page_data, tmp_path):
    with serving(tmp_path / "played.jsonl", data=page_data) as server:
        context = browser.new_context(viewport={"width": 390, "height": 740}, has_touch=True, is_mobile=True)
        player = Player(context, server.address)
        player.board(layout=DOWN_THE_MIDDLE)
        assert player.page.evaluate("document.documentElement.scrollWidth") <= 390
        box = player.page.locator(".key[data-key='1']").bounding_box()
        assert box["y"] + box["height"] <= 740 and box["width"] > 90
        touch = context.new_cdp_session(player.page)
        point = {"x": box["x"] + box["width"] / 2, "y": box["y"] + box["height"] / 2}
        begun = time.time()
        touch.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": [point], "timestamp": begun})
        time.sleep(max(0.0, begun + 1.22 - time.time()))
        touch.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": [], "timestamp": begun + 1.22})
        assert player.ends()["outcome"] == "success"
        assert player.get("stored[0].events.map((event) => event.code)") == ["pointer", "pointer"]
        context.close()


def test_the_exported_page_plays_from_files_and_gives_its_episodes_as_a_file(browser, tmp_path):
    page = BoatPage(seed=0)
    export(page, page.data([], has_server=False), tmp_path / "site")
    context = browser.new_context(accept_downloads=True)
    player = Player(context, (tmp_path / "site" / "index.html").as_uri())
    player.board(layout=DOWN_THE_MIDDLE)
    player.hold("k", 1.8)
    player.ends()
    player.page.click("#finish")
    with player.page.expect_download() as download:
        player.page.click("#download")
    download.value.save_as(tmp_path / "mine.jsonl")
    (episode,) = episodes.read(tmp_path / "mine.jsonl").values()
    assert episodes.check(episode.model_dump(mode="json")).outcome == "too_fast" and player.errors == []
    context.close()


@pytest.mark.parametrize("boats", [1, 2])
def test_a_session_shows_where_its_boats_keys_push_only_when_it_is_over_and_is_stored_then(browser, tmp_path, boats):
    page = SessionPage(seed=0, options=UnseenBoatsOptions(trips=2, boats=boats, family="strength"))
    with serving(tmp_path / "played.jsonl", page, page.data([], has_server=True)) as server:
        context = browser.new_context(viewport={"width": 1100, "height": 900})
        player = Player(context, server.address, mode="session")
        player.file = tmp_path / "played.jsonl"
        shown = lambda: player.page.locator("main svg").count()  # noqa: E731
        for trip in range(2):
            assert player.page.inner_text("#status").startswith(f"Session 1, trip {trip + 1} of 2") and shown() == 0
            if boats == 2:
                player.page.keyboard.press("fs"[trip])
            player.until("screen === 'sail'")
            assert shown() == 0
            player.hold("j", 0.03)  # lasts 0.15 s all the same
            player.until("state?.legs.length === 1 && !hpamdpGame.state.isPressed")
            released = time.time()
            for turn in range(30):
                if player.get("screen") == "result":
                    break
                released = player.hold(KEYS[turn % 3], 1.4, released + 0.02)
            player.until("screen === 'result'")
            if trip == 0:
                assert shown() == 0 and not player.file.exists()
                player.page.keyboard.press("Enter")
        assert shown() == boats and "The session is over" in player.page.inner_text("#result")
        (session,) = stored(player, 1)
        assert page.check(session) == session and [trip["boat"] for trip in session["trips"]] == [0, boats - 1]
        assert all(trip["presses"][0]["duration"] == pytest.approx(0.15) for trip in session["trips"])
        player.page.keyboard.press("Enter")
        assert player.page.locator("#end-table tr").count() == 4  # head, two trips, note
        player.page.click("#go-on")
        assert player.page.inner_text("#status").startswith("Session 2, trip 1 of 2") and shown() == 0
        assert player.get("session.boats[0].number") != session["boats"][0]["number"]
        assert player.errors == []
        context.close()
