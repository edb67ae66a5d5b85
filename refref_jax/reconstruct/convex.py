"""Restores convex meshes, whose edges a grid has cut off (NumPy only).

Masks constrain a convex object better than any other, because its surface is the envelope of its
tangent planes. `from_tangents` intersects these planes, which restores the edges that a grid cuts
off.
"""

import math

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, HalfspaceIntersection, KDTree, QhullError

from refref_jax.geometry.triangle_meshes import (
    CREASE_ANGLE,
    Mesh,
    diameter,
    face_normals,
    face_vectors,
    make_mesh,
    neighbours,
    volume,
)
from refref_jax.reconstruct.smoothing import CREASE

FaceIndex = Int[np.ndarray, " pairs"]

# Largest growth in volume from the hull to the intersection of tangent planes. The edges that a
# grid cuts off have a smaller volume, so a larger growth is an error.
_MOST_GROWTH = 0.03

# Rings of faces around an edge whose normals are still affected by it.
_RINGS = 3

# Smallest share of the area of a patch that is used, and the largest distance of the faces of a
# flat patch from its plane, as a share of the diameter.
_SMALLEST_PATCH = 0.002
_FLAT = 0.003

# Share of a flat patch that lies within that distance, and the number of fits of its plane to that
# share.
_MOSTLY = 0.85
_FITS = 6

# Fewest planes or corners that bound a volume.
_LEAST = 4

# Corners of the intersection closer than this share of the diameter are one.
_SAME = 1e-6

# Faces that meet at a smaller angle belong to the same facet, radians.
_COPLANAR = np.radians(3.0)

# Number of near faces of a hull that give an upper bound of the depth of a vertex.
_NEAREST = 8

# Share of the volume by which a convex mesh may differ from its hull, because of rounding.
_ROUNDING = 1e-6


def hull(mesh: Mesh) -> Mesh:
    """Returns the convex hull of a mesh, closed and outward."""
    return of_points(mesh.vertices)


def of_points(points: Float[np.ndarray, "n 3"]) -> Mesh:
    """Returns the convex hull of points, closed and outward.

    Raises:
      QhullError: if they are coplanar.
    """
    found = ConvexHull(points)
    faces = found.simplices.astype(np.int64)
    corners = points[faces]
    towards = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.sum(towards * found.equations[:, :3], axis=-1) < 0.0
    faces[inward] = faces[inward][:, ::-1]
    used, numbers = np.unique(faces, return_inverse=True)
    return make_mesh(points[used], numbers.reshape(-1, 3))


def weigh_facets(mesh: Mesh, *, crease_angle: float = CREASE_ANGLE) -> Mesh:
    """Returns a mesh of few corners with normals that are averaged by the areas of flat facets.

    Suppose that a large flat lid meets a narrow bevel at less than the crease angle. An average
    that favours the bevel would tilt the normals of the entire lid. Weighted by area, the normals
    vary on the bevel instead, however wide it is.

    Args:
      mesh: convex mesh.
      crease_angle: smallest angle between facets whose normals are not averaged, radians.
    """
    normals = face_normals(mesh.vertices[mesh.faces])
    first, second, _ = neighbours(mesh.faces)
    flat = np.sum(normals[first] * normals[second], axis=-1) > np.cos(_COPLANAR)
    graph = coo_array(
        (np.ones(flat.sum(), bool), (first[flat], second[flat])), shape=(len(normals),) * 2
    )
    count, facet = connected_components(graph, directed=False)
    vectors = face_vectors(mesh.vertices, mesh.faces)
    of_facets = np.stack([np.bincount(facet, vectors[:, i], count) for i in range(3)], axis=-1)
    unit = of_facets / np.linalg.norm(of_facets, axis=-1, keepdims=True)
    averaged = unit @ unit.T > np.cos(crease_angle)
    around = np.zeros((len(mesh.vertices), count), bool)
    around[mesh.faces, facet[:, None]] = True
    weighed = np.einsum("fkg,gc->fkc", around[mesh.faces] & averaged[facet][:, None], of_facets)
    return mesh._replace(normals=weighed / np.linalg.norm(weighed, axis=-1, keepdims=True))


def is_convex(mesh: Mesh) -> bool:
    """Returns whether a mesh is its own convex hull, up to rounding."""
    outer = hull(mesh)
    inside = volume(mesh.vertices, mesh.faces)
    return math.isclose(inside, volume(outer.vertices, outer.faces), rel_tol=_ROUNDING)


def depth_below_hull(mesh: Mesh) -> float:
    """Returns how far the deepest vertex lies below the convex hull, in world units.

    Inside a convex body, the distance to its surface is that to the nearest plane of its faces. The
    planes of a few near faces give an upper bound for each vertex. Vertices are measured against
    all planes in the order of these bounds, until no other can be deeper.
    """
    vertices, outer = mesh.vertices, ConvexHull(mesh.vertices)
    middles = vertices[outer.simplices].mean(axis=1)
    nearest = KDTree(middles).query(vertices, k=range(1, 1 + min(_NEAREST, len(middles))))[1]
    near = outer.equations[nearest]
    bounds = (-near[..., 3] - np.sum(near[..., :3] * vertices[:, None], axis=-1)).min(axis=1)
    normals, offsets = outer.equations[:, :3], outer.equations[:, 3]
    deepest = -math.inf
    for vertex in np.argsort(-bounds):
        if bounds[vertex] <= deepest:
            break
        deepest = max(deepest, float((-offsets - normals @ vertices[vertex]).min()))
    return deepest


def from_tangents(mesh: Mesh, *, crease_angle: float = CREASE) -> Mesh:
    """Returns the intersection of the half-spaces behind a mesh's faces, but not those at edges.

    A face that meets a neighbour at more than the crease angle belongs to an edge that the grid has
    cut off. Without this face the adjacent planes meet in the true edge. A patch between edges that
    is flat up to noise becomes one plane, fitted by least squares. If the result adds more than a
    few percent to the volume, or if the planes do not close, the convex hull is returned instead.

    Args:
      mesh: nearly convex mesh, smooth except at its edges; noise would carve it down.
      crease_angle: angle between faces from which they belong to an edge, radians.
    """
    plain = hull(mesh)
    if not _sharp_pairs(mesh, crease_angle)[0].size:
        return plain
    planes = _planes(mesh, _patches(mesh, crease_angle))
    try:
        body = of_points(_intersection(planes, mesh, plain.vertices.mean(axis=0)))
    except QhullError:
        return plain
    growth = volume(body.vertices, body.faces) / volume(plain.vertices, plain.faces) - 1.0
    return body if abs(growth) <= _MOST_GROWTH else plain


def _intersection(
    planes: Float[np.ndarray, "planes 4"], mesh: Mesh, inside: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "n 3"]:
    """Returns the corners of the intersection of half-spaces that contain a given inner point.

    Raises:
      QhullError: if the planes do not close.
    """
    planes = planes[planes[:, :3] @ inside + planes[:, 3] < 0.0]
    if len(planes) < _LEAST:
        raise QhullError(f"{len(planes)} planes do not bound a volume")
    points = HalfspaceIntersection(planes, inside).intersections
    points = points[np.all(np.isfinite(points), axis=1)]
    if len(points) < _LEAST:
        raise QhullError(f"{len(points)} corners do not bound a volume")
    size = _SAME * diameter(mesh.vertices)
    return size * np.unique(np.rint(points / size), axis=0)


def _patches(mesh: Mesh, crease_angle: float) -> list[Int[np.ndarray, " _"]]:
    """Returns the faces of each smooth patch, without those near its edges."""
    dropped = np.zeros(len(mesh.faces), bool)
    dropped[np.concatenate(_sharp_pairs(mesh, crease_angle))] = True
    for _ in range(_RINGS):
        dropped = np.any(np.isin(mesh.faces, mesh.faces[dropped]), axis=1)
    first, second, _ = neighbours(mesh.faces)
    joined = ~dropped[first] & ~dropped[second]
    graph = coo_array(
        (np.ones(joined.sum(), bool), (first[joined], second[joined])), shape=(len(dropped),) * 2
    )
    label = np.where(dropped, -1, connected_components(graph, directed=False)[1])
    area = np.linalg.norm(face_vectors(mesh.vertices, mesh.faces), axis=-1)
    shares = np.bincount(label + 1, area)[1:] / area.sum()
    return [np.flatnonzero(label == i) for i in np.flatnonzero(shares > _SMALLEST_PATCH)]


def _sharp_pairs(mesh: Mesh, crease_angle: float) -> tuple[FaceIndex, FaceIndex]:
    """Returns the pairs of neighbouring faces that meet at more than an angle."""
    normals = face_normals(mesh.vertices[mesh.faces])
    first, second, _ = neighbours(mesh.faces)
    sharp = np.sum(normals[first] * normals[second], axis=-1) < np.cos(crease_angle)
    return first[sharp], second[sharp]


def _planes(mesh: Mesh, patches: list[Int[np.ndarray, " _"]]) -> Float[np.ndarray, "planes 4"]:
    """Returns one plane for each flat patch, and one for each face of the others."""
    planes, tolerance = [np.zeros((0, 4))], _FLAT * diameter(mesh.vertices)
    for patch in patches:
        vectors = face_vectors(mesh.vertices, mesh.faces[patch])
        area = np.linalg.norm(vectors, axis=-1)
        middles = mesh.vertices[mesh.faces[patch]].mean(axis=1)
        normal, centre, share = _flat_plane(middles, area, tolerance)
        normal = np.sign(normal @ vectors.sum(axis=0)) * normal[None]
        if share < _MOSTLY:
            kept = area > 0.0
            normal, centre = vectors[kept] / area[kept, None], middles[kept]
        offset = -np.sum(normal * centre, axis=-1, keepdims=True)
        planes.append(np.concatenate([normal, offset], axis=1))
    return np.concatenate(planes)


def _flat_plane(
    points: Float[np.ndarray, "n 3"], weights: Float[np.ndarray, " n"], tolerance: float
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"], float]:
    """Returns the plane near most points: its normal, one of its points, the share near it."""
    near = np.ones(len(points), bool)
    for _ in range(_FITS):
        some = weights * near
        centre = some @ points / some.sum()
        from_centre = points - centre
        normal = np.linalg.eigh(from_centre.T @ (some[:, None] * from_centre))[1][:, 0]
        away = np.abs(from_centre @ normal)
        near = away <= max(tolerance, float(np.median(away)))
    return normal, centre, float(weights[away <= tolerance].sum() / weights.sum())
