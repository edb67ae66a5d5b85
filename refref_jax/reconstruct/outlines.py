"""Outlines of masks as equations of a fit, and bodies of revolution fitted to them (NumPy only).

`Outlines` are equations of the masks' outlines, for `gauss_newton`. Where the surface turns away
from a camera, its image has an edge, and the edge of the mask should be there. A point of this rim
that moves by `dx` moves its image across the edge by
`d (signed distance) / d pixel . d pixel / d point . dx`; moving along the line of sight changes
nothing. Masks are sampled at the centres of pixels, so the distance of a point has an error of
about a third of a pixel. Masks that are wrong, or show something else, lose their weight.

`fit_profile` fits a body of revolution to outlines alone. A mesh from masks is up to half a pixel
too narrow and has waves along its profile; the outlines of all views together determine it to some
hundredths of a pixel, and its normals to half a degree.

Source: Cipolla and Blake, Surface Shape from the Deformation of Apparent Contours (1992), for the
derivative; its use beside refraction is ours.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.sparse
from jaxtyping import Float, Int

from refref_jax.geometry.cameras import Cameras, project
from refref_jax.geometry.triangle_meshes import unit_vectors
from refref_jax.reconstruct import ReconstructionError
from refref_jax.reconstruct.families import Revolution
from refref_jax.reconstruct.gauss_newton import Candidate, Rows
from refref_jax.reconstruct.masks import Views, signed_distances
from refref_jax.reconstruct.relief import Relief
from refref_jax.reconstruct.shapes import Posed

OUTLINE_DEVIATION = 0.3
"""Standard deviation of a signed distance, the unit of the errors of outlines, in pixels."""

# Distance at which a point has lost half of its weight, in pixels; points that are further away are
# of an inner edge, which a mask does not show.
_WRONG, _FURTHEST = 1.0, 3.0

# Largest number of rim points per view: neighbours have the same error, so more add nothing.
_POINTS = 100

# Steps of the fit of a profile, and the standard deviation of the second differences of its knots,
# as a share of the diameter: neighbouring points have errors that are alike.
_ROUNDS, _BEND = 5, 0.001

# Cosine of the angle between normals at a crease, and points along it.
_CREASE, _ALONG_CREASE = math.cos(math.radians(10.0)), 12

# Largest error of a body with a relief, as a share of that of the body without it.
_BETTER = 0.95


class _Rim(NamedTuple):
    """Points between two vertices, where the surface turns away from a camera.

    Attributes:
      first: vertex at one end.
      second: vertex at the other end.
      share: share of the second vertex.
    """

    first: Int[np.ndarray, " points"]
    second: Int[np.ndarray, " points"]
    share: Float[np.ndarray, " points"]


class _Creases(NamedTuple):
    """Edges across which the shading normals jump.

    Attributes:
      edges: their vertices.
      faces: the faces on both sides.
    """

    edges: Int[np.ndarray, "creases 2"]
    faces: Int[np.ndarray, "creases 2"]


class Outlines:
    """The outlines of masks, as a function of a candidate to `Rows`."""

    def __init__(
        self,
        views: Views,
        *,
        common: float = 0.0,
        seed: int = 0,
        reach: float = _FURTHEST,
        creased: bool = False,
    ) -> None:
        """Measures the signed distances of all masks.

        Args:
          views: masks and their cameras.
          common: standard deviation, in pixels, of how much too wide all masks are.
          seed: seed of the draws of rim points.
          reach: distance from an outline beyond which points have no say, pixels.
          creased: whether surfaces turn away at creases, too, as meshes that are given may.
        """
        self._cameras, self._common, self._seed = views.cameras, common, seed
        self._reach, self._creased = reach, creased
        self._distances = [
            signed_distances(mask).astype(np.float32) if mask.any() and not mask.all() else None
            for mask in views.masks
        ]

    def __call__(self, candidate: Candidate) -> Rows:
        """Returns the equations of the outline of the first part, which contains all others."""
        return self.of_surface(candidate.parts[0])

    def of_surface(self, part: Posed) -> Rows:
        """Returns the equations of the outline of a surface."""
        normals = _vertex_normals(part)
        edges, creases = _edges(part.faces), _creases(part) if self._creased else None
        if creases is not None:  # the mean of normals on both sides of a crease says nothing
            edges = edges[~np.any(np.isin(edges, creases.edges), axis=1)]
        generator = np.random.default_rng(self._seed)
        found = [
            self._of_view(view, distances, part, normals, edges, creases, generator)
            for view, distances in enumerate(self._distances)
            if distances is not None
        ]
        errors = np.concatenate([each[0] for each in found])
        derivatives = scipy.sparse.vstack([each[1] for each in found]).tocsr()
        wrong = _WRONG * self._reach / _FURTHEST
        weights = 1.0 / (1.0 + (errors * OUTLINE_DEVIATION / wrong) ** 2) ** 2
        return Rows(
            errors, derivatives @ part.by_vertices, weights, self._common / OUTLINE_DEVIATION
        )

    def of_surfaces(self, parts: Sequence[Posed]) -> Rows:
        """Returns the equations of the outlines of surfaces that depend on the same unknowns."""
        each = [self.of_surface(part) for part in parts]
        return Rows(
            np.concatenate([rows.errors for rows in each]),
            np.concatenate([rows.derivatives for rows in each]),
            np.concatenate([rows.weights for rows in each]),
            each[0].common,
        )

    def _of_view(
        self,
        view: int,
        distances: Float[np.ndarray, "h w"],
        part: Posed,
        normals: Float[np.ndarray, "vertices 3"],
        edges: Int[np.ndarray, "edges 2"],
        creases: "_Creases | None",
        generator: np.random.Generator,
    ) -> tuple[Float[np.ndarray, " points"], scipy.sparse.csr_array]:
        """Returns errors and derivatives by the vertices of the rim of one view."""
        pose, columns = self._cameras.poses[view], 3 * len(part.vertices)
        rim = _rim(part.vertices, normals, edges, pose[:, 3])
        if creases is not None:
            along = _crease_rim(part, creases, pose[:, 3])
            rim = _Rim(*(np.concatenate(both) for both in zip(rim, along, strict=True)))
        share = rim.share[:, None]
        points = (1.0 - share) * part.vertices[rim.first] + share * part.vertices[rim.second]
        seen = project(points, pose, self._cameras)
        distance, slope = _sample(distances, seen.pixels)
        size = np.array([self._cameras.width, self._cameras.height])
        visible = (seen.depths > 0.0) & np.all((seen.pixels > 0) & (seen.pixels < size), axis=-1)
        near = np.flatnonzero((np.abs(distance) < self._reach) & visible)
        near = generator.permutation(near)[:_POINTS]
        rows = _by_points(slope[near], seen.pixels[near], seen.depths[near], pose, self._cameras)
        first, second = rim.first[near], rim.second[near]
        blocks = np.concatenate([(1.0 - share[near]) * rows, share[near] * rows], axis=1)
        at = 3 * np.stack([first, second], axis=1)[..., None] + np.arange(3)
        row = np.repeat(np.arange(len(near)), 6)
        entries = (blocks.ravel() / OUTLINE_DEVIATION, (row, at.ravel()))
        matrix = scipy.sparse.coo_array(entries, shape=(len(near), columns)).tocsr()
        return distance[near] / OUTLINE_DEVIATION, matrix


def fit_profile(
    outer: Revolution, outlines: Outlines, *, relief: Relief | None = None
) -> Revolution:
    """Fits a body of revolution to outlines alone.

    Args:
      outer: a body near the outlines, such as that of a mesh from masks.
      outlines: the outlines.
      relief: possible difference from a body of revolution. The body gets it only if the
        outlines are explained better by it: meshes from masks have such a relief in hollows, too.
    """
    found = _fitted(outer.with_relief(None), outlines)
    if relief is None:
        return found
    raised = _fitted(found.with_relief(relief), outlines)
    better = _error(raised, outlines) < _BETTER * _error(found, outlines)
    return raised if better else found


def _fitted(outer: Revolution, outlines: Outlines) -> Revolution:
    x = outer.start()
    for _ in range(_ROUNDS):
        rows = outlines.of_surface(outer.pose(x))
        weighted = rows.weights[:, None] * rows.derivatives
        precision, gradient = outer.prior(x, bend=_BEND)
        matrix = weighted.T @ rows.derivatives + precision
        x = x - np.linalg.solve(matrix, weighted.T @ rows.errors + gradient)
    return outer.moved(x)


def _error(outer: Revolution, outlines: Outlines) -> float:
    """Returns the mean distance from the outlines, in standard deviations, up to the largest."""
    errors = outlines.of_surface(outer.pose(outer.start())).errors
    return float(np.mean(np.minimum(np.abs(errors), _WRONG / OUTLINE_DEVIATION)))


def _vertex_normals(part: Posed) -> Float[np.ndarray, "vertices 3"]:
    """Returns the mean of the corner normals at each vertex."""
    at, each = part.faces.ravel(), part.normals[part.normal_ids.ravel()]
    sums = [np.bincount(at, each[:, axis], len(part.vertices)) for axis in range(3)]
    return unit_vectors(np.stack(sums, axis=-1))


def _edges(faces: Int[np.ndarray, "faces 3"]) -> Int[np.ndarray, "edges 2"]:
    """Returns each edge of a closed mesh once."""
    both = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    return both[both[:, 0] < both[:, 1]]


def _creases(part: Posed) -> _Creases:
    """Returns the edges of a closed mesh whose normals differ by more than 10 degrees."""
    around = [0, 1, 1, 2, 2, 0]
    both, ids = (x[:, around].reshape(-1, 2) for x in (part.faces, part.normal_ids))
    turned = both[:, 0] > both[:, 1]
    both[turned], ids[turned] = both[turned, ::-1], ids[turned, ::-1]
    order = np.lexsort(both.T)
    first, second = order[::2], order[1::2]
    if not np.array_equal(both[first], both[second]):
        raise ReconstructionError("A mesh is not closed, so its outlines are unknown. Close it.")
    cosines = np.sum(part.normals[ids[first]] * part.normals[ids[second]], axis=-1)
    sharp = np.any(cosines < _CREASE, axis=1)
    return _Creases(both[first][sharp], np.stack([first, second], axis=-1)[sharp] // 3)


def _crease_rim(part: Posed, creases: _Creases, camera: Float[np.ndarray, "3"]) -> _Rim:
    """Returns points of the creases with one face towards the camera and one away from it."""
    corners = part.vertices[part.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    front = np.sum(normals * (camera - corners[:, 0]), axis=-1) > 0.0
    seen = creases.edges[front[creases.faces[:, 0]] != front[creases.faces[:, 1]]]
    # The ends are left out, where the smoothed distances of a mask cut corners.
    share = (np.arange(_ALONG_CREASE) + 1.5) / (_ALONG_CREASE + 2.0)
    repeated = np.repeat(seen, _ALONG_CREASE, axis=0)
    return _Rim(repeated[:, 0], repeated[:, 1], np.tile(share, len(seen)))


def _rim(
    vertices: Float[np.ndarray, "vertices 3"],
    normals: Float[np.ndarray, "vertices 3"],
    edges: Int[np.ndarray, "edges 2"],
    camera: Float[np.ndarray, "3"],
) -> _Rim:
    """Returns where the interpolated normals are perpendicular to the lines of sight."""
    facing = np.sum(normals * (camera - vertices), axis=-1)
    first, second = facing[edges[:, 0]], facing[edges[:, 1]]
    turns = np.flatnonzero((first > 0.0) != (second > 0.0))
    share = first[turns] / (first[turns] - second[turns])
    return _Rim(edges[turns, 0], edges[turns, 1], share)


def _sample(
    image: Float[np.ndarray, "h w"], pixels: Float[np.ndarray, "points 2"]
) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, "points 2"]]:
    """Returns an image, whose values are at the centres of pixels, and its slope at points."""
    height, width = image.shape
    place = np.clip(pixels - 0.5, 0.0, [width - 1.001, height - 1.001])
    column, row = place.astype(np.int64).T
    right, down = (place - np.stack([column, row], axis=-1)).T
    a, b = image[row, column], image[row, column + 1]
    c, d = image[row + 1, column], image[row + 1, column + 1]
    value = (1.0 - down) * ((1.0 - right) * a + right * b) + down * ((1.0 - right) * c + right * d)
    along = (1.0 - down) * (b - a) + down * (d - c)
    across = (1.0 - right) * (c - a) + right * (d - b)
    return value, np.stack([along, across], axis=-1)


def _by_points(
    slope: Float[np.ndarray, "points 2"],
    pixels: Float[np.ndarray, "points 2"],
    depths: Float[np.ndarray, " points"],
    pose: Float[np.ndarray, "3 4"],
    cameras: Cameras,
) -> Float[np.ndarray, "points 3"]:
    """Returns the derivatives of the signed distance by a point in world units."""
    middle = 0.5 * np.array([cameras.width, cameras.height])
    x, y = (pixels - middle).T / cameras.focal
    right, up, back = pose[:, 0], pose[:, 1], pose[:, 2]
    scale = cameras.focal / depths
    # A pixel is middle + focal (x, -y) / depth, and depth is along minus the third axis.
    by_column = scale[:, None] * (right + x[:, None] * back)
    by_row = scale[:, None] * (-up + y[:, None] * back)
    return slope[:, :1] * by_column + slope[:, 1:] * by_row
