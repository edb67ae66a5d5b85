"""Cuts images so that the principal point of all is their middle (NumPy only).

Cameras of a scene share a focal length and a centred principal point. An image whose principal
point lies elsewhere is cut along its borders; what is left of the shift is below half a pixel, and
nothing is interpolated.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int


class Windows(NamedTuple):
    """What is kept of each image of a split, along one axis.

    Attributes:
      starts: first pixel of each image's window.
      size: of all windows, pixels.
      shift: how far the principal point may be from the windows' middle, pixels.
    """

    starts: Int[np.ndarray, " images"]
    size: int
    shift: float


def centred_windows(centres: Float[np.ndarray, " images"], size: int) -> Windows:
    """Returns the largest windows of one size that have the principal points in their middle.

    Of the largest even and the largest odd size the one with the smaller shift is taken, and the
    larger one if they are equal.

    Args:
      centres: principal points along the axis, pixels from the border, within the images.
      size: of the images, pixels.
    """
    found: list[Windows] = []
    for kept in range(size, 0, -1):
        starts = np.rint(centres - 0.5 * kept).astype(np.int64)
        if np.all((starts >= 0) & (starts + kept <= size)):
            found.append(Windows(starts, kept, float(np.abs(starts + 0.5 * kept - centres).max())))
        if len(found) == 2:
            break
    return min(found, key=lambda windows: windows.shift)
