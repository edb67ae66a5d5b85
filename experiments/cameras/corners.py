"""Corners of images, and corners of different images that look alike (NumPy only).

A corner is a point whose neighbourhood differs from itself however it is moved: the smaller
eigenvalue of the structure tensor has a maximum there. Its place is that nearest to the lines along
all gradients around it, to a fraction of a pixel. Pixel coordinates are `(column, row)`, with the
middle of the first pixel at `(0.5, 0.5)`.

Sources: Shi and Tomasi, Good Features to Track (1994); Foerstner and Guelch, A fast operator for
detection and precise location of distinct points (1987); Lucas and Kanade (1981) and Baker and
Matthews (2004, inverse compositional) for the alignment of patches.
"""

from typing import NamedTuple

import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Float, Int, UInt8

# Smoothing of images and of structure tensors; pixels between corners and to the border.
_BLUR, _WINDOW, _APART, _BORDER = 0.7, 1.5, 5, 8

# Half the side of a patch, pixels; weakest corner, as a share of a strong one.
_HALF, _WEAKEST = 5, 0.02

# Largest correction of a corner's place, pixels.
_FARTHEST = 1.5

# Alignment of patches: damping, relative; iterations; largest shift in pixels, least correlation
# afterwards.
_STEADY, _ROUNDS, _LARGEST_SHIFT, _ALIKE = 1e-3, 8, 2.0, 0.85


class Corners(NamedTuple):
    """Corners of an image.

    Attributes:
      places: pixel coordinates.
      patches: grey values around them, with mean 0 and length 1.
    """

    places: Float[np.ndarray, "corners 2"]
    patches: Float[np.ndarray, "corners area"]


class GreyImage(NamedTuple):
    """An image in grey, and coefficients of cubic splines through it and its slopes.

    Attributes:
      grey: grey values, 0 to 1, slightly smoothed.
      spline: coefficients of the grey values.
      right: coefficients of the slope along rows, per pixel.
      down: coefficients of the slope along columns.
    """

    grey: Float[np.ndarray, "h w"]
    spline: Float[np.ndarray, "h w"]
    right: Float[np.ndarray, "h w"]
    down: Float[np.ndarray, "h w"]


def prepare(image: UInt8[np.ndarray, "h w 3"]) -> GreyImage:
    """Returns an 8-bit image in grey."""
    luma = image.astype(np.float64) @ [0.299, 0.587, 0.114] / 255.0
    grey = scipy.ndimage.gaussian_filter(luma, _BLUR, mode="nearest")
    down, right = np.gradient(grey)
    splines = (scipy.ndimage.spline_filter(each, mode="nearest") for each in (grey, right, down))
    return GreyImage(grey, *splines)


def find_corners(image: GreyImage, usable: Bool[np.ndarray, "h w"], *, most: int) -> Corners:
    """Returns the strongest corners of an image.

    Args:
      image: the image.
      usable: pixels where corners may lie.
      most: largest number of corners.
    """
    down, right = np.gradient(image.grey)
    xx, xy, yy = (
        scipy.ndimage.gaussian_filter(product, _WINDOW, mode="nearest")
        for product in (right * right, right * down, down * down)
    )
    weaker = 0.5 * (xx + yy) - np.sqrt((0.5 * (xx - yy)) ** 2 + xy**2)
    peak = weaker == scipy.ndimage.maximum_filter(weaker, _APART)
    allowed = usable.copy()
    allowed[:_BORDER], allowed[-_BORDER:] = False, False
    allowed[:, :_BORDER], allowed[:, -_BORDER:] = False, False
    peak &= allowed
    if not peak.any():
        return Corners(np.zeros((0, 2)), np.zeros((0, (2 * _HALF + 1) ** 2)))
    strong = weaker[peak].max()
    rows, columns = np.nonzero(peak & (weaker > _WEAKEST * strong))
    order = np.argsort(-weaker[rows, columns], kind="stable")[:most]
    rows, columns = rows[order], columns[order]
    # Towards the point nearest to all lines along gradients: sum(G) shift = sum(G offset).
    yx = [_moment(right, down, product) for product in ("x", "y")]
    tensor = np.stack(
        [np.stack([xx, xy], -1)[rows, columns], np.stack([xy, yy], -1)[rows, columns]], axis=1
    )
    shift = np.linalg.solve(tensor, np.stack([each[rows, columns] for each in yx], -1)[..., None])
    shift = shift[..., 0]
    close = np.abs(shift).max(axis=1) < _FARTHEST
    places = np.stack([columns, rows], axis=-1)[close] + 0.5 + shift[close]
    return Corners(places, normalised(sample(image.spline, _around(places))))


def normalised(patches: Float[np.ndarray, "n area"]) -> Float[np.ndarray, "n area"]:
    """Returns patches with mean 0 and length 1; a patch without contrast is 0."""
    centred = patches - patches.mean(axis=-1, keepdims=True)
    length = np.linalg.norm(centred, axis=-1, keepdims=True)
    return np.divide(centred, length, out=np.zeros_like(centred), where=length > 1e-6)


def sample(
    spline: Float[np.ndarray, "h w"], places: Float[np.ndarray, "*n 2"]
) -> Float[np.ndarray, "*n"]:
    """Returns values of a spline at pixel coordinates."""
    at = [places[..., 1] - 0.5, places[..., 0] - 0.5]
    return scipy.ndimage.map_coordinates(spline, at, order=3, mode="nearest", prefilter=False)


def align_patches(
    first: GreyImage,
    second: GreyImage,
    places: Float[np.ndarray, "n 2"],
    starts: Float[np.ndarray, "n 2"],
) -> tuple[Float[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
    """Returns where patches of one image are in another one, and which of them were found.

    Patches are moved, turned, scaled and sheared until they agree up to brightness and contrast.

    Args:
      first: the first image.
      second: the second image.
      places: middles of the patches in the first image.
      starts: first guess of their middles in the second one, within two pixels.
    """
    offsets = _offsets()
    around = places[:, None] + offsets
    values = sample(first.spline, around)
    contrast = _contrast(values)
    wanted = normalised(values)
    slope = np.stack([sample(first.right, around), sample(first.down, around)], axis=-1)
    moves = [slope, slope[..., :1] * offsets, slope[..., 1:] * offsets]
    slopes = np.concatenate(moves, axis=-1) / contrast[..., None]
    slopes -= slopes.mean(axis=1, keepdims=True)
    # Contrast is the seventh unknown.
    basis = np.concatenate([slopes, wanted[..., None]], axis=-1)
    normal = np.swapaxes(basis, 1, 2) @ basis
    normal += _STEADY * np.einsum("nii->ni", normal)[..., None] * np.eye(7) + 1e-12 * np.eye(7)
    solver = np.linalg.solve(normal, np.swapaxes(basis, 1, 2))
    warp = np.tile(np.eye(2), (len(places), 1, 1))
    found = starts.copy()
    for _ in range(_ROUNDS):
        seen = normalised(sample(second.spline, found[:, None] + offsets @ warp.swapaxes(1, 2)))
        step = (solver @ (seen - wanted)[..., None])[..., 0]
        shape = np.eye(2) + np.clip(step[:, 2:6].reshape(-1, 2, 2), -0.2, 0.2)
        # The patch of the first image was moved to fit: the other one moves back.
        warp = np.clip(warp @ np.linalg.inv(shape), -2.0, 2.0)
        found = found - np.einsum("nij,nj->ni", warp, np.clip(step[:, :2], -1.0, 1.0))
    seen = normalised(sample(second.spline, found[:, None] + offsets @ warp.swapaxes(1, 2)))
    likeness = (wanted * seen).sum(axis=1)
    height, width = second.grey.shape
    inside = np.all((found > _HALF) & (found < [width - _HALF, height - _HALF]), axis=1)
    near = np.abs(found - starts).max(axis=1) < _LARGEST_SHIFT
    sane = np.abs(warp - np.eye(2)).max(axis=(1, 2)) < 0.6
    return found, near & inside & sane & (likeness > _ALIKE)


def _contrast(patches: Float[np.ndarray, "n area"]) -> Float[np.ndarray, "n 1"]:
    deviation = patches - patches.mean(axis=1, keepdims=True)
    return np.maximum(np.linalg.norm(deviation, axis=1, keepdims=True), 1e-6)


def _moment(right: np.ndarray, down: np.ndarray, along: str) -> np.ndarray:
    """Returns the windowed sum of the structure tensor times the offset from each pixel."""
    reach = int(4 * _WINDOW + 0.5)
    ticks = np.arange(-reach, reach + 1.0)
    weights = np.exp(-0.5 * (ticks / _WINDOW) ** 2)
    weights /= weights.sum()
    plain, moment = weights, weights * ticks

    def summed(product: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        once = scipy.ndimage.correlate1d(product, rows, axis=0, mode="nearest")
        return scipy.ndimage.correlate1d(once, columns, axis=1, mode="nearest")

    first, second = (right, down) if along == "x" else (down, right)
    if along == "x":
        return summed(first * first, plain, moment) + summed(first * second, moment, plain)
    return summed(first * first, moment, plain) + summed(first * second, plain, moment)


def _offsets() -> Float[np.ndarray, "area 2"]:
    ticks = np.arange(-_HALF, _HALF + 1.0)
    return np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)


def _around(places: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n area 2"]:
    return places[:, None] + _offsets()


def pair_up(
    likeness: Float[np.ndarray, "n m"], possible: Bool[np.ndarray, "n m"], *, least: float
) -> Int[np.ndarray, "pairs 2"]:
    """Returns the pairs that prefer each other, clearly to any other possible one.

    Args:
      likeness: correlation of each patch with each other.
      possible: pairs that geometry allows.
      least: least correlation.
    """
    if 0 in likeness.shape:
        return np.zeros((0, 2), np.int64)
    scores = np.where(possible, likeness, -1.0)
    best, best_back = scores.argmax(axis=1), scores.argmax(axis=0)
    first = np.arange(len(scores))
    kept = (best_back[best] == first) & (scores[first, best] > least)
    others = scores.copy()
    others[first, best] = -1.0
    kept &= 1.0 - scores[first, best] < 0.7 * (1.0 - others.max(axis=1))
    return np.stack([first[kept], best[kept]], axis=-1)
