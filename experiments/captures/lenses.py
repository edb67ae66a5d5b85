"""Lens models of COLMAP and nerfstudio (NumPy, double precision).

A direction `(x, y, z)` in the frame of the camera, x right, y **down**, z ahead, is first the point
`(u, v) = (x, y) / z` of the plane at distance 1. The lens moves it to `(u', v')`, and the image
shows it at the pixel `(focal_x u' + centre_x, focal_y v' + centre_y)`. With `r^2 = u^2 + v^2`:

    perspective    s = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)
                   u' = s u + 2 p1 u v + p2 (r^2 + 2 u^2)
                   v' = s v + 2 p2 u v + p1 (r^2 + 2 v^2)
    fisheye        t = atan(r),  s = t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8) / r
                   (u', v') = s (u, v)

The other models are cases of these two: coefficients that a model does not have are 0. Only this
direction is computed here, from rays to pixels; it has no inverse in closed form.

Source: COLMAP, `src/colmap/sensor/models.h`; https://colmap.github.io/cameras.html.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

Points = Float[np.ndarray, "*shape 2"]

NARROWEST_COSINE = math.cos(math.radians(60.0))
"""Cosine of the largest angle between the axis and the middle of a side of a pinhole's image."""

# Steps from the axis to the widest field of view, and halvings of the last step.
_STEPS, _HALVINGS = 120, 40

# Points along each side of a rectangle, an odd number: the middle of a side may leave first.
_ALONG = 33

# Distance of the points from which slopes are computed, and what counts as inside, pixels.
_APART, _AT_THE_BORDER = 1e-6, 1e-9

# Below this radius, the quotient of a fisheye is its limit.
_NEAR_AXIS = 1e-9


class Intrinsics(NamedTuple):
    """Intrinsics of a camera without its distortion, in pixels.

    Attributes:
      focal_x, focal_y: focal lengths along rows and along columns.
      centre_x, centre_y: principal point, from the upper left corner of the image.
      width, height: size of the image.
    """

    focal_x: float
    focal_y: float
    centre_x: float
    centre_y: float
    width: int
    height: int


class Distortion(NamedTuple):
    """Distortion of a lens; see the module.

    Attributes:
      fisheye: whether the model is that of a fisheye.
      radial: coefficients k1 to k6; of a fisheye k1 to k4.
      tangential: coefficients p1 and p2, not of a fisheye.
    """

    fisheye: bool = False
    radial: tuple[float, ...] = ()
    tangential: tuple[float, float] = (0.0, 0.0)

    @property
    def is_none(self) -> bool:
        """Whether the lens is a pinhole."""
        return not (self.fisheye or any(self.radial) or any(self.tangential))

    def describe(self) -> str:
        """Returns the coefficients that are not 0, as in `k1 = -0.9`."""
        radial = {f"k{number + 1}": value for number, value in enumerate(self.radial)}
        named = radial | dict(zip(("p1", "p2"), self.tangential, strict=True))
        words = [f"{name} = {value:g}" for name, value in named.items() if value]
        return ", ".join((["fisheye"] if self.fisheye else []) + words) or "none"


class Lens(NamedTuple):
    """A camera of a capture.

    Attributes:
      intrinsics: its intrinsics.
      distortion: its distortion.
    """

    intrinsics: Intrinsics
    distortion: Distortion


def distort(distortion: Distortion, points: Points) -> Points:
    """Returns where a lens moves points of the plane at distance 1, see the module.

    A fisheye is regular on its axis, where it moves nothing. Beyond a pole of the rational model
    the result is not finite.
    """
    u, v = points[..., 0], points[..., 1]
    squared = u * u + v * v
    if distortion.fisheye:
        scale = _fisheye_scale(distortion, np.sqrt(squared))
        return points * scale[..., None]
    k1, k2, k3, k4, k5, k6 = _padded(distortion.radial, 6)
    p1, p2 = distortion.tangential
    above = 1.0 + squared * (k1 + squared * (k2 + squared * k3))
    below = 1.0 + squared * (k4 + squared * (k5 + squared * k6))
    scale = np.divide(above, below, out=np.full_like(above, np.nan), where=below > 0.0)
    across = 2.0 * u * v
    return np.stack(
        [
            scale * u + p1 * across + p2 * (squared + 2.0 * u * u),
            scale * v + p2 * across + p1 * (squared + 2.0 * v * v),
        ],
        axis=-1,
    )


def to_pixels(lens: Lens, points: Points) -> Points:
    """Returns the pixels, column and row, at which a lens shows points of that plane."""
    moved, known = distort(lens.distortion, points), lens.intrinsics
    focal = np.array([known.focal_x, known.focal_y])
    return focal * moved + np.array([known.centre_x, known.centre_y])


def slopes(lens: Lens, points: Points) -> Float[np.ndarray, "*shape 2 2"]:
    """Returns the derivative of pixels by points, by central differences (error below 1e-6)."""
    steps = _APART * np.eye(2)
    columns = [
        (to_pixels(lens, points + step) - to_pixels(lens, points - step)) / (2.0 * _APART)
        for step in steps
    ]
    return np.stack(columns, axis=-1)


class Extent(NamedTuple):
    """How far a field of view can grow until something ends it.

    Attributes:
      factor: largest factor.
      end: end that is met: border of the image, fold of the lens, or largest factor asked.
    """

    factor: float
    end: str


BORDER, FOLD, LIMIT = "border", "fold", "limit"


def extent(lens: Lens, fixed: np.ndarray, growing: np.ndarray, *, most: float) -> Extent:
    """Returns the largest `t` for which a pinhole's image lies within that of a lens.

    The pinhole's image is the rectangle around the axis with the half sides `fixed + t growing` on
    the plane at distance 1. As `t` grows from 0, its border sweeps over it; the lens must map each
    point into its image, and must not fold (turn the image over) anywhere.

    Args:
      lens: the lens.
      fixed: half width and half height for `t = 0`.
      growing: their growth.
      most: largest `t`.
    """

    def found(factor: float) -> str:
        return _fit(lens, fixed + factor * growing)

    inside = 0.0
    for factor in np.linspace(0.0, most, _STEPS + 1)[1:]:
        end = found(float(factor))
        if end:
            outside = float(factor)
            break
        inside = float(factor)
    else:
        return Extent(most, LIMIT)
    for _ in range(_HALVINGS):
        middle = 0.5 * (inside + outside)
        if found(middle):
            outside = middle
        else:
            inside = middle
    return Extent(inside, end)


def _fit(lens: Lens, half: np.ndarray) -> str:
    """Returns what is wrong with the border of a rectangle, or an empty text."""
    along = np.linspace(-1.0, 1.0, _ALONG)
    ones = np.ones(_ALONG)
    sides = [(along, ones), (along, -ones), (ones, along), (-ones, along)]
    points = half * np.concatenate([np.stack(side, axis=-1) for side in sides])
    pixels, size = to_pixels(lens, points), np.array(lens.intrinsics[-2:])
    inside = np.all((pixels >= -_AT_THE_BORDER) & (pixels <= size + _AT_THE_BORDER), axis=-1)
    turned = ~(np.linalg.det(slopes(lens, points)) > 0.0)
    if np.any(turned & (inside | ~np.all(np.isfinite(pixels), axis=-1))):
        return FOLD
    return "" if inside.all() else BORDER


def _fisheye_scale(
    distortion: Distortion, radius: Float[np.ndarray, "*shape"]
) -> Float[np.ndarray, "*shape"]:
    k1, k2, k3, k4 = _padded(distortion.radial, 4)
    angle = np.arctan(radius)
    squared = angle * angle
    bent = angle * (1.0 + squared * (k1 + squared * (k2 + squared * (k3 + squared * k4))))
    return np.divide(bent, radius, out=np.ones_like(radius), where=radius > _NEAR_AXIS)


def _padded(values: tuple[float, ...], count: int) -> tuple[float, ...]:
    return (*values, *[0.0] * count)[:count]
