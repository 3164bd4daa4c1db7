"""Films: boats move in closed form between presses, files hold what was drawn, `hpamdp watch` tells mistakes."""

import itertools
import sys

import numpy as np
import pytest
import torch
from PIL import Image, ImageSequence

from hpamdp.analysis import film
from hpamdp.env.boatdock import film as boat_film
from hpamdp.env.boatdock import physics
from hpamdp.run.players import load_agent


def test_a_boat_rests_where_its_press_ends_and_stays_there():
    press = torch.tensor(0.7, dtype=torch.float64)
    total = physics.total_distance(press).item()
    assert physics.distance_at(press, torch.tensor(9.0)).item() == pytest.approx(total, abs=1e-12)
    at_rest = physics.time_at(press, physics.total_distance(press))
    assert at_rest.item() == pytest.approx(1.95 * 0.7, abs=1e-3)


@pytest.fixture(scope="module")
def played():
    player = load_agent(None, ["high=uniform", "low=random", "eval.layouts=8", "film=true"])
    states = []
    return player, player.evaluation().run(player.agent.policy, states), film.tracks_of(states)


def test_boats_move_smoothly_from_their_start_to_their_end(played, monkeypatch):
    _, results, tracks = played
    scenes = []
    monkeypatch.setattr("hpamdp.env.boatdock.rendering.draw", lambda scene, size: scenes.append(scene) or np.zeros(1))
    fastest = physics.speed(torch.tensor(2.0)).item()
    for row, track in enumerate(tracks):
        scenes.clear()
        list(boat_film.film(track, fps=50.0, size=8))
        way = np.array([scene.boat for scene in scenes])
        assert np.linalg.norm(np.diff(way, axis=0), axis=1).max() <= fastest / 50.0 + 1e-4
        assert len({tuple(point) for point in way.round(4)}) > 4
        last = results["path"][row][np.isfinite(results["path"][row]).all(1)][-1]
        np.testing.assert_allclose(way[-1], last, atol=1e-3)
        assert (np.diff([scene.fuel for scene in scenes]) <= 1e-9).all()
        assert scenes[-1].outcome == physics.OUTCOMES[results["outcome"][row]]
        assert scenes[-1].score == pytest.approx(results["score"][row])


def test_the_film_of_an_evaluation_ends_with_the_picture_of_every_end(played):
    player, _, tracks = played
    pictures = list(film.film(player.evaluation().problem, tracks[:4], 10.0, 40))
    assert pictures[0].shape == (80, 120, 3)  # three side by side, the fourth below
    np.testing.assert_array_equal(pictures[-1], pictures[-10])  # the pause
    assert any((one != other).any() for one, other in itertools.pairwise(pictures))


@pytest.mark.parametrize(("problem", "together"), [("sliding", (60, 120, 3)), ("platform", (60, 180, 3))])
def test_other_problems_are_filmed_by_their_own_pictures(problem, together):
    player = load_agent(None, [f"env={problem}", "high=none", "low=random", "eval.layouts=2", "film=true"])
    states = []
    player.evaluation().run(player.agent.policy, states)
    tracks = film.tracks_of(states, num_steps=3)
    assert len(list(player.evaluation().problem.film(tracks[0], 8.0, 60))) == 2 * len(tracks[0])
    assert next(film.film(player.evaluation().problem, tracks, 8.0, 60)).shape == together


def test_a_film_without_pictures_or_of_another_ending_is_refused(tmp_path):
    with pytest.raises(film.NoPictureError, match="no picture"):
        film.write(tmp_path / "a.gif", [], 10.0)
    with pytest.raises(film.FilmError, match=r"must end in \.gif or \.mp4"):
        film.write(tmp_path / "a.avi", [np.zeros((2, 2, 3), np.uint8)], 10.0)


def test_an_mp4_without_imageio_names_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio.v2", None)
    with pytest.raises(film.FilmError, match=r"pip install 'hpamdp\[video\]'"):
        film.write(tmp_path / "a.mp4", [np.zeros((2, 2, 3), np.uint8)], 10.0)


@pytest.mark.parametrize("fps", [7, 29, 50])
def test_a_gif_plays_at_its_mean_rate_in_pictures_of_at_least_two_hundredths_of_a_second(tmp_path, fps):
    striped = np.tile(np.array([0, 200], np.uint8)[:, None], (4, 2, 3))
    film.write(tmp_path / "a.gif", (np.roll(striped, i, 1) for i in range(3 * fps)), float(fps))
    with Image.open(tmp_path / "a.gif") as image:
        assert image.info["loop"] == 0
        durations = [frame.info["duration"] for frame in ImageSequence.Iterator(image)]
    assert len(durations) == 3 * fps and sum(durations) == 3000
    assert min(durations) >= 20 and max(durations) - min(durations) <= 10


class Endless:
    """A problem whose episodes never end, and that notes how many pictures were asked for."""

    film_shape = (1.0, 1.0)

    def __init__(self):
        self.asked = 0

    def film(self, track, fps, size):
        while True:
            self.asked += 1
            yield np.full((size, size, 3), self.asked % 256, np.uint8)


def test_pictures_are_made_when_they_are_asked_for():
    env = Endless()
    pictures = film.film(env, [None, None], 10.0, 20)
    assert next(pictures).shape == (20, 40, 3) and env.asked == 2
    assert len(list(itertools.islice(pictures, 4))) == 4 and env.asked == 10


def test_watch_writes_a_film(tmp_path, command):
    file = tmp_path / "a.gif"
    words = ["high=uniform", "low=random", "--to", str(file), "--episodes", "2", "--size", "60", "--fps", "5"]
    code, out, _ = command("watch", *words)
    assert code == 0 and "2 episodes, scores" in out
    with Image.open(file) as image:
        assert image.size == (120, 60)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "nobody to watch"),
        (["nowhere"], "no checkpoint there"),
        (["low=planner", "--to", "film.avi"], r"must end in .gif or .mp4"),
        (["low=planner", "--fps", "60"], "--fps 60: a GIF shows at most 50 pictures a second; write an .mp4"),
        (
            ["low=planner", "--size", "4096", "--episodes", "4"],
            "--size 4096 --episodes 4: a picture would have 12288 x 8192 px, but at most 8192 px on each side",
        ),
        (
            ["env=platform", "low=random", "high=none", "--size", "3000", "--episodes", "1"],
            "--size 3000 --episodes 1: a picture would have 9000 x 1500 px",
        ),
        (["low=random", "high=none"], "needs a selector"),
    ],
)
def test_watch_tells_a_mistake_in_one_line(command, words, said):
    code, out, err = command("watch", *words)
    assert code == 2 and said in err and err.count("\n") == 1 and not out
