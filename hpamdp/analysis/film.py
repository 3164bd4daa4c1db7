"""Write films of episodes, as GIF with Pillow or as MP4 with imageio.

Matplotlib's writers are ten times slower, because they draw through a figure. They also need an installed ffmpeg.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image
from torch import Tensor

from hpamdp.env.base import PAMDPEnv
from hpamdp.files import replacing

SUFFIXES = (".gif", ".mp4")
GIF_FPS = 50  # largest number of pictures per second of a GIF
COLUMNS = 3
_PAUSE = 1.5  # seconds for which the last picture stays
_GIF_COLOURS = 128

Track = Sequence[Mapping[str, Tensor]]


class FilmError(ValueError):
    """Raised if a film cannot be written. The message is one line."""


def film(env: PAMDPEnv, tracks: Sequence[Track], fps: float, size: int) -> list[np.ndarray]:
    """Return the pictures of episodes side by side, uint8 `[height, width, 3]`, or none if the problem draws none.

    Args:
        env: the problem, which draws the pictures.
        tracks: the `film_state` of each episode at the start and after every step, columns `[1, ...]`.
        fps: pictures per second.
        size: width of one episode, px.
    """
    episodes = [list(env.film(track, fps, size)) for track in tracks]
    if not episodes or not all(episodes):
        return []
    length = max(map(len, episodes)) + round(_PAUSE * fps)
    columns = min(COLUMNS, len(episodes))
    blank = np.full_like(episodes[0][0], 255)
    pictures = []
    for i in range(length):
        shown = [episode[min(i, len(episode) - 1)] for episode in episodes]
        shown += [blank] * (-len(shown) % columns)
        rows = [np.concatenate(shown[row : row + columns], 1) for row in range(0, len(shown), columns)]
        pictures.append(np.concatenate(rows))
    return pictures


def tracks_of(states: Sequence[Mapping[str, Tensor]], num_steps: int | None = None) -> list[Track]:
    """Return the tracks of each of N episodes.

    Args:
        states: the columns `[N, ...]` at the start and after every step.
        num_steps: largest number of steps in a track. If None, all steps.
    """
    if not states or not states[0]:
        return []
    num = len(next(iter(states[0].values())))
    states = states if num_steps is None else states[: num_steps + 1]
    return [[{name: column[i : i + 1] for name, column in state.items()} for state in states] for i in range(num)]


def write(path: Path, pictures: Iterable[np.ndarray], fps: float) -> None:
    """Write pictures as a GIF that repeats forever or as an MP4, depending on the path's suffix.

    Raises:
        FilmError: the path has another suffix, there is no picture, or imageio is missing.
    """
    remaining = iter(pictures)
    first = next(remaining, None)
    if first is None:
        raise FilmError(f"{path}: there is no picture to write")
    remaining = itertools.chain([first], remaining)
    if path.suffix == ".gif":
        _write_gif(path, remaining, fps)
    elif path.suffix == ".mp4":
        _write_mp4(path, remaining, fps)
    else:
        raise FilmError(f"{path}: must end in {' or '.join(SUFFIXES)}")


def _write_gif(path: Path, pictures: Iterator[np.ndarray], fps: float) -> None:
    images = [Image.fromarray(picture) for picture in pictures]
    # All pictures share one palette, made from three of them, because separate palettes would flicker.
    samples = [np.asarray(images[i]) for i in (0, len(images) // 2, -1)]
    palette = Image.fromarray(np.concatenate(samples)).quantize(_GIF_COLOURS)
    indexed = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    # A GIF counts in hundredths of a second. Viewers show pictures of one hundredth for a tenth of a second.
    hundredths = round(100.0 / min(fps, GIF_FPS))
    with replacing(path) as partial:
        indexed[0].save(partial, save_all=True, append_images=indexed[1:], duration=10 * hundredths, loop=0)


def _write_mp4(path: Path, pictures: Iterator[np.ndarray], fps: float) -> None:
    try:
        import imageio.v2 as imageio
        import imageio_ffmpeg  # noqa: F401  (the encoder; without it imageio fails only when it writes)
    except ImportError as error:
        raise FilmError(f"{path}: imageio is not installed; pip install 'hpamdp[video]', or write a .gif") from error
    encoding = {"fps": fps, "macro_block_size": 2, "codec": "libx264", "quality": 8}
    with replacing(path) as partial, imageio.get_writer(partial, **encoding) as writer:
        for picture in pictures:
            writer.append_data(picture)
