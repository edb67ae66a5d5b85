"""Brings photographs of pinholes into one camera by cropping alone: no pixel is interpolated.

Images are cropped so that the principal point is their centre, to within half a pixel, and cameras
whose focal lengths differ by less than half a pixel at the border of the image share their mean.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from experiments.captures.capture import CaptureFrame
from refref_jax.data import SceneError

# Maximum displacement of a pixel at the border of an image, pixels.
_TOLERANCE = 0.5

# Minimum share of an image that is kept; for less, the principal point must be wrong.
_LEAST_KEPT = 0.5


class Windows(NamedTuple):
    """Crop windows of the images of a split, along one axis.

    Attributes:
      starts: first pixel of each image's window.
      size: size of all windows, pixels.
      shift: maximum distance of a principal point from the centre of its window, pixels.
    """

    starts: Int[np.ndarray, " images"]
    size: int
    shift: float


def centred_windows(centres: Float[np.ndarray, " images"], size: int) -> Windows:
    """Returns the largest windows of one size that are centred on the principal points.

    Of the largest even and the largest odd size, the one with the smaller shift is used, and the
    larger one if the shifts are equal.

    Args:
      centres: principal points along the axis, pixels from the border, within the images.
      size: size of the images, pixels.
    """
    found: list[Windows] = []
    for kept in range(size, 0, -1):
        starts = np.rint(centres - 0.5 * kept).astype(np.int64)
        if np.all((starts >= 0) & (starts + kept <= size)):
            found.append(Windows(starts, kept, float(np.abs(starts + 0.5 * kept - centres).max())))
        if len(found) == 2:
            break
    return min(found, key=lambda windows: windows.shift)


class Crop(NamedTuple):
    """The camera that all frames of a split share.

    Attributes:
      columns, rows: crop windows of the images.
      focal: focal length, pixels.
      stretch: maximum displacement of border pixels by the shared focal length, pixels.
    """

    columns: Windows
    rows: Windows
    focal: float
    stretch: float

    def window(self, number: int) -> tuple[slice, slice]:
        """Returns the rows and columns that are kept of an image."""
        top, left = self.rows.starts[number], self.columns.starts[number]
        return slice(top, top + self.rows.size), slice(left, left + self.columns.size)


def find_crop(frames: Sequence[CaptureFrame]) -> Crop:
    """Returns how the images of a split are cropped.

    Raises:
      SceneError: if a lens has distortion, or cameras differ too much to share one.
    """
    first = frames[0].intrinsics
    for frame in frames:
        lens = frame.intrinsics
        if not frame.distortion.is_none:
            raise SceneError(
                f"The lens of {frame.name} has distortion, {frame.distortion.describe()}. "
                "Let it be resampled (resample=auto)."
            )
        if (lens.width, lens.height) != (first.width, first.height):
            raise SceneError(
                f"{frame.name} is {lens.width} x {lens.height} pixels, but {frames[0].name} is "
                f"{first.width} x {first.height}. Images of a split must have one size: leave "
                "out one size, or list them in different splits (train_filenames, ...)."
            )
    half = 0.5 * max(first.width, first.height)
    focals = np.array([(frame.intrinsics.focal_x, frame.intrinsics.focal_y) for frame in frames])
    focal = float(focals.mean())
    for frame, (along, across) in zip(frames, focals, strict=True):
        if half * abs(along - across) / (along + across) > _TOLERANCE:
            raise SceneError(
                f"The pixels of {frame.name} are not square: fl_x is {along:g}, and fl_y "
                f"{across:g}. Estimate a single focal length (COLMAP's SIMPLE_RADIAL, then "
                "image_undistorter), or resize the images to square pixels."
            )
    stretches = half * np.abs(focals - focal).max(axis=-1) / focal
    if stretches.max() > _TOLERANCE:
        frame = frames[int(np.argmax(stretches))]
        raise SceneError(
            f"The focal length of {frame.name} is {frame.intrinsics.focal_x:g} pixels, but the "
            f"mean is {focal:g}. All frames of a split share one: calibrate them as one camera "
            "(COLMAP's single_camera), or list them in different splits (train_filenames, ...)."
        )
    columns = _windows(frames, [frame.intrinsics.centre_x for frame in frames], first.width)
    rows = _windows(frames, [frame.intrinsics.centre_y for frame in frames], first.height)
    return Crop(columns, rows, focal, float(stretches.max()))


def _windows(frames: Sequence[CaptureFrame], centres: Sequence[float], size: int) -> Windows:
    off = np.abs(np.array(centres) - 0.5 * size)
    if off.max() > 0.5 * (1.0 - _LEAST_KEPT) * size:
        frame = frames[int(np.argmax(off))]
        raise SceneError(
            f"The principal point of {frame.name} is ({frame.intrinsics.centre_x:g}, "
            f"{frame.intrinsics.centre_y:g}), far from the centre of its {frame.intrinsics.width} "
            f"x {frame.intrinsics.height} pixels. Check that cx and cy belong to these images."
        )
    return centred_windows(np.array(centres), size)
