"""Masks as signed distances in the image, to a fraction of a pixel (NumPy only).

A mask says of each pixel's centre whether the body is seen there, so its outline is known to half a
pixel, in steps. Signed distances to the steps, averaged over a neighbourhood, are known better:
along a straight edge the steps cancel. A plain Gaussian average would also pull in an outline that
bends, by `blur^2 / 2` times its curvature; half of its Laplacian is taken off, which keeps every
quadratic, so that discs keep their size, and corners are rounded less.

Measured on discs of 34 pixels' radius and squares at all angles, in pixels: steps alone 0.23 RMS
error; blur 1.5: 0.14, mean below 0.01, corners cut back by 0.5; blur 3: 0.10, 0.01 and 1.0.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt, gaussian_filter, gaussian_laplace

from refref_jax.geometry.cameras import Cameras
from refref_jax.reconstruct import ReconstructionError

BLUR = 1.5
"""Standard deviation in pixels of the average over an outline."""


class Views(NamedTuple):
    """What is seen of a body.

    Attributes:
      masks: one a camera, true where the body is seen.
      cameras: of the masks, in the same order.
    """

    masks: Bool[np.ndarray, "views h w"]
    cameras: Cameras


def some_of(views: Views, count: int) -> Views:
    """Returns so many views at most, evenly spread over their order."""
    return views_at(views, np.unique(np.linspace(0, len(views.masks) - 1, count).astype(np.int64)))


def views_at(views: Views, kept: Int[np.ndarray, " kept"] | Bool[np.ndarray, " views"]) -> Views:
    """Returns some of the views, by their numbers or by a flag for each."""
    return Views(views.masks[kept], views.cameras._replace(poses=views.cameras.poses[kept]))


def overlaps(
    seen: Bool[np.ndarray, "views h w"], masks: Bool[np.ndarray, "views h w"]
) -> Float[np.ndarray, " views"]:
    """Returns for each view the pixels in both of two masks over those in either (IoU).

    A view in which both are empty counts 1.
    """
    both = np.sum(seen & masks, axis=(1, 2))
    either = np.sum(seen | masks, axis=(1, 2))
    return np.where(either > 0, both / np.maximum(either, 1), 1.0)


def check_masks(masks: np.ndarray, cameras: Cameras) -> None:
    """Checks that there are masks, one a camera, of its size, and that each marks something.

    Raises:
      ReconstructionError: otherwise, if masks are no booleans, or if cameras are not finite.
    """
    if masks.dtype != np.bool_:
        raise ReconstructionError(
            f"The masks are {masks.dtype}. Give booleans, as in masks > 127 of 8 bits."
        )
    if len(masks) == 0:
        raise ReconstructionError("There is no mask. Give one for each camera, several in all.")
    if len(masks) != len(cameras.poses):
        raise ReconstructionError(
            f"There are {len(masks)} masks and {len(cameras.poses)} cameras. Give one mask for "
            "each camera."
        )
    broken = np.flatnonzero(~np.all(np.isfinite(cameras.poses), axis=(1, 2)))
    if len(broken) or not 0.0 < cameras.focal < np.inf:
        raise ReconstructionError(
            f"Poses that are not finite: {len(broken)}, of cameras {broken[:5]}; the focal "
            f"length is {cameras.focal}. Leave these views out, and give the length in pixels."
        )
    height, width = masks.shape[1:]
    if (height, width) != (cameras.height, cameras.width):
        raise ReconstructionError(
            f"The masks are {width} x {height} pixels, but the cameras {cameras.width} x "
            f"{cameras.height}. Resize the masks, or give the cameras their size and focal length."
        )
    if len(empty := np.flatnonzero(~masks.any(axis=(1, 2)))):
        raise ReconstructionError(
            f"{_listed(empty)} of {len(masks)} masks mark nothing, which leaves no body. Leave "
            "these views out, or mark the object there."
        )


def signed_distances(
    mask: Bool[np.ndarray, "h w"], *, blur: float = BLUR
) -> Float[np.ndarray, "h w"]:
    """Returns distances to a mask's outline at pixel centres, in pixels, negative inside.

    Of an outline the image's border cuts through nothing is known outside; there the distance is
    that to the outline within the image, and `-inf` everywhere in a mask that marks every pixel.

    Args:
      mask: true where the object is seen.
      blur: standard deviation of the average in pixels, see the module; 0 for the steps alone.
    """
    if mask.all():
        return np.full(mask.shape, -np.inf)
    if not mask.any():
        return np.full(mask.shape, np.inf)
    inside, outside = distance_transform_edt(mask), distance_transform_edt(~mask)
    # From a pixel's centre to the middle between it and the next.
    steps = np.where(mask, 0.5 - inside, outside - 0.5)
    if blur == 0.0:
        return steps
    smooth = gaussian_filter(steps, blur, mode="nearest")
    return smooth - 0.5 * blur**2 * gaussian_laplace(steps, blur, mode="nearest")


def _listed(views: Int[np.ndarray, " views"]) -> str:
    """Names the first few views."""
    names = ", ".join(str(view) for view in views[:5])
    return f"Views {names}{', ...' if len(views) > 5 else ''}: {len(views)}"
