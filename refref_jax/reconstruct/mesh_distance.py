"""Measures distances between meshes, and the agreement of a mesh with masks.

Closest points and signed distances are exact, except far inside an object. Triangles are subdivided
until all are small, which does not change the surface. A tree of their centres then finds the few
triangles that can contain the closest point: the distance to the nearest centre is an upper bound,
and triangles beyond that bound plus their own radius are excluded. The sign is that of the
angle-weighted normal of the feature (face, edge or vertex) that contains the closest point, which
is exact on closed surfaces.

Correct masks agree with the silhouettes of their visual hull. If a mask marks too much, the others
carve the excess away, and only this mask disagrees with the hull. If it marks too little, it carves
away part of the object, so it agrees with the hull, but all other masks disagree. The volume that
no other mask carves away identifies it (`carved_alone`).

All of this runs on the host; only silhouettes are traced with JAX.

Source: Baerentzen and Aanaes, Signed Distance Computation Using the Angle Weighted Pseudonormal
(2005).
"""

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt, label
from scipy.spatial import KDTree
from trimesh.triangles import closest_point, points_to_barycentric

from refref_jax.compilation import threads
from refref_jax.data.mesh_queries import winding_number
from refref_jax.geometry.cameras import Cameras, image_rays
from refref_jax.geometry.surfaces import pack_meshes
from refref_jax.geometry.triangle_meshes import (
    Faces,
    Mesh,
    Vertices,
    average_normals,
    corner_angles,
    diameter,
    face_normals,
    is_degenerate,
    smooth_groups,
    unit_vectors,
    with_short_edges,
)
from refref_jax.reconstruct import ReconstructionError
from refref_jax.reconstruct.grids import Box, Field, Grid, Points, Values, lattice
from refref_jax.reconstruct.masks import (
    REACH,
    Views,
    check_masks,
    overlaps,
    values_by_view,
    views_at,
)
from refref_jax.render.images import find_first_surface

# Triangles in the first query, and the factor by which each further query grows.
_FIRST = 8
_GROWTH = 4

# Largest query. Where more triangles could contain the closest point, which happens near the medial
# axis, all are about as near as the nearest centres, and the best of those is used.
_MOST = 128

# Largest number of points times triangles processed at once.
_SWEEP = 1 << 19

# A triangle is subdivided if an edge is longer than this share of the diameter.
_LONGEST_EDGE = 0.04

# A point with a barycentric coordinate below this lies on the edge.
_ON_EDGE = 1e-6

# Spacings of a grid beyond which distances are those to vertices a spacing apart.
_FAR = 4.0


class ClosestPoints(NamedTuple):
    """The surface points closest to given points.

    Attributes:
      points: closest points on the surface.
      distances: distances to them, world units, at least 0.
      faces: faces that contain them.
      weights: barycentric coordinates of the points in these faces.
    """

    points: Float[np.ndarray, "points 3"]
    distances: Float[np.ndarray, " points"]
    faces: Int[np.ndarray, " points"]
    weights: Float[np.ndarray, "points 3"]


class ClosestSearch:
    """Finds the closest points on one mesh, with a tree of its triangles."""

    def __init__(self, vertices: Vertices, faces: Faces):
        """Builds the tree.

        Raises:
          ReconstructionError: if no triangle has an area.
        """
        kept = np.flatnonzero(~is_degenerate(vertices[faces]))
        if len(kept) == 0:
            raise ReconstructionError("All triangles of the mesh are degenerate. Rebuild the mesh.")
        self._corners = vertices[faces]
        # Distances are computed in units near the diameter: trimesh's tolerances are absolute. A
        # power of two changes no digit.
        self._unit = np.exp2(np.round(np.log2(diameter(vertices))))
        self._pieces, owner = _cut(vertices[faces[kept]], _LONGEST_EDGE * diameter(vertices))
        self._owner = kept[owner]
        middles = self._pieces.mean(axis=1)
        self._radii = np.linalg.norm(self._pieces - middles[:, None], axis=-1).max(axis=1)
        self._tree = KDTree(middles)

    def __call__(self, points: Points) -> ClosestPoints:
        """Returns the closest point of the surface to each point."""
        found, distance = np.zeros(points.shape), np.full(len(points), np.inf)
        piece = np.zeros(len(points), np.int64)
        left, count = np.arange(len(points)), min(_FIRST, len(self._pieces))
        most, furthest = min(_MOST, len(self._pieces)), self._radii.max()
        while len(left):
            done = []
            step = max(1, _SWEEP // count)
            for some in (left[i : i + step] for i in range(0, len(left), step)):
                found[some], distance[some], piece[some], reach = self._nearest(points[some], count)
                beyond = distance[some] + furthest <= reach
                done.append(beyond | (count == most))
            left = left[~np.concatenate(done)]
            count = min(_GROWTH * count, most)
        face = self._owner[piece]
        weights = points_to_barycentric(self._corners[face], found)
        return ClosestPoints(found, distance, face, weights)

    def _nearest(
        self, points: Points, count: int
    ) -> tuple[Points, Values, Int[np.ndarray, " points"], Values]:
        """Returns the closest point on the `count` pieces with the nearest centres.

        Returns:
          The points, their distances and pieces, and the distance of the furthest of the centres.
        """
        away, near = self._tree.query(points, k=[*range(1, count + 1)], workers=threads())
        may_be = away - self._radii[near] <= away[:, :1]  # no triangle is further than its centre
        row, _ = np.nonzero(may_be)
        on = np.full((*near.shape, 3), np.inf)
        pieces = self._pieces[near[may_be]] / self._unit
        on[may_be] = self._unit * closest_point(pieces, points[row] / self._unit)
        distance = np.linalg.norm(on - points[:, None], axis=-1)
        best = np.argmin(distance, axis=1)
        row = np.arange(len(points))
        return on[row, best], distance[row, best], near[row, best], away[:, -1]


def signed_distance(mesh: Mesh) -> Field:
    """Returns the exact distance to a closed mesh as a field, negative inside."""
    search = ClosestSearch(mesh.vertices, mesh.faces)
    corners = mesh.vertices[mesh.faces]
    of_faces = face_normals(corners)
    of_edges = _edge_normals(mesh.faces, of_faces)
    groups = smooth_groups(mesh.vertices, mesh.faces, crease_angle=np.pi)
    of_corners = average_normals(of_faces, groups, corner_angles(corners))

    def field(points: Points) -> Values:
        found = search(points)
        small = found.weights < _ON_EDGE
        row = found.faces
        # The edge opposite a corner contains the points whose weight is small there.
        normal = np.where(
            small.any(axis=1, keepdims=True),
            of_edges[row, np.argmin(found.weights, axis=1)],
            of_faces[row],
        )
        at_corner = small.sum(axis=1) >= 2
        corner = of_corners[row, np.argmax(found.weights, axis=1)]
        normal = np.where(at_corner[:, None], corner, normal)
        side = np.sum((points - found.points) * normal, axis=-1)
        return np.where(side < 0.0, -found.distances, found.distances)

    return field


def distance_grid(mesh: Mesh, *, spacing: float, margin: float) -> Grid:
    """Returns the distances to a closed mesh on a grid, negative inside.

    They are exact up to four spacings of the grid, and beyond that mostly to within a twentieth
    of one.

    Args:
      mesh: closed mesh, whose faces point outwards.
      spacing: distance between points of the grid, world units.
      margin: least distance of the ends of the grid from the mesh, world units.
    """
    low, high = mesh.vertices.min(axis=0) - margin, mesh.vertices.max(axis=0) + margin
    cells = np.ceil((high - low) / spacing).astype(np.int64)
    low = 0.5 * (low + high) - 0.5 * cells * spacing
    points = low + spacing * np.moveaxis(np.indices(cells + 1), 0, -1)
    values = _distances_to_vertices(with_short_edges(mesh, spacing), points, spacing)
    near = values < _FAR * spacing
    values[near] = signed_distance(mesh)(points[near])
    # Points that are far, and connected with each other, are on the same side.
    regions, count = label(~near)
    _, first = np.unique(regions, return_index=True)
    some = points.reshape(-1, 3)[first[len(first) - count :]]
    inside = 1 + np.flatnonzero(winding_number(mesh, some) > 0.5)
    values[np.isin(regions, inside)] *= -1.0
    return Grid(values, low, spacing)


def _distances_to_vertices(
    mesh: Mesh, points: Float[np.ndarray, "x y z 3"], spacing: float
) -> Float[np.ndarray, "x y z"]:
    """Returns the distances of grid points to the vertices of a finely divided mesh.

    A tree finds the nearest vertices of points near the mesh. It is slow for the others, which take
    the nearest of those that belong to the nearest such point and its neighbours, or to their own
    neighbours.
    """
    vertices = mesh.vertices[np.unique(mesh.faces)]
    found, nearest = KDTree(vertices).query(
        points, distance_upper_bound=_FAR * spacing, workers=threads()
    )
    vertices = np.append(
        vertices, np.full((1, 3), np.inf), axis=0
    )  # for points without a nearest vertex
    far = np.isinf(found)
    places, at, last = points[far], np.argwhere(far).T, np.reshape(far.shape, (3, 1)) - 1
    near = distance_transform_edt(far, return_distances=False, return_indices=True)[:, far]
    away, best = np.full(len(places), np.inf), nearest[far]
    for around in (near, at):
        for shift in product((-1, 0, 1), repeat=3):
            beside = nearest[tuple(np.clip(around + np.reshape(shift, (3, 1)), 0, last))]
            there = np.linalg.norm(places - vertices[beside], axis=-1)
            nearer = there < away
            away[nearer], best[nearer] = there[nearer], beside[nearer]
        nearest[far] = best
    found[far] = away
    return found


def _edge_normals(
    faces: Faces, normals: Float[np.ndarray, "faces 3"]
) -> Float[np.ndarray, "faces 3 3"]:
    """Returns the sum of both faces' normals at every edge, indexed by the opposite corner."""
    edges = np.sort(faces[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2), axis=1)
    _, edge = np.unique(edges, axis=0, return_inverse=True)
    edge = edge.reshape(-1)
    owner = np.repeat(np.arange(len(faces)), 3)
    sums = np.stack([np.bincount(edge, normals[owner, i]) for i in range(3)], axis=-1)
    return sums[edge].reshape(-1, 3, 3)


def _cut(
    corners: Float[np.ndarray, "faces 3 3"], longest: float
) -> tuple[Float[np.ndarray, "pieces 3 3"], Int[np.ndarray, " pieces"]]:
    """Halves the longest edges until none is longer; returns the pieces and their triangles."""
    owner, done, owners = np.arange(len(corners)), [], []
    while len(corners):
        edges = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=-1)
        long = edges.max(axis=1) > longest
        done.append(corners[~long])
        owners.append(owner[~long])
        corners, owner, edge = corners[long], owner[long], edges[long].argmax(axis=1)
        row = np.arange(len(corners))
        a, b, c = (corners[row, (edge + i) % 3] for i in range(3))
        middle = 0.5 * (a + b)
        halves = [np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)]
        corners, owner = np.concatenate(halves), np.concatenate([owner, owner])
    return np.concatenate(done), np.concatenate(owners)


SAMPLES = 20_000
"""Number of points sampled on each surface."""


class Distance(NamedTuple):
    """Distances between two surfaces.

    Attributes:
      chamfer: mean distance from one surface to the other, averaged over both directions, as a
        share of the true mesh's diameter (the diagonal of its bounding box).
      furthest: largest distance in either direction, as a share of the diameter.
      normal_error: mean angle between the shading normals at points of the mesh and at the closest
        points of the true mesh, degrees.
      normal_error_99: 99th percentile of that angle, degrees.
    """

    chamfer: float
    furthest: float
    normal_error: float
    normal_error_99: float


def compare_meshes(mesh: Mesh, truth: Mesh, *, samples: int = SAMPLES, seed: int = 0) -> Distance:
    """Compares a mesh with the true mesh, at points sampled evenly by area on each.

    Args:
      mesh: mesh to compare.
      truth: true mesh; its diameter is the unit.
      samples: number of points on each surface. Distances to the other surface are exact.
      seed: seed of the points.
    """
    generator = np.random.default_rng(seed)
    points, normals = _spread(mesh, samples, generator)
    there, _ = _spread(truth, samples, generator)
    forth = ClosestSearch(truth.vertices, truth.faces)(points)
    back = ClosestSearch(mesh.vertices, mesh.faces)(there)
    expected = unit_vectors(np.einsum("nk,nkc->nc", forth.weights, truth.normals[forth.faces]))
    cosine = np.clip(np.sum(normals * expected, axis=-1), -1.0, 1.0)
    angles = np.degrees(np.arccos(cosine))
    size = diameter(truth.vertices)
    return Distance(
        0.5 * float(forth.distances.mean() + back.distances.mean()) / size,
        float(max(forth.distances.max(), back.distances.max())) / size,
        float(angles.mean()),
        float(np.percentile(angles, 99.0)),
    )


def silhouette_overlap(
    mesh: Mesh, masks: Bool[np.ndarray, "views h w"], cameras: Cameras
) -> Float[np.ndarray, " views"]:
    """Returns the intersection over union (IoU) of mask and silhouette in each view.

    A pixel is in the silhouette if the ray through its centre hits the mesh, as in the masks of the
    data set. The IoU is 1 in a view in which both are empty.
    """
    return overlaps(silhouettes(mesh, cameras), masks)


def silhouettes(mesh: Mesh, cameras: Cameras) -> Bool[np.ndarray, "views h w"]:
    """Returns the pixels in which a mesh is visible."""
    surfaces = pack_meshes([mesh])
    views: Sequence[int] = range(len(cameras.poses))
    return np.stack(
        [np.isfinite(find_first_surface(surfaces, image_rays(cameras, i)).distances) for i in views]
    )


def _spread(
    mesh: Mesh, count: int, generator: np.random.Generator
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Returns points sampled on a mesh, and their interpolated unit normals."""
    corners = mesh.vertices[mesh.faces]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1
    )
    # One point in each of `count` equal shares of the area.
    total = np.cumsum(area)
    at = (np.arange(count) + generator.uniform(size=count)) / count * total[-1]
    face = np.minimum(np.searchsorted(total, at), len(area) - 1)
    u, v = generator.uniform(size=(2, count))
    root = np.sqrt(u)
    weights = np.stack([1.0 - root, root * (1.0 - v), root * v], axis=-1)
    points = np.einsum("nk,nkc->nc", weights, corners[face])
    return points, unit_vectors(np.einsum("nk,nkc->nc", weights, mesh.normals[face]))


# Points along each edge of the cube that is searched for the object.
_POINTS = 64


def without_outliers(mesh: Mesh, views: Views, count: int) -> Views:
    """Drops the `count` views whose masks overlap least with the silhouettes of a mesh.

    Raises:
      ReconstructionError: if no view would be left, or masks and cameras do not match.
    """
    check_masks(*views)
    if not 0 <= count < len(views.masks):
        raise ReconstructionError(
            f"{count} of {len(views.masks)} views cannot be left out. Pass a smaller count."
        )
    if count == 0:
        return views
    overlaps = silhouette_overlap(mesh, *views)
    return views_at(views, np.sort(np.argsort(overlaps, kind="stable")[count:]))


def carved_alone(views: Views) -> Values:
    """Returns, for each view, the share of the other views' hull that only this view carves away.

    The share is measured on a lattice of 64 points along each edge of the cube that is searched for
    the object, see `masks.REACH`. It is 0 if the hull of the other views contains none of
    them.

    Raises:
      ReconstructionError: if masks and cameras do not match.
    """
    check_masks(*views)
    ends = np.full(3, REACH)
    values = values_by_view(*views, lattice(Box(-ends, ends), _POINTS))
    carved, seen = values > 0.0, np.any(values > -np.inf, axis=0)
    times = carved.sum(axis=0)
    alone = np.sum(carved & (times == 1), axis=1)
    return alone / np.maximum(alone + np.sum(seen & (times == 0)), 1)
