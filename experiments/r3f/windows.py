"""Square windows of pictures around what is to be seen in them."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Num, Shaped


class Window(NamedTuple):
    """A square of a picture, in shares of its height, so that it serves pictures of any size.

    Attributes:
      top: of its first row.
      left: of its first column.
      side: of its edge.
    """

    top: float
    left: float
    side: float


def around(areas: Sequence[Bool[np.ndarray, "h w"]], *, margin: float) -> list[Window]:
    """Returns for each area a window of one size for all, within the picture.

    Args:
      areas: what is to be seen, of one size; an empty one is looked at in its middle.
      margin: around the largest of them, as a share of it.
    """
    height, width = areas[0].shape
    boxes = [_box(area) for area in areas]
    side = (1.0 + 2.0 * margin) * max(float(np.max(high - low)) for low, high in boxes)
    side = min(side, height, width)
    ends = np.asarray([height, width]) - side
    corners = [np.clip(0.5 * (low + high - side), 0.0, ends) / height for low, high in boxes]
    return [Window(float(top), float(left), side / height) for top, left in corners]


def cut(picture: Shaped[np.ndarray, "h w *channels"], window: Window) -> np.ndarray:
    """Returns the part of a picture in a window, to whole pixels."""
    height = len(picture)
    top, left = math.floor(window.top * height), math.floor(window.left * height)
    side = max(1, math.ceil(window.side * height))
    return picture[top : top + side, left : left + side]


def shrink_any(area: Bool[np.ndarray, "h w"], stride: int) -> Bool[np.ndarray, "sh sw"]:
    """Returns an area in pixels larger by a stride; one is in it if any of its small ones is."""
    return _blocks(area, stride).any(axis=(1, 3))


def shrink(picture: Num[np.ndarray, "h w 3"], stride: int) -> Num[np.ndarray, "sh sw 3"]:
    """Returns a picture in pixels larger by a stride, as means."""
    return _blocks(picture, stride).mean(axis=(1, 3))


def _blocks(picture: Shaped[np.ndarray, "h w *channels"], stride: int) -> np.ndarray:
    """Cuts a picture into squares; what is left over at its ends repeats the last pixel."""
    short = [-length % stride for length in picture.shape[:2]]
    ends = [(0, short[0]), (0, short[1]), *[(0, 0)] * (picture.ndim - 2)]
    padded = np.pad(picture, ends, mode="edge")
    height, width, *channels = padded.shape
    return padded.reshape(height // stride, stride, width // stride, stride, *channels)


def _box(area: Bool[np.ndarray, "h w"]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the ends of rows and columns of an area."""
    if not area.any():
        middle = 0.5 * np.asarray(area.shape)
        return middle, middle
    found = np.argwhere(area)
    return found.min(axis=0), found.max(axis=0) + 1
