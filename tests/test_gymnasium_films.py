"""Films of Gymnasium environments show what `render` returns."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from gymnasium_players import step
from PIL import Image
from tensordict import TensorDict

from hpamdp.env.base import ProblemError
from hpamdp.env.gymnasium.environment import GymnasiumEnv

ENTRY_POINT = "toy_environments:Drawn"
WORDS = ["high=none", "env=gymnasium", f"env.entry_point={ENTRY_POINT}", "env.max_steps=4"]


def grey(picture: np.ndarray) -> int:
    return int(picture[len(picture) // 2, len(picture) // 2, 0])


@pytest.mark.parametrize("num_workers", [0, pytest.param(2, marks=pytest.mark.slow)])
def test_a_film_has_the_pictures_of_render_at_their_own_speed(num_workers):
    kwargs = {"render_mode": "rgb_array"}
    env = GymnasiumEnv(3, entry_point=ENTRY_POINT, kwargs=kwargs, max_steps=4, num_workers=num_workers)
    env.reset()
    track = [env.film_state(2)]
    for _ in range(2):
        step(env)
        track.append(env.film_state(2))
    assert track[0]["picture"].shape == (2, 320, 320, 3)
    pictures = list(env.film([{"picture": state["picture"][1:]} for state in track], fps=20.0, size=100))
    assert [grey(picture) for picture in pictures] == [0, 0, 100, 100, 200, 200]
    assert pictures[0].shape == (100, 100, 3) and pictures[0][0, 0].tolist() == [255, 255, 255]
    env.close()


def test_pictures_of_different_sizes_are_filmed_on_white(tmp_path, command):
    kwargs = {"render_mode": "rgb_array", "varies": True}
    env = GymnasiumEnv(2, entry_point=ENTRY_POINT, kwargs=kwargs, max_steps=4)
    env.reset()
    step(env)
    env.reset(TensorDict({"_reset": torch.tensor([[True], [False]])}, [2]))
    small, large = env.film_state(2)["picture"].numpy()
    for picture, shade in ((small, 0), (large, 100)):
        assert picture.shape == (80, 80, 3) and (picture[20:60] == shade).all()
        assert (picture[:20] == 255).all() and (picture[60:] == 255).all()
    words = [*WORDS, "env.kwargs={render_mode:rgb_array,varies:true}", "low=random", "num_envs=2", "steps_per_batch=4"]
    code, _, err = command(*words, "total_frames=8", "eval.layouts=2")
    assert code == 0, err


@pytest.mark.parametrize("rate", [10, 60])
@pytest.mark.parametrize("fps", [20.0, 25.0])
def test_the_last_picture_is_shown_however_fast_the_environment_is(rate, fps):
    env = GymnasiumEnv(entry_point=ENTRY_POINT, kwargs={"render_mode": "rgb_array"}, max_steps=4)
    env._copies.pictures_per_second = float(rate)
    for num in range(1, 22):
        track = [{"picture": torch.full((1, 4, 4, 3), shade, dtype=torch.uint8)} for shade in range(num)]
        shades = [grey(picture) for picture in env.film(track, fps, 20)]
        assert shades[-1] == num - 1 and shades == sorted(shades)
        assert -0.5 <= len(shades) - fps * num / rate <= 1.5


def test_something_else_than_a_picture_is_told_in_one_line():
    env = GymnasiumEnv(entry_point=ENTRY_POINT, kwargs={"render_mode": "rgb_array", "is_wrong": True}, max_steps=4)
    env.reset()
    with pytest.raises(
        ProblemError, match=r"Drawn: environment 0: render returned an array of float64 \[2, 2\], not a"
    ):
        env.film_state(1)


def test_watch_films_an_environment_of_ones_own(command, tmp_path):
    code, out, err = command("watch", "low=random", *WORDS, "env.kwargs={render_mode:rgb_array}", "--episodes", "2")
    assert code == 0 and not err and "2 episodes" in out
    with Image.open(tmp_path / "episodes.gif") as image:
        assert image.n_frames > 4 and image.size == (640, 320)
    code, _, err = command("watch", "low=random", *WORDS)
    assert code == 2 and err.count("\n") == 1 and "has no pictures to film" in err
