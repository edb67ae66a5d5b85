"""Turns masks into signed distances in the image, with subpixel accuracy (NumPy only).

A mask states for each pixel centre whether the object is visible there, so the outline is known to
half a pixel, as a staircase. Averaging the signed distances to its steps over a neighbourhood is
more accurate, because the steps cancel along a straight edge. A plain Gaussian average would also
pull in a curved outline, by `blur^2 / 2` times its curvature. Half of the Laplacian is therefore
subtracted, which preserves every quadratic: discs keep their size, and corners are rounded less.

Errors measured on discs with a radius of 34 pixels and on squares at all angles, in pixels: steps
alone 0.23 RMS; blur 1.5: 0.14 RMS, mean below 0.01, corners cut back by 0.5; blur 3: 0.10, 0.01 and
1.0.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt, gaussian_filter, gaussian_laplace

from refref_jax.geometry.cameras import Cameras
from refref_jax.reconstruct import ReconstructionError

BLUR = 1.5
"""Standard deviation of the average over an outline, pixels."""


class Views(NamedTuple):
    """Masks of an object and their cameras.

    Attributes:
      masks: one mask per camera, true where the object is visible.
      cameras: cameras of the masks, in the same order.
    """

    masks: Bool[np.ndarray, "views h w"]
    cameras: Cameras


def some_of(views: Views, count: int) -> Views:
    """Returns at most `count` views, evenly spread over their order."""
    return views_at(views, np.unique(np.linspace(0, len(views.masks) - 1, count).astype(np.int64)))


def views_at(views: Views, kept: Int[np.ndarray, " kept"] | Bool[np.ndarray, " views"]) -> Views:
    """Returns some of the views, by their numbers or by a flag for each."""
    return Views(views.masks[kept], views.cameras._replace(poses=views.cameras.poses[kept]))


def overlaps(
    seen: Bool[np.ndarray, "views h w"], masks: Bool[np.ndarray, "views h w"]
) -> Float[np.ndarray, " views"]:
    """Returns the intersection over union (IoU) of two masks in each view.

    It is 1 in a view in which both are empty.
    """
    both = np.sum(seen & masks, axis=(1, 2))
    either = np.sum(seen | masks, axis=(1, 2))
    return np.where(either > 0, both / np.maximum(either, 1), 1.0)


def check_masks(masks: np.ndarray, cameras: Cameras) -> None:
    """Checks that there is one nonempty mask of the right size for each camera.

    Raises:
      ReconstructionError: if not, if masks are not boolean, or if poses are not finite.
    """
    if masks.dtype != np.bool_:
        raise ReconstructionError(
            f"The masks have the type {masks.dtype}. Pass booleans, such as masks > 127."
        )
    if len(masks) == 0:
        raise ReconstructionError("There are no masks. Pass one mask for each of several cameras.")
    if len(masks) != len(cameras.poses):
        raise ReconstructionError(
            f"There are {len(masks)} masks and {len(cameras.poses)} cameras. Pass one mask for "
            "each camera."
        )
    broken = np.flatnonzero(~np.all(np.isfinite(cameras.poses), axis=(1, 2)))
    if len(broken) or not 0.0 < cameras.focal < np.inf:
        raise ReconstructionError(
            f"{len(broken)} poses are not finite, of cameras {broken[:5]}; the focal length is "
            f"{cameras.focal}. Remove these views, and pass a focal length in pixels."
        )
    height, width = masks.shape[1:]
    if (height, width) != (cameras.height, cameras.width):
        raise ReconstructionError(
            f"The masks are {width} x {height} pixels, but the cameras {cameras.width} x "
            f"{cameras.height}. Resize the masks, or adapt the cameras' size and focal length."
        )
    if len(empty := np.flatnonzero(~masks.any(axis=(1, 2)))):
        raise ReconstructionError(
            f"{_listed(empty)} of {len(masks)} masks are empty. Remove these views, or mark the "
            "object in their masks."
        )


def signed_distances(
    mask: Bool[np.ndarray, "h w"], *, blur: float = BLUR
) -> Float[np.ndarray, "h w"]:
    """Returns distances to a mask's outline at pixel centres, in pixels, negative inside.

    Where the border of the image cuts the object, the outline outside of the image is unknown;
    there the distance is that to the outline within the image. It is `-inf` everywhere in a mask
    that marks every pixel.

    Args:
      mask: true where the object is visible.
      blur: standard deviation of the average in pixels, see the module; 0 for the steps alone.
    """
    if mask.all():
        return np.full(mask.shape, -np.inf)
    if not mask.any():
        return np.full(mask.shape, np.inf)
    inside, outside = distance_transform_edt(mask), distance_transform_edt(~mask)
    # From the centre of a pixel to the edge it shares with the next pixel.
    steps = np.where(mask, 0.5 - inside, outside - 0.5)
    if blur == 0.0:
        return steps
    smooth = gaussian_filter(steps, blur, mode="nearest")
    return smooth - 0.5 * blur**2 * gaussian_laplace(steps, blur, mode="nearest")


def _listed(views: Int[np.ndarray, " views"]) -> str:
    """Returns the numbers of the first few views, as text."""
    names = ", ".join(str(view) for view in views[:5])
    return f"Views {names}{', ...' if len(views) > 5 else ''}: {len(views)}"
