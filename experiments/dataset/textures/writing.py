"""Illegible writing: glyphs of a few strokes each."""

import numpy as np
from jaxtyping import Float
from PIL import ImageDraw

Box = tuple[float, float, float, float]
"""Bounding box: left, top, right, bottom, in samples."""

# Endpoints of a glyph's strokes, on a grid of 3 x 5 nodes.
_STROKES = (
    ((0, 0), (2, 0)),
    ((0, 2), (2, 2)),
    ((0, 4), (2, 4)),
    ((0, 0), (0, 2)),
    ((0, 2), (0, 4)),
    ((2, 0), (2, 2)),
    ((2, 2), (2, 4)),
    ((1, 0), (1, 4)),
    ((0, 0), (2, 4)),
    ((2, 0), (0, 4)),
    ((0, 2), (2, 0)),
    ((0, 2), (2, 4)),
)


def write(
    draw: ImageDraw.ImageDraw,
    box: Box,
    rng: np.random.Generator,
    ink: tuple,
    *,
    weight: float = 0.2,
) -> None:
    """Fills a box with one line of glyphs, as high as the box.

    Args:
      draw: drawing context of the image.
      box: bounding box of the line.
      rng: random generator that selects the glyphs.
      ink: colour of the glyphs.
      weight: thickness of strokes, in heights of the line.
    """
    left, top, right, bottom = box
    high = bottom - top
    at, width = left, max(round(weight * high), 1)
    while at + 0.62 * high <= right:
        if rng.random() < 0.14 and at > left:
            at += 0.45 * high
            continue
        strokes = rng.choice(len(_STROKES), int(rng.integers(3, 5)), replace=False)
        for stroke in strokes:
            ends = [(at + 0.26 * high * a, top + 0.25 * high * b) for a, b in _STROKES[stroke]]
            draw.line(ends, fill=ink, width=width)
        at += 0.52 * high + 1.6 * width


def ink(tone: Float[np.ndarray, "3"]) -> tuple[int, int, int]:
    """Returns a colour in Pillow's format."""
    return tuple(round(255 * min(max(float(each), 0.0), 1.0)) for each in tone)
