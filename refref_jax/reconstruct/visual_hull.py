"""The largest body that fits a set of masks (NumPy only).

A view carves away what projects outside of its mask. The hull's field at a point is the largest
over views of the signed distance to the outline, in pixels, times planar depth over focal length:
the zero set of that maximum is the exact hull, and near it the field is a distance in world units.

The hull of finitely many views encloses the body: a ball becomes tangent cones. No view sees into a
cavity, or into a dent that no line of sight grazes, and those stay filled.

Outlines are known to a fraction of a pixel, and at every point the view that errs most inwards
wins. So the hull would lie within the true one: by the error of one outline where a surface is
smooth, and by twice that at an edge, which many views have on their outlines. A tolerance in pixels
undoes it.

Source: Laurentini, The Visual Hull Concept for Silhouette-Based Image Understanding (1994).
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import map_coordinates

from refref_jax.geometry.cameras import Cameras, project
from refref_jax.reconstruct import ReconstructionError
from refref_jax.reconstruct.grids import Box, Field, Grid, Points, Values, lattice, sample
from refref_jax.reconstruct.masks import BLUR, check_masks, signed_distances

REACH = 2.1
"""Half the edge of the cube around the origin in which a body is looked for, world units."""

TOLERANCE = 0.05
"""Pixels outside of an outline up to which nothing is carved: about half a standard error."""

LEAST_RESOLUTION = 10
"""Cells of a grid, of which some are its rim."""

_LIMITLESS = (
    "What {count} masks leave reaches out of the cube from -{reach} to {reach} around the origin, "
    "in which a body is looked for. Give masks from other sides, if few views see it; else scale "
    "and shift the poses, so that the object lies within."
)

# What stands for a distance where there is no outline, so that a grid can be interpolated.
_FAR = 4.0 * REACH

# Cells along the cube's edge when a box is looked for, and how many of them are added around it.
_SEARCH = 48
_MARGIN = 1.0

# Cells that are added around the box in the end, so that the surface stays within.
_RIM = 3


def carve(
    masks: Bool[np.ndarray, "views h w"],
    cameras: Cameras,
    *,
    resolution: int = 128,
    box: Box | None = None,
    outliers: int = 0,
    tolerance: float = TOLERANCE,
    blur: float = BLUR,
    names: Sequence[str] | None = None,
) -> Grid:
    """Returns the field of the masks' hull on a grid.

    A point outside of a view's image or behind its camera is not carved by that view; a point that
    no more views see than are passed over is empty.

    `outliers` views may be wrong: at each point the that many largest values are passed over. A
    mask that misses part of the body, or is shifted, then does no harm. It costs accuracy
    everywhere: what only so many views see is no longer carved, so that the body grows between
    tangent cones. Nor is it a vote among near views: masks that all err alike are believed.

    Args:
      masks: one a view, true where the object is seen.
      cameras: of the masks, in the same order.
      resolution: cells along the longest edge of the box, at least `LEAST_RESOLUTION`.
      box: where the body lies; found from the masks within `REACH` of the origin if not given.
      outliers: values passed over at each point.
      tolerance: pixels outside of an outline up to which nothing is carved, see the module.
      blur: of the outlines in pixels, see `masks`.
      names: what the masks are called in errors; their numbers if not given.

    Raises:
      ReconstructionError: if there is no mask, if a mask is empty, of another size or no booleans,
        if a pose is not finite, if as many views are passed over as there are, if the grid is too
        coarse, if nothing is left, or if what is left reaches out of the cube of `REACH` (as with
        one view).
    """
    check_masks(masks, cameras)
    if not 0 <= outliers < len(masks):
        raise ReconstructionError(
            f"outliers={outliers}, but there are {len(masks)} views. Pass over fewer, 0 or more."
        )
    if resolution < LEAST_RESOLUTION:
        raise ReconstructionError(
            f"resolution={resolution} is too coarse. Give {LEAST_RESOLUTION} cells or more."
        )
    field = hull_field(masks, cameras, outliers=outliers, tolerance=tolerance, blur=blur)
    if box is None:
        box = find_box(field, masks, cameras, names=names)
    spacing = float(np.max(box.high - box.low)) / (resolution - 2 * _RIM)
    wide = Box(box.low - _RIM * spacing, box.high + _RIM * spacing)
    grid = sample(field, wide, spacing=spacing)
    if not np.any(grid.values < 0.0):
        raise ReconstructionError(_explanation(masks, cameras, box, names))
    return grid


def hull_field(
    masks: Bool[np.ndarray, "views h w"],
    cameras: Cameras,
    *,
    outliers: int = 0,
    tolerance: float = TOLERANCE,
    blur: float = BLUR,
) -> Field:
    """Returns the field of the masks' hull as a function of points, see `carve`."""
    images = [signed_distances(mask, blur=blur) - tolerance for mask in masks]

    def field(points: Points) -> Values:
        # The largest so far, in falling order.
        largest = np.full((outliers + 1, len(points)), -np.inf)
        for image, pose in zip(images, cameras.poses, strict=True):
            value = view_values(image, pose, cameras, points)
            for rank in range(outliers + 1):
                value, largest[rank] = (
                    np.minimum(largest[rank], value),
                    np.maximum(largest[rank], value),
                )
        unseen = np.isneginf(largest[-1])
        return np.where(unseen, _FAR, np.minimum(largest[-1], _FAR))

    return field


def find_box(
    field: Field,
    masks: Bool[np.ndarray, "views h w"],
    cameras: Cameras,
    *,
    names: Sequence[str] | None = None,
) -> Box:
    """Returns a box around the body, which must lie within the cube of `REACH`.

    Args:
      field: the hull's, from `hull_field`.
      masks: of which it is the hull.
      cameras: of the masks.
      names: what the masks are called in errors; their numbers if not given.

    Raises:
      ReconstructionError: if nothing is left, or the body reaches out of the cube.
    """
    ends = np.full(3, REACH)
    grid = sample(field, Box(-ends, ends), spacing=2.0 * REACH / _SEARCH)
    # Within half a cell's diagonal of the surface, so that a thin body is not overlooked.
    inside = np.argwhere(grid.values < 0.87 * grid.spacing)
    if len(inside) == 0:
        raise ReconstructionError(_explanation(masks, cameras, Box(-ends, ends), names))
    if _reaches_border(grid):
        raise ReconstructionError(_LIMITLESS.format(count=len(masks), reach=REACH))
    low = grid.low + grid.spacing * (inside.min(axis=0) - _MARGIN)
    high = grid.low + grid.spacing * (inside.max(axis=0) + _MARGIN)
    return Box(np.maximum(low, -ends), np.minimum(high, ends))


def view_values(
    image: Float[np.ndarray, "h w"],
    pose: Float[np.ndarray, "3 4"],
    cameras: Cameras,
    points: Points,
) -> Values:
    """Returns one view's signed distances in world units, `-inf` where it sees nothing."""
    (column, row), depth = (part.T for part in project(points, pose, cameras))
    seen = (depth > 0.0) & (column >= 0) & (column <= cameras.width)
    seen &= (row >= 0) & (row <= cameras.height)
    values = np.full(len(points), -np.inf)
    if np.all(np.isneginf(image)):
        values[seen] = -_FAR
    else:
        at = np.stack([row[seen], column[seen]]) - 0.5
        pixels = map_coordinates(image, at, order=1, mode="nearest")
        values[seen] = pixels * depth[seen] / cameras.focal
    return values


def values_by_view(
    masks: Bool[np.ndarray, "views h w"], cameras: Cameras, points: Points
) -> Float[np.ndarray, "views points"]:
    """Returns `view_values` of all views, of outlines as coarse as the masks' pixels."""
    views = zip(masks, cameras.poses, strict=True)
    return np.stack(
        [
            view_values(signed_distances(mask, blur=0.0), pose, cameras, points)
            for mask, pose in views
        ]
    )


def _reaches_border(grid: Grid) -> bool:
    """Returns whether a body goes on where its grid ends."""
    return any(
        bool(np.any(np.take(grid.values, end, axis=axis) < 0.0))
        for axis in range(3)
        for end in (0, -1)
    )


def _explanation(
    masks: Bool[np.ndarray, "views h w"],
    cameras: Cameras,
    box: Box,
    names: Sequence[str] | None,
) -> str:
    """Says which view removed the most of what all others leave."""
    carved = values_by_view(masks, cameras, lattice(box, 24)) > 0.0
    alone = carved & (carved.sum(axis=0) == 1)
    view = int(np.argmax(alone.sum(axis=1) + carved.mean(axis=1)))
    name = f"View {view}" if names is None else names[view]
    return (
        f"Nothing is left after carving with {len(masks)} masks between {np.round(box.low, 2)} and "
        f"{np.round(box.high, 2)}. {name} removed the most: {carved[view].mean():.0%} of the box, "
        f"and {int(alone[view].sum())} of {carved.shape[1]} points that no other view did. Check "
        "its mask and its pose, pass over outliers, or give a finer resolution."
    )
