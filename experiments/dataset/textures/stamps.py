"""Lays stamps on an image one over the other, each with its shadow.

In a stamp's local frame `u` and `v` range from about -1 to 1, `u` along it and `v` across.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from experiments.dataset.textures.fields import Field, smooth

Distance = Callable[[Field, Field], Field]
"""Function from `u` and `v` to the signed distance from the outline, in the stamp's unit."""

Samples = Float[np.ndarray, " samples"]

Paint = Callable[[Samples, Samples, Samples], Float[np.ndarray, "samples 3"]]
"""Function from `u`, `v` and the distance of inner samples to colours."""


class Place(NamedTuple):
    """Pose of a stamp.

    Attributes:
      x, y: position of its middle, on the unit square.
      size: half its length.
      angle: angle of `u` from x towards y, radians.
    """

    x: float
    y: float
    size: float
    angle: float


_MARGIN = 1.16
_SHADOW = (0.06, 0.09)


def stamp(
    picture: Float[np.ndarray, "n n 3"],
    place: Place,
    distance: Distance,
    paint: Paint,
    *,
    shadow: float = 0.55,
) -> None:
    """Lays a stamp on an image, in place; beyond a border it continues at the opposite one.

    Args:
      picture: image to lay the stamp on.
      place: pose of the stamp.
      distance: outline of the stamp.
      paint: colours of the stamp.
      shadow: darkening of the image beneath, 0 to 1.
    """
    reach = _MARGIN * place.size
    for right in (-1.0, 0.0, 1.0):
        for down in (-1.0, 0.0, 1.0):
            x, y = place.x + right, place.y + down
            if -reach < x < 1.0 + reach and -reach < y < 1.0 + reach:
                _lay(picture, place._replace(x=x, y=y), distance, paint, shadow)


def _lay(
    picture: Float[np.ndarray, "n n 3"],
    place: Place,
    distance: Distance,
    paint: Paint,
    shadow: float,
) -> None:
    """Lays a stamp, in place, cropped at the border."""
    n = picture.shape[0]
    reach = _MARGIN * place.size
    left, right = _range(place.x - reach, place.x + reach, n)
    top, bottom = _range(place.y - reach, place.y + reach, n)
    if left >= right or top >= bottom:
        return
    x = ((np.arange(left, right, dtype=np.float32) + 0.5) / n - place.x)[None] / place.size
    y = ((np.arange(top, bottom, dtype=np.float32) + 0.5) / n - place.y)[:, None] / place.size
    cos, sin = math.cos(place.angle), math.sin(place.angle)
    u, v = cos * x + sin * y, cos * y - sin * x
    outside = distance(u, v)
    target = picture[top:bottom, left:right]
    if shadow:
        # The shadow is the outline shifted by an integer number of samples.
        right_by, down_by = (round(each * place.size * n) for each in _SHADOW)
        beneath = outside[: -down_by or None, : -right_by or None]
        target[down_by:, right_by:] *= (1.0 - shadow * smooth(0.12, -0.06, beneath))[..., None]
    cover = np.clip(0.5 - outside * (n * place.size), 0.0, 1.0)
    row, column = np.nonzero(cover)
    within = u[row, column], v[row, column], outside[row, column]
    below = target[row, column]
    target[row, column] = below + cover[row, column, None] * (paint(*within) - below)


def _range(low: float, high: float, n: int) -> tuple[int, int]:
    return max(math.floor(low * n), 0), min(math.ceil(high * n), n)
