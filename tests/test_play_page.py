"""What the pages' scripts do, in node with stand-ins for the browser; `test_play_browser.py` has a real one."""

import base64
import json
import shutil
import subprocess
from pathlib import Path

import pytest

from hpamdp.env.boatdock.play import boat_page
from hpamdp.env.boatdock.play.boat_page import BoatPage
from hpamdp.env.boatdock_unseen.options import UnseenBoatsOptions
from hpamdp.env.boatdock_unseen.play.session_page import SessionPage
from hpamdp.env.play_page import EpisodeError

NODE = shutil.which("node")
pytestmark = pytest.mark.skipif(NODE is None, reason="needs node")
SCRIPTS = ("physics.js", "network.js", "game.js", "boats.js", "sessions.js")


def at_page(page, data, script, tmp_path):
    """Open a page in node and return what `script`, the body of an async function, returns of its player `p`."""
    (tmp_path / "data.json").write_text(json.dumps(data))
    files = [str(page.files[name]) for name in SCRIPTS if name in page.files]
    boats = ["congruent", "incongruent"] if isinstance(page, BoatPage) else ["0", "1"]
    source = f"""
        const {{ openPage }} = require({str(Path(__file__).parent / "page_stand_in.js")!r});
        const data = JSON.parse(require("fs").readFileSync({str(tmp_path / "data.json")!r}));
        const p = openPage(data, {json.dumps(files)}, {{ boats: {json.dumps(boats)} }});
        (async () => {{ {script} }})().then((found) => console.log(JSON.stringify(found)));
    """
    ended = subprocess.run([NODE, "-e", source], capture_output=True, text=True, timeout=60)
    assert ended.returncode == 0, ended.stderr
    return json.loads(ended.stdout)


@pytest.fixture
def boats(monkeypatch):
    """A page without rounds, whose plans take long."""
    monkeypatch.setattr(boat_page, "NUM_BLOCKS", 0)
    return BoatPage(seed=0)


def layer(inputs, outputs):
    """Return a layer of zeros in the form of `exported`."""
    zeros = lambda num: base64.b64encode(bytes(4 * num)).decode()  # noqa: E731
    return {"in": inputs, "out": outputs, "weight": zeros(inputs * outputs), "bias": zeros(outputs)}


def agent(name, title="hppo", **which):
    """Return an agent of the page that presses key 1 for a second, whatever it observes."""
    learner = {"encoder": [layer(16, 4)], "discrete": layer(4, 3), "parameters": layer(4, 3)}
    form = {"learners": [{**learner, "low": [0.0] * 3, "high": [2.0] * 3}], "selector": None, "is_shared": False}
    return {"name": name, "title": title, "score": None, "env": {"controller": "congruent"}, "agent": form, **which}


def test_an_episode_is_recorded_before_agents_sail_beside_it(tmp_path, boats):
    broken = agent("broken")
    broken["agent"]["learners"][0]["discrete"] = {**layer(4, 3), "out": 0}  # presses a key that is none
    data = boats.data([broken], has_server=True)
    script = """
        p.agree();
        p.start("free");
        let error = null;
        try { p.sail("congruent"); } catch (thrown) { error = thrown.message; }
        await p.settle();
        return { error, sent: p.sent };
    """
    found = at_page(boats, data, script, tmp_path)
    assert found["error"] is not None and len(found["sent"]) == 1
    assert boats.check(found["sent"][0])["controller"] == "congruent"


def test_a_refusal_is_told_until_its_episode_is_downloaded(tmp_path, boats):
    script = """
        p.agree();
        p.answers.push({ status: 422, text: "mode: Field required" }, new Error("Failed to fetch"));
        const told = [];
        const note = () => told.push([p.text("#notice"), p.asksBeforeClosing()]);
        p.start("free");
        for (const later of [false, false, true]) {
          p.sail("congruent");
          await p.settle({ later });
          note();
          p.click("#next");
        }
        p.click("#finish");
        p.click("#download");
        note();
        return { told, sent: p.game.sent };
    """
    found = at_page(boats, boats.data([], has_server=True), script, tmp_path)
    refused = "1 episode was refused (mode: Field required). Finish, and download the episodes to keep it."
    assert found["told"] == [
        [refused, True],
        [f"{refused} 1 episode waits for the server (Failed to fetch). You can go on playing.", True],
        [refused, True],
        ["", False],
    ]
    assert found["sent"] == 2


def test_trips_before_the_player_agrees_are_never_recorded(tmp_path):
    page = SessionPage(seed=0, options=UnseenBoatsOptions(trips=3))
    script = """
        const counts = [];
        for (const changes of [[false, true], [true, false, true], [true, false]]) {
          for (let trip = 0; trip < 3; trip++) {
            p.agree(changes[Math.min(trip, changes.length - 1)]);
            p.start("session");
            p.sail(null);
            p.click("#finish");
            p.click("#again");
          }
          counts.push(p.game.stored.length);
        }
        p.agree();
        p.start("session");
        for (let trip = 0; trip < 3; trip++) {
          p.sail(null);
          p.click("#next");
        }
        counts.push(p.game.stored.length);
        await p.settle();
        return { counts, trips: p.game.results.session.length, sent: p.sent };
    """
    found = at_page(page, page.data([], has_server=True), script, tmp_path)
    assert found["counts"] == [0, 0, 0, 1] and found["trips"] == 12
    assert [page.check(each)["index"] for each in found["sent"]] == [0]


def test_agents_of_one_kind_are_told_apart(tmp_path, boats):
    crew = [agent("a"), agent("b"), agent("c", "pdqn"), agent("b")]
    script = """
        p.start("free");
        p.sail("congruent");
        const beside = p.text("#result");
        p.click("#finish");
        return { beside, table: p.text("#end-table") };
    """
    found = at_page(boats, boats.data(crew, has_server=True), script, tmp_path)
    for name in ("hppo, congruent (a)", "hppo, congruent (b), 2", "hppo, congruent (b), 4", "pdqn, congruent"):
        assert f"<td>{name}</td>" in found["table"]
        assert f"</span>{name}: " in found["beside"]


def test_each_agent_has_a_colour_of_its_own_and_more_agents_are_refused(tmp_path, boats):
    crew = [agent(f"a{number}") for number in range(boat_page.MOST_AGENTS)]
    script = """
        p.start("free");
        p.sail("congruent");
        return p.text("#result").match(/border-color:[^;]+/g);
    """
    colours = at_page(boats, boats.data(crew, has_server=True), script, tmp_path)
    assert len(set(colours)) == len(colours) == 2 + boat_page.MOST_AGENTS  # the player and the plan
    with pytest.raises(EpisodeError, match=r"^a8: the page tells at most 8 agents apart, and this is number 9$"):
        boats.data([*crew, agent("a8")], has_server=True)
