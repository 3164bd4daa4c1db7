import numpy as np
import pytest

from hpamdp.env.canvas import SMOOTH, Canvas


def draw_some(canvas: Canvas, rng: np.random.Generator) -> None:
    """Draw one shape of each kind somewhere; some lie partly or wholly beside the paper."""
    x, y, left, top = rng.uniform(-60, 540, 4)
    width, height = rng.uniform(1, 90, 2)
    edge = rng.uniform(0, 20)
    canvas.disc((x, y), rng.uniform(0.5, 60), "#123456", "#fedcba", edge)
    canvas.line((x, y), (left, top), "#654321", edge)
    canvas.polygon([(x, y), (x + width, y - height), (x - height, y + width)], "#224466", "#664422", edge)
    canvas.bar((left, top, left + width, top + height), "#aa5500")


@pytest.mark.parametrize("size", [480, 333, 50])
def test_smoothing_only_what_was_drawn_on_gives_the_picture_that_smoothing_all_gives(size):
    rng = np.random.default_rng(0)
    for _ in range(30):
        canvas = Canvas.for_shapes(size)
        draw_some(canvas, rng)
        earlier = canvas.smoothed().image
        before = earlier.copy()
        later = Canvas(canvas.image.copy())
        draw_some(later, rng)
        assert np.array_equal(later.smoothed(earlier).image, later.image.reduce(SMOOTH))
        assert np.array_equal(earlier, before), "it is another picture's background too"
