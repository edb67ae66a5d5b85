"""Queries of meshes: distances of surfaces, containment of parts, convexity (NumPy only).

Distances between surfaces are those between samples, so they are never underestimated, but small
patches may be missed.

Containment: a point is inside a closed surface where the surface winds around it once. The winding
number is a sum over triangles, so it needs no rays and tolerates small defects of a mesh.

Convexity: a ray that has left a convex object never meets it again, and need not be cast again.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import ConvexHull, KDTree, QhullError, cKDTree

from refref_jax.data import SceneError
from refref_jax.data.meshes import MeshPart
from refref_jax.geometry.triangle_meshes import (
    Mesh,
    face_normals,
    is_degenerate,
    is_watertight,
    volume,
)
from refref_jax.optics.interface_rules import NO_PARENT
from refref_jax.optics.media import EMPTY_SLOT, SLOTS

# Query samples of a surface: enough to detect a patch of a few per mille of its area.
_SAMPLES = 2000

# Target samples of a surface: denser, so that every triangle of some width has one.
_TARGETS = 20_000

# Number of triangles that are tested for the point nearest to a sample.
_CANDIDATES = 8

# Steps of a low-discrepancy sequence in the square: powers of the plastic number, the root of
# x^3 = x + 1 (Roberts, The Unreasonable Effectiveness of Quasirandom Sequences, 2018).
_STEPS = 1.324717957244746 ** -np.array([1.0, 2.0])

# Number of points of a part that are tested against another part: more for a coarse mesh, where
# they cost little, and where faces may intersect without their centres being inside.
_FEWEST_PROBES, _MOST_PROBES = 64, 2048
_PROBED_PAIRS = 1 << 21

# Distance of probes from their face, on both sides, as a share of the part's size. Parts that are
# closer than that touch.
_GAP = 1e-5

# Number of triangles times points of one sum of solid angles, few enough for a core's cache: sums
# of a million took nearly three times as long.
_SWEEP = 1 << 14

TOLERANCE = 1e-5
"""Maximum depth of a convex surface below its convex hull, as a share of its diagonal.

This is far above rounding in single precision, and far below any modelled dent.
"""

# A surface that lies on its hull and covers it once encloses the same volume.
_VOLUME_TOLERANCE = 1e-3

# Number of nearest facets of the hull that are tested first, and of points times facets of one test
# against all of them.
_NEAREST = 8
_PLANE_SWEEP = 1 << 21


class SampledSurface(NamedTuple):
    """A surface with samples that are evenly distributed over its area.

    Attributes:
      corners: corners of its non-degenerate triangles.
      normals: unit normals of the triangles.
      faces: triangle of each sample.
      points: positions of the samples.
      tree: search tree of a larger number of such points and of the centroids of all triangles.
      owners: triangle of each point of the tree.
    """

    corners: Float[np.ndarray, "faces 3 3"]
    normals: Float[np.ndarray, "faces 3"]
    faces: Int[np.ndarray, " samples"]
    points: Float[np.ndarray, "samples 3"]
    tree: cKDTree
    owners: Int[np.ndarray, " owners"]


class SurfaceGaps(NamedTuple):
    """The nearest point of another surface to each sample of a surface.

    Attributes:
      distances: distance to the nearest point, in world units.
      ahead: cosine between the sample's normal and the direction to the nearest point; 0 if the two
        coincide.
      alignment: cosine between both normals: 1 if the surfaces face the same way, -1 if they face
        towards or away from each other.
    """

    distances: Float[np.ndarray, " samples"]
    ahead: Float[np.ndarray, " samples"]
    alignment: Float[np.ndarray, " samples"]


def sample_surface(part: MeshPart) -> SampledSurface:
    """Samples the surface of a part, deterministically."""
    corners = part.vertices[part.faces]
    corners = corners[~is_degenerate(corners)]
    faces, points = spread_points(corners, _SAMPLES)
    target_faces, targets = spread_points(corners, _TARGETS)
    return SampledSurface(
        corners=corners,
        normals=face_normals(corners),
        faces=faces,
        points=points,
        tree=cKDTree(np.concatenate([corners.mean(axis=1), targets])),
        owners=np.concatenate([np.arange(len(corners)), target_faces]),
    )


def surface_gaps(surface: SampledSurface, other: SampledSurface) -> SurfaceGaps:
    """Returns the nearest point of another surface to each sample; both surfaces have area."""
    _, near = other.tree.query(surface.points, k=_CANDIDATES)
    faces = other.owners[near]
    ways = _closest(other.corners[faces] - surface.points[:, None, None])
    distances = np.linalg.norm(ways, axis=-1)
    best = np.argmin(distances, axis=1)[:, None]
    distances = np.take_along_axis(distances, best, axis=1)[:, 0]
    way = np.take_along_axis(ways, best[..., None], axis=1)[:, 0]
    face = np.take_along_axis(faces, best, axis=1)[:, 0]
    normals = surface.normals[surface.faces]
    along = np.sum(normals * way, axis=-1)
    return SurfaceGaps(
        distances=distances,
        ahead=np.divide(along, distances, out=np.zeros_like(along), where=distances > 0.0),
        alignment=np.sum(normals * other.normals[face], axis=-1),
    )


def diagonal(parts: Sequence[MeshPart]) -> float:
    """Returns the diagonal of the smallest bounding box among some parts, in world units."""
    return float(min(np.linalg.norm(np.ptp(part.vertices, axis=0)) for part in parts))


def spread_points(
    corners: Float[np.ndarray, "faces 3 3"], count: int
) -> tuple[Int[np.ndarray, " samples"], Float[np.ndarray, "samples 3"]]:
    """Distributes points evenly over the area of triangles; without triangles there are none."""
    a, b, c = np.moveaxis(corners, 1, 0)
    areas = np.cumsum(np.linalg.norm(np.cross(b - a, c - a), axis=-1))
    number = np.arange(count if len(corners) else 0)
    faces = np.searchsorted(areas, (number + 0.5) / count * areas[-1:], side="right")
    faces = np.minimum(faces, len(corners) - 1)
    u, v = np.modf((number[:, None] + 0.5) * _STEPS)[0].T
    beyond = u + v > 1.0
    u, v = np.where(beyond, 1.0 - u, u)[:, None], np.where(beyond, 1.0 - v, v)[:, None]
    return faces, a[faces] + u * (b - a)[faces] + v * (c - a)[faces]


def _closest(corners: Float[np.ndarray, "*shape 3 3"]) -> Float[np.ndarray, "*shape 3"]:
    """Returns the point of each triangle that is closest to the origin."""
    following = np.roll(corners, -1, axis=-2)
    edges = following - corners
    along = -np.sum(corners * edges, axis=-1) / np.sum(edges**2, axis=-1)
    on_edges = corners + np.clip(along, 0.0, 1.0)[..., None] * edges
    nearest = np.argmin(np.sum(on_edges**2, axis=-1), axis=-1)[..., None, None]
    on_edge = np.take_along_axis(on_edges, nearest, axis=-2)[..., 0, :]
    normal = np.cross(edges[..., 0, :], edges[..., 1, :])
    within = np.all(np.sum(np.cross(corners, following) * normal[..., None, :], axis=-1) >= 0.0, -1)
    height = np.sum(corners[..., 0, :] * normal, axis=-1) / np.sum(normal**2, axis=-1)
    return np.where(within[..., None], height[..., None] * normal, on_edge)


class Containment(NamedTuple):
    """Containment of the parts of a scene in one another.

    Attributes:
      parents: index of the innermost part around each part, or `NO_PARENT`.
      overlaps: pairs of parts whose surfaces intersect or coincide.
    """

    parents: tuple[int, ...]
    overlaps: tuple[tuple[int, int], ...]


def find_containment(parts: Sequence[MeshPart]) -> Containment:
    """Determines which parts contain which, and which overlap.

    Parts that are not dielectrics have no medium inside and take that of any ray that meets them,
    so they neither contain parts, nor are contained, nor overlap.
    """
    count = len(parts)
    bodies = [n for n, part in enumerate(parts) if part.material.kind == "dielectric"]
    volumes = [abs(volume(part.vertices, part.faces)) for part in parts]
    contains = np.zeros((count, count), bool)
    overlaps = set()
    for inner, outer in itertools.permutations(bodies, 2):
        inside = np.abs(winding_number(parts[outer], _probes(parts[inner], parts[outer]))) > 0.5
        contains[outer, inner] = inside.all()
        if inside.any() and not inside.all():
            overlaps.add((min(inner, outer), max(inner, outer)))
    parents = []
    for inner in range(count):
        around = np.flatnonzero(contains[:, inner])
        parents.append(int(min(around, key=volumes.__getitem__)) if around.size else NO_PARENT)
    return Containment(tuple(parents), tuple(sorted(overlaps)))


def parts_around(
    parts: Sequence[MeshPart], points: Float[np.ndarray, "points 3"]
) -> Int[np.ndarray, "points slots"]:
    """Returns the interior lists of rays that start at points: the parts that contain each point.

    Only scenes whose rays carry lists need them; see `optics.media`.

    Raises:
      SceneError: if a list is too short for the parts around a point.
    """
    inside = np.zeros((len(points), max(len(parts), SLOTS)), bool)
    for number, part in enumerate(parts):
        if part.material.kind != "dielectric":
            continue
        inside[:, number] = np.abs(winding_number(part, points)) > 0.5
    if np.any(crowded := inside.sum(axis=1) > SLOTS):
        point = int(np.argmax(crowded))
        names = ", ".join(parts[number].name for number in np.flatnonzero(inside[point]).tolist())
        raise SceneError(
            f"More than {SLOTS} parts contain the point {points[point].tolist()}: {names}. Move "
            "the camera, or merge parts of one material."
        )
    order = np.argsort(~inside, axis=1, kind="stable")[:, :SLOTS]
    listed = np.take_along_axis(inside, order, axis=1)
    return np.where(listed, order, EMPTY_SLOT).astype(np.int32)


def winding_number(
    surface: Mesh | MeshPart, points: Float[np.ndarray, "points 3"]
) -> Float[np.ndarray, " points"]:
    """Returns the winding number of a surface around points: 1 inside, 0 outside a closed surface.

    Points outside the bounding box of the surface have 0, without a sum over triangles. Where faces
    point inwards, the number is negative.

    Source: Jacobson et al., Robust Inside-Outside Segmentation using Generalized Winding
    Numbers (2013); van Oosterom and Strackee (1983) for the solid angle.
    """
    low, high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
    near = np.all((points >= low) & (points <= high), axis=1)
    corners = surface.vertices[surface.faces]
    total = np.zeros(len(points))
    step = max(1, _SWEEP // max(1, near.sum()))
    for start in range(0, len(corners) if near.any() else 0, step):
        total[near] += _solid_angles(corners[start : start + step], points[near]).sum(axis=1)
    return total / (4.0 * np.pi)


def beside_faces(
    part: MeshPart, faces: Int[np.ndarray, " faces"], side: float
) -> Float[np.ndarray, "faces 3"]:
    """Returns points next to the centroids of faces: in front for side 1, behind for side -1."""
    corners = part.vertices[part.faces[faces]]
    step = side * _GAP * np.max(np.ptp(part.vertices, axis=0))
    return corners.mean(axis=1) + step * face_normals(corners)


def _probes(part: MeshPart, other: MeshPart) -> Float[np.ndarray, "probes 3"]:
    """Returns points just inside and outside a surface, evenly distributed over it."""
    count = int(np.clip(_PROBED_PAIRS // len(other.faces), _FEWEST_PROBES, _MOST_PROBES))
    corners = part.vertices[part.faces]
    faces, points = spread_points(corners[~is_degenerate(corners)], count)
    normals = face_normals(corners[~is_degenerate(corners)])[faces]
    step = _GAP * np.max(np.ptp(part.vertices, axis=0)) * normals
    return np.concatenate([points - step, points + step])


def _solid_angles(
    corners: Float[np.ndarray, "faces 3 3"], points: Float[np.ndarray, "points 3"]
) -> Float[np.ndarray, "points faces"]:
    """Returns the signed solid angle of every triangle seen from every point."""
    # Coordinates are the leading axis, so that every product below is over whole arrays.
    a, b, c = (corners[:, i].T[:, None] - points.T[:, :, None] for i in range(3))
    la, lb, lc = (np.sqrt(_dot(edge, edge)) for edge in (a, b, c))
    # `a . (b x c)` is `a . ((b - a) x (c - a))`, whose product of edges is the same for all points.
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    triple = _dot(a, np.cross(first, second).T[:, None])
    dots = la * lb * lc + _dot(a, b) * lc + _dot(b, c) * la + _dot(c, a) * lb
    return 2.0 * np.arctan2(triple, dots)


def _dot(
    a: Float[np.ndarray, "3 points faces"], b: Float[np.ndarray, "3 #points faces"]
) -> Float[np.ndarray, "points faces"]:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def is_convex(part: MeshPart) -> bool:
    """Returns whether a part is one closed convex object with outward faces.

    All vertices and centroids of faces must lie on the convex hull within `TOLERANCE`. Depth below
    a hull is a concave function, so between these points a face is at most three times as deep.
    Therefore the part has no reflex edge.
    """
    faces = part.faces[~is_degenerate(part.vertices[part.faces])]
    if len(faces) == 0 or not is_watertight(faces):
        return False
    try:
        hull = ConvexHull(part.vertices)
    except QhullError:  # a flat part, or fewer than four points
        return False
    if not np.isclose(volume(part.vertices, part.faces), hull.volume, rtol=_VOLUME_TOLERANCE):
        return False
    others = part.vertices[np.setdiff1d(faces, hull.vertices)]
    points = np.concatenate([others, part.vertices[faces].mean(axis=1)])
    tolerance = float(TOLERANCE * np.linalg.norm(np.ptp(part.vertices, axis=0)))
    return _lie_on(hull, points, tolerance)


def encloses(outer: MeshPart, inner: MeshPart) -> bool:
    """Returns whether all vertices of a part lie in the convex hull of another part."""
    hull = ConvexHull(np.concatenate([outer.vertices, inner.vertices]))
    return bool(np.all(hull.vertices < len(outer.vertices)))


def is_one_convex_object(outer: MeshPart, parts: Sequence[MeshPart]) -> bool:
    """Returns whether a part is convex and contains all vertices of all other parts."""
    return is_convex(outer) and all(encloses(outer, part) for part in parts if part is not outer)


def any_inside(points: Float[np.ndarray, "points 3"], part: MeshPart) -> bool:
    """Returns whether any of some points, such as cameras, is inside a part."""
    winding = winding_number(part, np.asarray(points, np.float64))
    return bool(np.any(np.abs(winding) > 0.5))


def _lie_on(hull: ConvexHull, points: Float[np.ndarray, "points 3"], tolerance: float) -> bool:
    """Returns whether all points lie on the hull of their object: near the plane of some facet."""
    planes = np.asarray(hull.equations)
    middles = hull.points[hull.simplices].mean(axis=1)
    nearest = KDTree(middles).query(points, k=[*range(1, min(_NEAREST, len(planes)) + 1)])[1]
    depth = np.einsum("pkc,pc->pk", planes[nearest][..., :3], points) + planes[nearest][..., 3]
    rest = points[~_any_near(depth, tolerance)]
    step = max(1, _PLANE_SWEEP // len(planes))
    for first in range(0, len(rest), step):
        depth = rest[first : first + step] @ planes[:, :3].T + planes[:, 3]
        if not np.all(_any_near(depth, tolerance)):
            return False
    return True


def _any_near(
    depth: Float[np.ndarray, "points planes"], tolerance: float
) -> Bool[np.ndarray, " points"]:
    return np.any(depth >= -tolerance, axis=1)


def misses_boxes(
    origin: Float[np.ndarray, "3"], directions: Float[np.ndarray, "n 3"], parts: Sequence[MeshPart]
) -> Bool[np.ndarray, " n"]:
    """Returns which rays from a point miss the bounding boxes of all parts.

    Args:
      origin: origin of the rays, world units.
      directions: their directions, of any length.
      parts: meshes.
    """
    misses = np.ones(len(directions), bool)
    for part in parts:
        planes = np.stack([np.min(part.vertices, axis=0), np.max(part.vertices, axis=0)]) - origin
        with np.errstate(divide="ignore", invalid="ignore"):
            low, high = (plane / directions for plane in planes)
        # A ray within the plane of a face is 0/0 there, and counts as inside.
        enters = np.nanmax(np.fmin(low, high), axis=1, initial=0.0)
        misses &= enters > np.nanmin(np.fmax(low, high), axis=1, initial=np.inf)
    return misses
