"""Chooses one pinhole for the frames of a split, and resamples photographs into it (NumPy only).

A scene has one camera per split: no distortion, one focal length, the principal point in the
middle. Its rectangle on the plane at distance 1 is the largest that lies within all frames: first
grown in the proportions of the images, then along either side alone. So every frame covers every
pixel, and nothing has to be masked. Portraits among landscapes, or the other way round, are turned
by 90 degrees about their axis, pixels and pose alike, which loses nothing.

A pixel of the pinhole takes the light at its centre, interpolated between 4 x 4 pixels of the
photograph by Catmull and Rom's cubic. Where the photograph is finer, it is the mean of `n x n` such
points, spread evenly over the pixel, at most 1.25 pixels of the photograph apart. All of this is in
linear light.

Source: Keys, Cubic Convolution Interpolation for Digital Image Processing (1981); its cubic with
a = -1/2 is that of Catmull and Rom, exact for quadratics.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from experiments.captures import lenses
from experiments.captures.lenses import Lens
from refref_jax.data import SceneError

TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Rotation of a camera whose photograph is turned clockwise by 90 degrees (camera frame, y up)."""

# Pixels of a photograph per point up to which a pixel is a single point.
_COARSEST = 1.25

# Rows that are resampled at once, and points along each axis at which scales are looked at.
_ROWS, _LOOKS = 64, 33

# Displacement of pixels up to which a photograph is copied, pixels.
_SAME = 0.01

# Share of a photograph below which what is left is taken to be a mistake.
_LEAST_KEPT = 0.25

_WIDEST = math.sqrt(1.0 / lenses.NARROWEST_COSINE**2 - 1.0)


class Pinhole(NamedTuple):
    """The camera that all frames of a split share.

    Attributes:
      width, height: size of its image, pixels.
      focal: focal length, pixels.
    """

    width: int
    height: int
    focal: float


class Frame(NamedTuple):
    """How a photograph lies in the shared camera.

    Attributes:
      name: name of the photograph.
      lens: its lens.
      turned: whether it is turned clockwise by 90 degrees.
    """

    name: str
    lens: Lens
    turned: bool


class Shared(NamedTuple):
    """The shared camera, and what it cost.

    Attributes:
      pinhole: the camera.
      kept: share of each photograph that it shows.
      narrowest: name of the photograph that limits the field of view.
      exact: whether photographs are pinholes of this very camera, so that pixels are copied.
    """

    pinhole: Pinhole
    kept: Float[np.ndarray, " frames"]
    narrowest: str
    exact: bool


def turns(found: Sequence[Lens]) -> list[bool]:
    """Returns which photographs are turned, so that all are landscapes or all are portraits."""
    sizes = np.array([_half_sides(lens) for lens in found])
    wide, tall = sizes[:, 0] > sizes[:, 1], sizes[:, 0] < sizes[:, 1]
    return [bool(each) for each in (tall if wide.sum() >= tall.sum() else wide)]


def share(frames: Sequence[Frame], *, width: int | None = None) -> Shared:
    """Returns the camera for photographs.

    Args:
      frames: the photographs.
      width: width of its image in pixels; by default, its focal length is the median of theirs,
        so that nothing is scaled in the middle of most of them.

    Raises:
      SceneError: if a lens folds inside of its photograph, or little of one is left.
    """
    focals = [math.sqrt(lens.intrinsics.focal_x * lens.intrinsics.focal_y) for _, lens, _ in frames]
    size = _turned(frames[0].lens.intrinsics[4:], frames[0].turned)
    same = Pinhole(int(size[0]), int(size[1]), float(np.median(focals)))
    if width in (None, same.width) and all(_is_of(frame, same) for frame in frames):
        return Shared(same, np.ones(len(frames)), frames[0].name, exact=True)
    half, narrowest = _common_rectangle(frames)
    focal = float(np.median(focals)) if width is None else width / (2.0 * half[0])
    size = np.floor(2.0 * focal * half + 1e-6).astype(int)
    if min(size) < 1:
        raise SceneError(f"No pixel is left of {narrowest}. Check its intrinsics, or leave it out.")
    pinhole = Pinhole(int(size[0]) if width is None else width, int(size[1]), focal)
    kept = np.array([_kept(frame, pinhole) for frame in frames])
    if kept.min() < _LEAST_KEPT:
        worst = frames[int(np.argmin(kept))].name
        raise SceneError(
            f"The camera that all images of a split share shows {kept.min():.0%} of {worst}, since "
            f"{narrowest} sees little: its principal point is far from its middle, or its field of "
            "view is narrow. Check its intrinsics, leave it out, or put it into another split."
        )
    return Shared(pinhole, kept, narrowest, exact=False)


def resample(
    pixels: Float[np.ndarray, "h w channels"], frame: Frame, pinhole: Pinhole
) -> Float[np.ndarray, "height width channels"]:
    """Returns what a pinhole at the place of a lens would show, in linear light, see the module.

    Args:
      pixels: photograph in linear light.
      frame: its lens.
      pinhole: camera to resample into.
    """
    side = points_per_side(frame, pinhole)
    out = np.empty((pinhole.height, pinhole.width, pixels.shape[-1]), np.float32)
    for start in range(0, pinhole.height, _ROWS):
        rows = np.arange(start, min(start + _ROWS, pinhole.height))
        total = np.zeros((len(rows), *out.shape[1:]), np.float32)
        for offset in np.ndindex(side, side):
            places = _places(frame, pinhole, rows, (np.array(offset) + 0.5) / side)
            total += interpolate(pixels, places)
        out[rows] = total / side**2
    return out


def resample_mask(
    mask: Bool[np.ndarray, "h w"], frame: Frame, pinhole: Pinhole
) -> Bool[np.ndarray, "height width"]:
    """Returns the pixels at least half of which a mask covers, interpolated linearly.

    Where a pixel spans several of the mask, a grid of points in it is counted.
    """
    side = points_per_side(frame, pinhole)
    values = mask[..., None].astype(np.float32)
    out = np.empty((pinhole.height, pinhole.width), bool)
    for start in range(0, pinhole.height, _ROWS):
        rows = np.arange(start, min(start + _ROWS, pinhole.height))
        offsets = [(np.array(each) + 0.5) / side for each in np.ndindex(side, side)]
        taken = [
            _linear(values, _places(frame, pinhole, rows, offset))[..., 0] for offset in offsets
        ]
        out[rows] = np.mean(taken, axis=0) >= 0.5
    return out


def points_per_side(frame: Frame, pinhole: Pinhole) -> int:
    """Returns how many points along each side of a pixel are averaged: 1 unless it is coarser."""
    half = 0.5 * np.array([pinhole.width, pinhole.height]) / pinhole.focal
    grid = np.stack(np.meshgrid(*[np.linspace(-x, x, _LOOKS) for x in half]), axis=-1)
    scales = lenses.slopes(frame.lens, _towards(grid, frame.turned)) / pinhole.focal
    largest = float(np.linalg.svd(scales, compute_uv=False).max())
    return max(1, math.ceil(largest / _COARSEST - 1e-6))


def interpolate(
    pixels: Float[np.ndarray, "h w channels"], places: Float[np.ndarray, "rows columns 2"]
) -> Float[np.ndarray, "rows columns channels"]:
    """Returns values between pixels by Catmull and Rom's cubic; pixels at the border continue.

    Args:
      pixels: the image.
      places: column and row of each point, where the centre of the first pixel is `(0.5, 0.5)`.
    """
    height, width = pixels.shape[:2]
    start = np.floor(places - 0.5)
    weights = _cubic((places - 0.5 - start).astype(np.float32))
    start = start.astype(np.int64)
    columns = [np.clip(start[..., 0] + tap, 0, width - 1) for tap in (-1, 0, 1, 2)]
    total = np.zeros((*places.shape[:-1], pixels.shape[-1]), np.float32)
    for tap in range(4):
        line = np.clip(start[..., 1] + tap - 1, 0, height - 1)
        across = sum(
            weights[each][..., :1] * pixels[line, column] for each, column in enumerate(columns)
        )
        total += weights[tap][..., 1:] * across
    return total


def _linear(values: np.ndarray, places: np.ndarray) -> np.ndarray:
    height, width = values.shape[:2]
    start = np.floor(places - 0.5)
    part = (places - 0.5 - start).astype(np.float32)
    start = start.astype(np.int64)
    total = np.zeros((*places.shape[:-1], values.shape[-1]), np.float32)
    for down, right in np.ndindex(2, 2):
        weight = np.abs(1 - right - part[..., :1]) * np.abs(1 - down - part[..., 1:])
        line = np.clip(start[..., 1] + down, 0, height - 1)
        total += weight * values[line, np.clip(start[..., 0] + right, 0, width - 1)]
    return total


def _cubic(part: Float[np.ndarray, "*shape"]) -> list[Float[np.ndarray, "*shape"]]:
    """Returns the weights of the pixels at -1, 0, 1 and 2 for a point between 0 and 1."""
    square, cube = part * part, part * part * part
    return [
        -0.5 * cube + square - 0.5 * part,
        1.5 * cube - 2.5 * square + 1.0,
        -1.5 * cube + 2.0 * square + 0.5 * part,
        0.5 * cube - 0.5 * square,
    ]


def _places(
    frame: Frame, pinhole: Pinhole, rows: np.ndarray, offset: np.ndarray
) -> Float[np.ndarray, "rows columns 2"]:
    """Returns where a photograph shows a point of each pixel of some rows."""
    x = (np.arange(pinhole.width) + offset[0] - 0.5 * pinhole.width) / pinhole.focal
    y = (rows + offset[1] - 0.5 * pinhole.height) / pinhole.focal
    points = np.stack(np.meshgrid(x, y), axis=-1)
    return lenses.to_pixels(frame.lens, _towards(points, frame.turned))


def _towards(points: np.ndarray, turned: bool) -> np.ndarray:
    """Returns points of the plane of the pinhole in that of the photograph, y down."""
    return np.stack([points[..., 1], -points[..., 0]], axis=-1) if turned else points


def _common_rectangle(frames: Sequence[Frame]) -> tuple[np.ndarray, str]:
    """Returns the half sides of the largest common rectangle, and the photograph that limits it."""
    sides = np.array([_turned(_half_sides(lens), turned) for _, lens, turned in frames])
    half = np.median(sides, axis=0)
    most = _WIDEST / half.max()
    groups = {(frame.lens, frame.turned): frame for frame in reversed(frames)}.values()
    ends = []
    for frame in groups:
        _refuse_axis_outside(frame)
        shape = np.array(_turned(half, frame.turned))
        end = lenses.extent(frame.lens, np.zeros(2), shape, most=most)
        if end.end == lenses.FOLD:
            _refuse_fold(frame, end.factor * math.hypot(*half))
        ends.append(end.factor)
    narrowest = list(groups)[int(np.argmin(ends))].name
    half = min(ends) * half
    for axis in range(2):
        growing = half * np.eye(2)[axis]
        room = max(0.0, _WIDEST / half[axis] - 1.0)
        factors = [
            lenses.extent(
                frame.lens,
                np.array(_turned(half, frame.turned)),
                np.array(_turned(growing, frame.turned)),
                most=room,
            ).factor
            for frame in groups
        ]
        half = half + min(factors) * growing
    return half, narrowest


def _refuse_axis_outside(frame: Frame) -> None:
    known = frame.lens.intrinsics
    if not (0.0 < known.centre_x < known.width and 0.0 < known.centre_y < known.height):
        raise SceneError(
            f"The principal point of {frame.name} is ({known.centre_x:g}, {known.centre_y:g}), "
            f"outside of its {known.width} x {known.height} pixels. Check its intrinsics, or leave "
            "it out."
        )


def _refuse_fold(frame: Frame, tangent: float) -> None:
    angle = math.degrees(math.atan(tangent))
    raise SceneError(
        f"The lens of {frame.name} folds at most {angle:.0f} degrees from its axis, inside its "
        f"image: {frame.lens.distortion.describe()}. Beyond, a pixel would show two directions. "
        "Calibrate the camera again, with a model of fewer coefficients or a fisheye."
    )


def _is_of(frame: Frame, pinhole: Pinhole) -> bool:
    """Returns whether a photograph is one of a pinhole, up to displacements that do not show."""
    known = frame.lens.intrinsics
    size = np.array(known[4:])
    if _turned(size, frame.turned) != pinhole[:2] or not frame.lens.distortion.is_none:
        return False
    off = np.abs(np.array(known[2:4]) - 0.5 * size)
    off = off + 0.5 * size * np.abs(np.array(known[:2]) / pinhole.focal - 1.0)
    return bool(off.max() <= _SAME)


def _half_sides(lens: Lens) -> tuple[float, float]:
    known = lens.intrinsics
    return 0.5 * known.width / known.focal_x, 0.5 * known.height / known.focal_y


def _turned(sides: Sequence[float], turned: bool) -> tuple[float, float]:
    """Returns width and height of what is turned."""
    first, second = sides
    return (second, first) if turned else (first, second)


def _kept(frame: Frame, pinhole: Pinhole) -> float:
    """Returns the share of a photograph that the border of a pinhole's image encloses."""
    x, y = 0.5 * pinhole.width / pinhole.focal, 0.5 * pinhole.height / pinhole.focal
    along = np.linspace(-1.0, 1.0, _LOOKS)[:-1]
    ones = np.ones_like(along)
    sides = [(along, -ones), (ones, along), (-along, ones), (-ones, -along)]
    points = np.concatenate([np.stack(side, axis=-1) for side in sides]) * (x, y)
    columns, rows = lenses.to_pixels(frame.lens, _towards(points, frame.turned)).T
    area = 0.5 * abs(np.dot(columns, np.roll(rows, -1)) - np.dot(rows, np.roll(columns, -1)))
    return float(area / (frame.lens.intrinsics.width * frame.lens.intrinsics.height))
