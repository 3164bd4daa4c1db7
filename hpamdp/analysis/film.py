"""Write films of episodes, as GIF with Pillow or as MP4 with imageio.

Matplotlib's writers are ten times slower, because they draw through a figure. They also need an installed ffmpeg.
"""

from __future__ import annotations

import itertools
import zlib
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
MOST_FPS = 240
MOST_PIXELS = 8192  # from edge to edge of a film
_PAUSE = 1.5  # seconds for which the last picture stays
_GIF_COLOURS = 128

Track = Sequence[Mapping[str, Tensor]]


class FilmError(ValueError):
    """Raised if a film cannot be written. The message is one line."""


class NoPictureError(FilmError):
    """Raised if there is no picture to write."""


class TooLargeError(FilmError):
    """Raised if the pictures would be too large. The message lacks the sizes that were asked for."""


def film(env: PAMDPEnv, tracks: Sequence[Track], fps: float, size: int) -> Iterator[np.ndarray]:
    """Yield the pictures of episodes side by side, uint8 `[height, width, 3]`, or none if the problem draws none.

    A row is at most `COLUMNS * size` px wide, so strips three times as wide as `size` have a row each.

    Args:
        env: the problem, which draws the pictures.
        tracks: the `film_state` of each episode at the start and after every step, columns `[1, ...]`.
        fps: pictures per second.
        size: height and width of one episode whose pictures are square, px.

    Raises:
        TooLargeError: a picture would have more than `MOST_PIXELS` on a side.
    """
    if not tracks:
        return
    width, height = (round(edge * size) for edge in env.film_shape)
    columns = min(max(1, COLUMNS * size // width), len(tracks))
    rows = -(-len(tracks) // columns)
    if max(rows * height, columns * width) > MOST_PIXELS:
        raise TooLargeError(
            f"a picture would have {columns * width} x {rows * height} px, but at most {MOST_PIXELS} px on each side "
            "are possible"
        )
    episodes = [iter(env.film(track, fps, size)) for track in tracks]
    shown = [picture for episode in episodes if (picture := next(episode, None)) is not None]
    if len(shown) < len(episodes):
        return
    while True:
        together = _side_by_side(shown, rows, columns)
        yield together
        following = [next(episode, None) for episode in episodes]
        if all(picture is None for picture in following):
            break
        # An episode that is over keeps its last picture.
        shown = [last if new is None else new for last, new in zip(shown, following, strict=True)]
    yield from itertools.repeat(together, round(_PAUSE * fps))


def _side_by_side(pictures: Sequence[np.ndarray], rows: int, columns: int) -> np.ndarray:
    blank = np.full_like(pictures[0], 255)
    shown = [*pictures, *[blank] * (rows * columns - len(pictures))]
    return np.concatenate([np.concatenate(shown[row * columns : (row + 1) * columns], 1) for row in range(rows)])


def tracks_of(states: Sequence[Mapping[str, Tensor]], num_steps: int | None = None) -> list[Track]:
    """Return the track of each of N episodes.

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
        NoPictureError: there is no picture.
        FilmError: the path has another suffix, or imageio is missing.
    """
    remaining = iter(pictures)
    first = next(remaining, None)
    if first is None:
        raise NoPictureError(f"{path}: there is no picture to write")
    remaining = itertools.chain([first], remaining)
    if path.suffix == ".gif":
        _write_gif(path, remaining, fps)
    elif path.suffix == ".mp4":
        _write_mp4(path, remaining, fps)
    else:
        raise FilmError(f"{path}: must end in {' or '.join(SUFFIXES)}")


def _write_gif(path: Path, pictures: Iterator[np.ndarray], fps: float) -> None:
    # All pictures share one palette, made from three of them, because separate palettes would flicker. Until the last
    # picture is there, they wait in memory. Compressed, drawn ones take a fiftieth of their size.
    kept: list[bytes] = []
    shape: tuple[int, ...] = ()
    for picture in pictures:
        shape = picture.shape
        compressed = zlib.compress(picture.tobytes(), 1)
        # The same object takes no further memory.
        kept.append(kept[-1] if kept and compressed == kept[-1] else compressed)

    def restored(number: int) -> np.ndarray:
        return np.frombuffer(zlib.decompress(kept[number]), np.uint8).reshape(shape)

    samples = [restored(number) for number in (0, len(kept) // 2, -1)]
    palette = Image.fromarray(np.concatenate(samples)).quantize(_GIF_COLOURS)
    indexed = (
        Image.fromarray(restored(number)).quantize(palette=palette, dither=Image.Dither.NONE)
        for number in range(len(kept))
    )
    # A GIF counts in hundredths of a second. Viewers show pictures of one hundredth for a tenth of a second.
    ends = [round(100.0 * number / min(fps, GIF_FPS)) for number in range(len(kept) + 1)]
    durations = [10 * (end - begin) for begin, end in itertools.pairwise(ends)]
    with replacing(path) as partial:
        next(indexed).save(partial, save_all=True, append_images=indexed, duration=durations, loop=0)


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
