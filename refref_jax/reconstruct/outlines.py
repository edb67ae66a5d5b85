"""Outlines of convex bodies in views (NumPy only).

The outline of a convex body is the convex polygon around the images of its *corners*, the points
whose hull it is. In pixels, column to the right and row downwards; the centre of a pixel lies half
a pixel from its edges. A polygon's corners come in the order in which it turns.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import map_coordinates
from scipy.spatial import ConvexHull

from refref_jax.geometry.cameras import Cameras, Projection, project
from refref_jax.reconstruct.grids import Values
from refref_jax.reconstruct.silhouettes import Views, overlaps

Pixels = Float[np.ndarray, "points 2"]
Polygon = Float[np.ndarray, "corners 2"]
Image = Float[np.ndarray, "h w"]
Corners = Float[np.ndarray, "corners 3"]


class Samples(NamedTuple):
    """Points on a polygon's edges.

    Attributes:
      pixels: column and row.
      first: the corner where the edge begins.
      second: the corner where it ends.
      shares: of the second corner in the point.
    """

    pixels: Float[np.ndarray, "points 2"]
    first: Int[np.ndarray, " points"]
    second: Int[np.ndarray, " points"]
    shares: Float[np.ndarray, " points"]


def projection_slopes(
    seen: Projection, pose: Float[np.ndarray, "3 4"], cameras: Cameras
) -> Float[np.ndarray, "points 2 3"]:
    """Returns the derivatives of column and row by points, pixels over world units.

    They are zero where nothing is in front of the camera.

    Args:
      seen: the points as the camera sees them.
      pose: of the camera.
      cameras: that it is one of.
    """
    middle = 0.5 * np.array([cameras.width, cameras.height])
    x, y = ((seen.pixels - middle) / cameras.focal).T
    zero, one = np.zeros_like(x), np.ones_like(x)
    in_camera = np.stack(
        [np.stack([one, zero, x], axis=-1), np.stack([zero, -one, y], axis=-1)], axis=1
    )
    depths = seen.depths
    scale = np.divide(cameras.focal, depths, out=np.zeros_like(depths), where=depths > 0.0)
    return scale[:, None, None] * in_camera @ pose[:, :3].T


def polygon(pixels: Pixels) -> Int[np.ndarray, " corners"]:
    """Returns which points are corners of the convex polygon around all, in order.

    Raises:
      QhullError: if they lie on a line.
    """
    return ConvexHull(pixels).vertices.astype(np.int64)


def excess(corners: Polygon, pixels: Pixels) -> Values:
    """Returns how far points lie outside of a convex polygon's nearest side, negative inside."""
    along = np.roll(corners, -1, axis=0) - corners
    outward = np.stack([along[:, 1], -along[:, 0]], axis=-1)
    outward /= np.linalg.norm(along, axis=-1, keepdims=True)
    return np.max(pixels @ outward.T - np.sum(outward * corners, axis=-1), axis=1)


def heights(corners: Polygon) -> Float[np.ndarray, " corners"]:
    """Returns how far each corner lies from the line through its two neighbours."""
    before = np.roll(corners, 1, axis=0)
    across, side = np.roll(corners, -1, axis=0) - before, corners - before
    area = across[:, 0] * side[:, 1] - across[:, 1] * side[:, 0]
    return np.abs(area) / np.linalg.norm(across, axis=-1)


def along_edges(corners: Polygon, *, margin: float) -> Samples:
    """Returns points on a polygon's edges, about one a pixel, some way from where it turns.

    Args:
      corners: of the polygon.
      margin: pixels that are left out on both sides of a right angle; of another, in proportion to
        one less the cosine by which the polygon turns; but no more than a third of an edge.
    """
    along = np.roll(corners, -1, axis=0) - corners
    length = np.linalg.norm(along, axis=-1)
    unit = along / length[:, None]
    turn = margin * (1.0 - np.sum(unit * np.roll(unit, 1, axis=0), axis=-1))
    start = np.minimum(turn, length / 3.0)
    rest = length - start - np.minimum(np.roll(turn, -1), length / 3.0)
    counts = np.maximum(np.ceil(rest), 1).astype(np.int64)
    edge = np.repeat(np.arange(len(corners)), counts)
    number = np.arange(len(edge)) - (np.cumsum(counts) - counts)[edge]
    shares = (start[edge] + (number + 0.5) / counts[edge] * rest[edge]) / length[edge]
    pixels = corners[edge] + shares[:, None] * along[edge]
    return Samples(pixels, edge, (edge + 1) % len(corners), shares)


def look_up(image: Image, pixels: Pixels) -> tuple[Values, Pixels]:
    """Returns an image's values between pixel centres, and their slopes over a pixel."""
    column, row = pixels.T - 0.5

    def value(down: float, right: float) -> Values:
        return map_coordinates(image, [row + down, column + right], order=1, mode="nearest")

    across = value(0.0, 0.5) - value(0.0, -0.5)
    along = value(0.5, 0.0) - value(-0.5, 0.0)
    return value(0.0, 0.0), np.stack([across, along], axis=-1)


def outline_overlaps(corners: Corners, views: Views) -> Float[np.ndarray, " views"]:
    """Returns the overlap of mask and outline in each view (IoU)."""
    cameras = views.cameras
    images = (project(corners, pose, cameras).pixels for pose in cameras.poses)
    seen = [_fill(pixels[polygon(pixels)], cameras.height, cameras.width) for pixels in images]
    return overlaps(np.stack(seen), views.masks)


def _fill(corners: Polygon, height: int, width: int) -> Bool[np.ndarray, "h w"]:
    """Returns which pixels have their centres in a convex polygon."""
    (x0, y0), (x1, y1) = corners.T, np.roll(corners, -1, axis=0).T
    row, column = np.arange(height)[:, None] + 0.5, np.arange(width) + 0.5
    crossed = (y0 <= row) != (y1 <= row)
    share = np.divide(row - y0, y1 - y0, out=np.zeros(crossed.shape), where=crossed)
    at = x0 + share * (x1 - x0)
    left = np.min(at, axis=1, where=crossed, initial=np.inf)
    right = np.max(at, axis=1, where=crossed, initial=-np.inf)
    return (left[:, None] <= column) & (column <= right[:, None])
