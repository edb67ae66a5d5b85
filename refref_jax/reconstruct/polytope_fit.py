"""Fits a convex polytope to the outlines of masks (NumPy only).

The outline of a convex object is the convex polygon around the images of its *corners*, the points
whose hull it is. Image coordinates are in pixels, column to the right and row downwards; the centre
of a pixel lies half a pixel from its edges. The corners of a polygon are listed in the order in
which it turns.

A visual hull bulges over a flat face, because few views lie in its plane. No mask shows the bulge:
in every view, it is within the outline of the face. What the masks do show is the position of the
corners. Therefore the simplest convex polytope with the outlines of the masks is fitted. Among the
hull's points, the one that sticks out furthest from the current outlines is added as a corner, as
long as it does so by more than a tolerance. All corners are then moved by least squares until the
outlines match those of the masks, and corners that do not affect any outline are removed. This is
repeated with finer tolerances. A corner is visible in many views, so it is located far more
accurately than an outline: to a hundredth of a pixel where the outlines are off by 0.14.

A curved rim becomes a ring of corners a few pixels apart, so cylinders can be fitted. Balls cannot,
because each of their corners hardly sticks out.

Related: Prince and Willsky, Reconstructing Convex Sets from Support Line Measurements (1990).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import map_coordinates
from scipy.sparse import coo_array, csr_array, vstack
from scipy.spatial import ConvexHull, KDTree, QhullError

from refref_jax.geometry.cameras import Cameras, Projection, project
from refref_jax.geometry.triangle_meshes import Mesh
from refref_jax.reconstruct import ReconstructionError
from refref_jax.reconstruct.convex import hull, of_points, weigh_facets
from refref_jax.reconstruct.grids import Points, Values
from refref_jax.reconstruct.masks import BLUR, Views, overlaps, signed_distances, views_at

Pixels = Float[np.ndarray, "points 2"]
Polygon = Float[np.ndarray, "corners 2"]
Image = Float[np.ndarray, "h w"]
Corners = Float[np.ndarray, "corners 3"]


class Samples(NamedTuple):
    """Points on a polygon's edges.

    Attributes:
      pixels: column and row of each point.
      first: corner at which the edge begins.
      second: corner at which it ends.
      shares: weight of the second corner in the point.
    """

    pixels: Float[np.ndarray, "points 2"]
    first: Int[np.ndarray, " points"]
    second: Int[np.ndarray, " points"]
    shares: Float[np.ndarray, " points"]


def projection_slopes(
    seen: Projection, pose: Float[np.ndarray, "3 4"], cameras: Cameras
) -> Float[np.ndarray, "points 2 3"]:
    """Returns the derivatives of column and row with respect to points, pixels per world unit.

    They are zero for points behind the camera.

    Args:
      seen: projections of the points.
      pose: pose of the camera.
      cameras: cameras that share its intrinsics.
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
    """Returns the indices of the corners of the convex polygon around all points, in order.

    Raises:
      QhullError: if the points are collinear.
    """
    return ConvexHull(pixels).vertices.astype(np.int64)


def excess(corners: Polygon, pixels: Pixels) -> Values:
    """Returns the distances of points from a convex polygon's nearest side, negative inside."""
    along = np.roll(corners, -1, axis=0) - corners
    outward = np.stack([along[:, 1], -along[:, 0]], axis=-1)
    outward /= np.linalg.norm(along, axis=-1, keepdims=True)
    return np.max(pixels @ outward.T - np.sum(outward * corners, axis=-1), axis=1)


def heights(corners: Polygon) -> Float[np.ndarray, " corners"]:
    """Returns the distance of each corner from the line through its two neighbours."""
    before = np.roll(corners, 1, axis=0)
    across, side = np.roll(corners, -1, axis=0) - before, corners - before
    area = across[:, 0] * side[:, 1] - across[:, 1] * side[:, 0]
    return np.abs(area) / np.linalg.norm(across, axis=-1)


def along_edges(corners: Polygon, *, margin: float) -> Samples:
    """Returns points on a polygon's edges, about one per pixel, with a margin at the corners.

    Args:
      corners: corners of the polygon, in order.
      margin: margin on both sides of a right angle, pixels; at other angles it is proportional to
        one minus the cosine of the turning angle, and at most a third of an edge.
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
    """Returns an image's values interpolated between pixel centres, and their slopes per pixel."""
    column, row = pixels.T - 0.5
    down = np.array([0.0, 0.0, 0.0, 0.5, -0.5])[:, None]
    right = np.array([0.0, 0.5, -0.5, 0.0, 0.0])[:, None]
    values = map_coordinates(image, [row + down, column + right], order=1, mode="nearest")
    return values[0], np.stack([values[1] - values[2], values[3] - values[4]], axis=-1)


def outline_overlaps(corners: Corners, views: Views) -> Float[np.ndarray, " views"]:
    """Returns the overlap (IoU) of mask and projected hull in each view."""
    cameras = views.cameras
    images = (project(corners, pose, cameras).pixels for pose in cameras.poses)
    seen = [_fill(pixels[polygon(pixels)], cameras.height, cameras.width) for pixels in images]
    return overlaps(np.stack(seen), views.masks)


def _fill(corners: Polygon, height: int, width: int) -> Bool[np.ndarray, "h w"]:
    """Returns the pixels whose centres lie in a convex polygon."""
    (x0, y0), (x1, y1) = corners.T, np.roll(corners, -1, axis=0).T
    row, column = np.arange(height)[:, None] + 0.5, np.arange(width) + 0.5
    crossed = (y0 <= row) != (y1 <= row)
    share = np.divide(row - y0, y1 - y0, out=np.zeros(crossed.shape), where=crossed)
    at = x0 + share * (x1 - x0)
    left = np.min(at, axis=1, where=crossed, initial=np.inf)
    right = np.max(at, axis=1, where=crossed, initial=-np.inf)
    return (left[:, None] <= column) & (column <= right[:, None])


MOST = 128
"""Largest number of corners."""

# Tolerance of each round, in pixels: a point must stick out by it to become a corner, and a corner
# to remain one.
_TOLERANCES = (2.0, 1.0, 0.5, 0.3, 0.15)

# Rank of the view that decides how far a point sticks out, counted from the largest value: up to
# one view less than this may be wrong.
_RANK = 3

# Least median overlap of outline and mask. Below it the masks are so inaccurate that a round object
# would be fitted by corners.
_EXPLAINED = 0.97

# Number of directions whose extreme points are the initial corners.
_FIRST = 12

# Gauss-Newton: steps per round; longest step in pixels; step in pixels below which a round ends;
# damping of every coordinate, as a share of its diagonal entry.
_STEPS = 12
_LONGEST = 4.0
_SHORTEST = 0.01
_HOLD = 1e-3

# Distances above this many pixels enter linearly instead of squared (Huber).
_OUTLYING = 0.5

# Margin at a right angle, in multiples of the blur: there the masks' outlines are cut back.
_MARGIN = 2.0


def fit_corners(mesh: Mesh, candidates: Mesh, views: Views, *, most: int = MOST) -> Mesh:
    """Returns the hull of the fewest corners that reproduce the outlines of masks.

    Views with a part of the object behind the camera are ignored. Up to two of the views that show
    a corner may be arbitrarily wrong: they neither add nor remove it, and hardly move it.

    Args:
      mesh: convex mesh; the result must overlap better with the masks.
      candidates: mesh whose hull's vertices are the candidate corners, such as the visual hull.
      views: masks and their cameras.
      most: largest number of corners.

    Raises:
      ReconstructionError: if there are too few masks, or if the overlap does not improve.
    """
    views = _usable(candidates.vertices, views)
    if len(views.masks) < _RANK:
        raise ReconstructionError(
            f"{len(views.masks)} views show the complete object from outside. Pass {_RANK} or more."
        )
    try:
        corners = _find(hull(candidates).vertices, views, most)
        if len(corners) > most:
            raise ReconstructionError(f"More than {most} corners stick out. Keep the mesh.")
        body = weigh_facets(of_points(corners))
    except QhullError as error:
        raise ReconstructionError(
            "The corners are coplanar. Keep the mesh, or check the masks."
        ) from error
    old, new = (outline_overlaps(each.vertices, views) for each in (mesh, body))
    if new.mean() <= old.mean() or np.median(new) < _EXPLAINED:
        raise ReconstructionError(
            f"{len(body.vertices)} corners overlap with the masks by {new.mean():.4f}, the mesh by "
            f"{old.mean():.4f}. Keep the mesh, which is rounder."
        )
    return body


def fit_polytope(candidates: Mesh, views: Views, *, tolerance: float) -> Mesh | None:
    """Returns the hull of the corners that stick out of the outlines by more than a tolerance.

    Masks whose edges are wrong by a pixel or two have many corners that the object lacks; a
    tolerance of twice as much leaves those of the object.

    Args:
      candidates: mesh whose hull's vertices are the candidate corners, such as the visual hull.
      views: masks and their cameras.
      tolerance: pixels by which a corner must stick out.

    Returns:
      `None` if there are too many corners, too few masks, or all corners are in a plane.
    """
    views = _usable(candidates.vertices, views)
    if len(views.masks) < _RANK:
        return None
    try:
        corners = _find(hull(candidates).vertices, views, MOST, tolerances=(tolerance,))
        return None if len(corners) > MOST else weigh_facets(of_points(corners))
    except QhullError:
        return None


def _find(
    points: Points, views: Views, most: int, *, tolerances: Sequence[float] = _TOLERANCES
) -> Corners:
    """Returns the corners for the finest tolerance that needs at most `most` of them.

    They are more if the first tolerance needs more.
    """
    images = [signed_distances(mask).astype(np.float32) for mask in views.masks]
    points = points[_on_outlines(points, views)]
    directions = np.random.default_rng(0).normal(size=(_FIRST, 3))
    corners = points[np.unique(np.argmax(points @ directions.T, axis=0))]
    require = False
    for tolerance in tolerances:
        more = _insert(corners, points, views, tolerance, most)
        if len(more) > most:
            return corners if require else more
        if not require or len(more) > len(corners):
            more = _move(more, views, images)
        corners = _prune(more, views, tolerance)
        if len(corners) < len(more):
            corners = _move(corners, views, images)
        require = True
    return corners


def _usable(points: Points, views: Views) -> Views:
    """Returns the views that have all points in front of the camera and a nonempty outline."""
    cameras = views.cameras
    seen = [np.all(project(points, pose, cameras).depths > 0.0) for pose in cameras.poses]
    kept = np.array(seen) & ~views.masks.all(axis=(1, 2)) & views.masks.any(axis=(1, 2))
    return views_at(views, kept)


def _pixels(points: Points, views: Views) -> list[Pixels]:
    return [project(points, pose, views.cameras).pixels for pose in views.cameras.poses]


def _pixel(points: Points, views: Views) -> float:
    """Returns the width of a pixel at the object in the median view, world units."""
    away = np.linalg.norm(views.cameras.poses[:, :, 3] - points.mean(axis=0), axis=-1)
    return float(np.median(away)) / views.cameras.focal


def _on_outlines(points: Points, views: Views) -> np.ndarray:
    """Returns the indices of the points that lie on the outline in some view."""
    return np.unique(np.concatenate([polygon(pixels) for pixels in _pixels(points, views)]))


def _insert(
    corners: Corners, points: Points, views: Views, tolerance: float, most: int
) -> Float[np.ndarray, "more 3"]:
    """Adds the points that stick out of the corners' hull, until there are more than `most`."""
    images = _pixels(points, views)
    out = np.zeros((len(images), len(points)))
    changed = np.arange(len(images))
    while len(corners) <= most:
        for view in changed:
            pixels = project(corners, views.cameras.poses[view], views.cameras).pixels
            out[view] = excess(pixels[polygon(pixels)], images[view])
        ranked = np.partition(out, -_RANK, axis=0)[-_RANK]
        point = int(np.argmax(ranked))
        if ranked[point] < tolerance:
            break
        corners = np.concatenate([corners, points[point : point + 1]])
        changed = np.flatnonzero(out[:, point] > 0.0)
    return corners


def _prune(corners: Corners, views: Views, tolerance: float) -> Float[np.ndarray, "fewer 3"]:
    """Removes the corners that stick out by less than a tolerance, one after another.

    Two corners closer to each other than the blur are replaced by their midpoint.
    """
    corners = corners.copy()
    while len(corners) > 4:
        out = np.zeros((len(views.masks), len(corners)))
        for row, pixels in zip(out, _pixels(corners, views), strict=True):
            on = polygon(pixels)
            row[on] = heights(pixels[on])
        ranked = np.partition(out, -_RANK, axis=0)[-_RANK]
        reach = BLUR * _pixel(corners, views)
        near = KDTree(corners).query_pairs(reach, output_type="ndarray")
        if ranked.min() < tolerance:
            corners = np.delete(corners, np.argmin(ranked), axis=0)
        elif len(near):
            first, second = near[0]
            corners[first] = 0.5 * (corners[first] + corners[second])
            corners = np.delete(corners, second, axis=0)
        else:
            break
    return corners


def _move(corners: Corners, views: Views, images: Sequence[Image]) -> Corners:
    """Moves corners until their hull's outlines match those of the masks (Gauss-Newton)."""
    pixel = _pixel(corners, views)
    longest = _LONGEST * pixel
    for _ in range(_STEPS):
        distances, slopes = _equations(corners, views, images)
        size = np.abs(distances)
        weights = np.divide(_OUTLYING, size, out=np.ones_like(size), where=size > _OUTLYING)
        weighted = csr_array(slopes.T * weights)
        matrix = (weighted @ slopes).toarray()
        diagonal = np.diag(matrix)
        hold = np.diag(_HOLD * diagonal + _HOLD**2 * np.mean(diagonal))
        step = np.linalg.solve(matrix + hold, -(weighted @ distances)).reshape(-1, 3)
        length = np.linalg.norm(step, axis=-1, keepdims=True)
        corners = corners + step * (longest / np.maximum(length, longest))
        if length.max() < _SHORTEST * pixel:
            break
    return corners


def _equations(corners: Corners, views: Views, images: Sequence[Image]) -> tuple[Values, csr_array]:
    """Returns distances of outline points from the masks' outlines in pixels, and their Jacobian.

    The Jacobian is with respect to all coordinates of all corners.
    """
    distances, slopes = [], []
    for image, pose in zip(images, views.cameras.poses, strict=True):
        seen = project(corners, pose, views.cameras)
        on = polygon(seen.pixels)
        samples = along_edges(seen.pixels[on], margin=_MARGIN * BLUR)
        inside = np.all((samples.pixels > 0.0) & (samples.pixels < image.shape[::-1]), axis=1)
        samples = Samples(*(part[inside] for part in samples))
        distance, slope = look_up(image, samples.pixels)
        by_corner = projection_slopes(seen, pose, views.cameras)
        distances.append(distance)
        ends = on[np.stack([samples.first, samples.second], axis=-1)]
        shares = np.stack([1.0 - samples.shares, samples.shares], axis=-1)
        values = np.einsum("nk,nekc,ne->nec", slope, by_corner[ends], shares)
        column = 3 * ends[..., None] + np.arange(3)
        row = np.broadcast_to(np.arange(len(ends))[:, None, None], values.shape)
        shape = (len(ends), corners.size)
        slopes.append(coo_array((values.ravel(), (row.ravel(), column.ravel())), shape=shape))
    return np.concatenate(distances), csr_array(vstack(slopes))
