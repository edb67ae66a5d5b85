"""Closed triangle meshes: their shading normals, measures, sections and pieces (on the host).

Neighbouring faces whose normals differ by less than the crease angle belong to one smooth patch.
At a corner, the face normals of a patch are averaged with Max's weights, which are exact where all
vertices lie on a sphere. Normals are not averaged across a crease, so a cube stays flat and a
cylinder keeps its rim. Large flat pieces with a narrow bevel keep their normal up to their rim.

Source: N. Max, Weights for Computing Vertex Normals from Facet Normals (1999); Thuermer and
Wuethrich, Computing Vertex Normals from Polygonal Facets (1998), for `corner_angles`.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from trimesh.remesh import subdivide_to_size
from trimesh.triangles import points_to_barycentric

CREASE_ANGLE = np.radians(30.0)
"""Smallest angle between face normals, in radians, at which an edge counts as sharp."""

# A face is degenerate if its area is below this fraction of its longest edge squared, as happens
# when single-precision files put three corners on one line.
_DEGENERATE = 1e-6

# Edges shorter than this share of the longest side of the mesh's box lose weight with the fourth
# power of their length. Rounding to single precision turns a face with an edge of a tenth of it by
# 0.4 degrees.
_SHORTEST = 1e-4

# Faces that meet at a smaller angle, in radians, are one flat piece. Single precision turns faces
# by less, unless they are tiny.
_COPLANAR = 1e-4

# Pieces of at least this share of the area of the largest piece at a corner are its peers.
_PEER = 0.3

# A flat piece determines normals at its rim if all pieces there that are not its peers have at most
# the second share of its area. From the first share on, it has no more weight than others.
_RIM = (0.2, 0.1)

# Largest angle between a face at a corner and the average by angle up to which that holds, radians.
# From the second angle on, where smoothing has crossed a right angle, faces are weighted by angle.
_STEEP = np.radians((30.0, 45.0))

Vertices = Float[np.ndarray, "vertices 3"]
Faces = Int[np.ndarray, "faces 3"]


def corner_normals(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    *,
    crease_angle: float = CREASE_ANGLE,
) -> Float[np.ndarray, "faces 3 3"]:
    """Returns an outward unit normal for every corner of every face.

    Args:
      vertices: positions, shared between faces where the surface is connected.
      faces: corner indices, counter-clockwise seen from outside.
      crease_angle: angle in radians; 0 gives face normals, pi smooths everything.

    Returns:
      Unit normals. Degenerate faces have zero normals and are left out of the averages.
    """
    corners = vertices[faces]
    flat = face_normals(corners)
    if crease_angle <= 0.0:
        return np.repeat(flat[:, None], 3, axis=1)
    groups = smooth_groups(vertices, faces, crease_angle=crease_angle)
    weights = corner_weights(corners)
    curved = average_normals(flat, groups, weights)
    large, share = _large_pieces(corners, faces, groups)
    pinned = average_normals(flat, groups, weights * large)
    by_angle = average_normals(flat, groups, corner_angles(corners))
    steep = _steepness(flat, groups, by_angle)[..., None]
    normals = _between(_between(curved, pinned, share[..., None]), by_angle, steep)
    # Where opposite normals cancel, one of them remains.
    return np.where(np.any(normals != 0.0, axis=-1, keepdims=True), normals, by_angle)


def corner_weights(corners: Float[np.ndarray, "faces 3 3"]) -> Float[np.ndarray, "faces 3"]:
    """Returns the weight of each face's unit normal at each of its corners.

    It is the sine of the angle there, divided by the lengths of both edges. Around a vertex that
    lies on a sphere with its neighbours, the average is the normal of the sphere.

    Tiny edges, whose faces rounding has turned, lose weight. Degenerate faces have weights, but no
    normals.

    Source: N. Max, Weights for Computing Vertex Normals from Facet Normals (1999).

    Returns:
      Weights without a unit: lengths are shares of the longest side of the box around all corners.
    """
    size = np.max(np.ptp(corners.reshape(-1, 3), axis=0)) if corners.size else 0.0
    edges = np.roll(corners, -1, axis=1) - corners
    lengths = np.linalg.norm(edges, axis=-1) / (size or 1.0)
    damped = np.minimum(1.0, lengths / _SHORTEST) ** 4
    factors = np.divide(damped, lengths, out=np.zeros_like(lengths), where=lengths > 0.0)
    forward = unit_vectors(edges)
    sines = np.linalg.norm(np.cross(forward, np.roll(forward, 1, axis=1)), axis=-1)
    return sines * factors * np.roll(factors, 1, axis=1)


def corner_angles(corners: Float[np.ndarray, "faces 3 3"]) -> Float[np.ndarray, "faces 3"]:
    """Returns the angle of each face at each of its corners, in radians."""
    forward = unit_vectors(np.roll(corners, -1, axis=1) - corners)
    backward = unit_vectors(np.roll(corners, 1, axis=1) - corners)
    return np.arccos(np.clip(np.sum(forward * backward, axis=-1), -1.0, 1.0))


def average_normals(
    normals: Float[np.ndarray, "faces 3"],
    groups: Int[np.ndarray, "faces 3"],
    weights: Float[np.ndarray, "faces 3"],
) -> Float[np.ndarray, "faces 3 3"]:
    """Returns the unit vector along the weighted sum of face normals over each group of corners.

    Where the sum is zero, because opposite faces cancel, it is the face's own normal.

    Args:
      normals: unit normals of the faces; zero for degenerate ones.
      groups: numbers of the groups, from `smooth_groups`.
      weights: weights, not negative; only their ratios within a group matter.
    """
    at = groups.reshape(-1)
    weighted = (weights[..., None] * normals[:, None]).reshape(-1, 3)
    sums = np.stack([np.bincount(at, weighted[:, axis]) for axis in range(3)], axis=-1)
    averaged = unit_vectors(sums)[at].reshape(-1, 3, 3)
    cancelled = np.all(averaged == 0.0, axis=-1, keepdims=True)
    return np.where(cancelled, normals[:, None], averaged)


def smooth_groups(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    *,
    crease_angle: float = CREASE_ANGLE,
) -> Int[np.ndarray, "faces 3"]:
    """Numbers groups of corners that share a normal: same vertex, faces of the same patch."""
    patch = _smooth_patches(faces, face_normals(vertices[faces]), crease_angle)
    key = patch[:, None].astype(np.int64) * len(vertices) + faces
    return np.unique(key, return_inverse=True)[1].reshape(-1, 3)


def face_normals(corners: Float[np.ndarray, "faces 3 3"]) -> Float[np.ndarray, "faces 3"]:
    """Returns outward unit normals; zero for degenerate faces."""
    normals = unit_vectors(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    return np.where(is_degenerate(corners)[:, None], 0.0, normals)


def is_degenerate(corners: Float[np.ndarray, "faces 3 3"]) -> Bool[np.ndarray, " faces"]:
    """Returns which faces have negligible area, so that their normals would be rounding errors."""
    edges = np.roll(corners, -1, axis=1) - corners
    longest = np.max(np.sum(edges**2, axis=-1), axis=1)
    area = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=-1)
    return area <= _DEGENERATE * longest


def unit_vectors(vectors: Float[np.ndarray, "*shape 3"]) -> Float[np.ndarray, "*shape 3"]:
    """Returns vectors scaled to length 1; zero vectors stay zero."""
    norm = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.divide(vectors, norm, out=np.zeros_like(vectors), where=norm > 0.0)


def _large_pieces(
    corners: Float[np.ndarray, "faces 3 3"],
    faces: Int[np.ndarray, "faces 3"],
    groups: Int[np.ndarray, "faces 3"],
) -> tuple[Bool[np.ndarray, "faces 3"], Float[np.ndarray, "faces 3"]]:
    """Returns which corners belong to a large flat piece, and how far these alone decide.

    Max's weights favour small faces. Where a large lid meets a narrow bevel, they give the normal
    of the bevel, which bends the shading of the whole lid, while the true normal at the rim of a
    rounded edge is the lid's. Faces in one plane are a piece. Those that are about as large as the
    largest at a corner, its peers, decide if they have at least two faces, and if other pieces all
    along their rims are much smaller. On curved surfaces, pieces are single faces or have such
    neighbours. Peers, such as the strips of a cylinder, are averaged with Max's weights.

    Returns:
      Whether a corner belongs to a peer, and the share of peers in the normal at each corner.
    """
    areas = 0.5 * np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1
    )
    piece = _smooth_patches(faces, face_normals(corners), _COPLANAR)[:, None].repeat(3, axis=1)
    size = np.bincount(piece[:, 0], areas)[piece]
    single = np.bincount(piece[:, 0])[piece] == 1
    peer = size >= _PEER * _largest(groups, size)
    other = _largest(groups, np.where(single | ~peer, size, 0.0))
    ratio = np.divide(other, size, out=np.ones_like(size), where=size > 0.0)
    worst = _largest(piece, np.where(peer, ratio, 0.0))
    # The worst of the peers at a corner.
    worst = np.maximum(_largest(groups, np.where(peer, worst, 0.0)), _RIM[1])
    return peer, np.clip(np.log(worst / _RIM[0]) / np.log(_RIM[1] / _RIM[0]), 0.0, 1.0)


def _steepness(
    flat: Float[np.ndarray, "faces 3"],
    groups: Int[np.ndarray, "faces 3"],
    normals: Float[np.ndarray, "faces 3 3"],
) -> Float[np.ndarray, "faces 3"]:
    """Returns how far faces are too steep at a corner for weights that may favour one: 0 to 1.

    Max's weights assume a small part of a sphere. Smoothed across its right angles, the long sides
    of a rod would have normals that lie nearly in their planes, which cannot shade them.
    """
    # Half the chord between normals is the sine of half their angle; degenerate faces have none.
    chord = np.linalg.norm(flat[:, None] - normals, axis=-1) * np.any(flat != 0.0, axis=1)[:, None]
    angle = 2.0 * np.arcsin(np.minimum(0.5 * _largest(groups, chord), 1.0))
    return np.clip((angle - _STEEP[0]) / (_STEEP[1] - _STEEP[0]), 0.0, 1.0)


def _between(
    first: Float[np.ndarray, "faces 3 3"],
    second: Float[np.ndarray, "faces 3 3"],
    share: Float[np.ndarray, "faces 3 1"],
) -> Float[np.ndarray, "faces 3 3"]:
    """Returns unit vectors between others; the first are not changed where the share is 0."""
    return np.where(share > 0.0, unit_vectors((1.0 - share) * first + share * second), first)


def _largest(
    groups: Int[np.ndarray, "faces 3"], values: Float[np.ndarray, "faces 3"]
) -> Float[np.ndarray, "faces 3"]:
    """Returns the largest value, not negative, in each corner's group."""
    found = np.zeros(groups.max(initial=0) + 1)
    np.maximum.at(found, groups, values)
    return found[groups]


def _smooth_patches(
    faces: Int[np.ndarray, "faces 3"],
    normals: Float[np.ndarray, "faces 3"],
    crease_angle: float,
) -> Int[np.ndarray, " faces"]:
    """Numbers the patches of faces that are connected across smooth edges."""
    first, second, _ = neighbours(faces)
    solid = np.any(normals != 0.0, axis=1)
    # Cosines of tiny angles are 1 up to rounding; chords are accurate.
    chord = np.linalg.norm(normals[first] - normals[second], axis=1)
    smooth = (chord < 2.0 * np.sin(0.5 * crease_angle)) & solid[first] & solid[second]
    graph = coo_array(
        (np.ones(smooth.sum(), bool), (first[smooth], second[smooth])),
        shape=(len(faces), len(faces)),
    )
    return connected_components(graph, directed=False)[1]


class Mesh(NamedTuple):
    """A closed surface with its shading normals.

    Attributes:
      vertices: world units, shared between faces.
      faces: counter-clockwise seen from outside.
      normals: outward unit shading normals at the corners of the faces, as the tracer takes them.
    """

    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    normals: Float[np.ndarray, "faces 3 3"]


def make_mesh(vertices: Vertices, faces: Faces, *, crease_angle: float = CREASE_ANGLE) -> Mesh:
    """Returns a mesh with averaged normals, but not across creases (radians)."""
    return Mesh(vertices, faces, corner_normals(vertices, faces, crease_angle=crease_angle))


def with_short_edges(mesh: Mesh, longest: float) -> Mesh:
    """Returns the same surface and shading, with long edges halved until none is too long.

    An edge is halved for both of its faces. Parts of a degenerate face have its mean normal.

    Args:
      mesh: mesh to divide.
      longest: longest edge, world units.
    """
    edges = mesh.vertices[mesh.faces] - mesh.vertices[np.roll(mesh.faces, 1, axis=1)]
    if not np.any(np.linalg.norm(edges, axis=-1) > longest):
        return mesh
    vertices, faces, of = subdivide_to_size(*mesh[:2], longest, max_iter=30, return_index=True)
    corners = mesh.vertices[mesh.faces[of]]
    shares = np.full((len(faces), 3, 3), 1.0 / 3.0)
    whole = ~is_degenerate(corners)
    shares[whole] = points_to_barycentric(
        np.repeat(corners[whole], 3, axis=0), vertices[faces[whole]].reshape(-1, 3)
    ).reshape(-1, 3, 3)
    return Mesh(vertices, faces.astype(np.int64), unit_vectors(shares @ mesh.normals[of]))


def volume(vertices: Vertices, faces: Faces) -> float:
    """Returns the volume inside a closed surface, negative if its faces point inwards."""
    a, b, c = np.moveaxis(vertices[faces] - vertices.mean(axis=0), 1, 0)
    return float(np.sum(a * np.cross(b, c)) / 6.0)


def face_vectors(vertices: Vertices, faces: Faces) -> Float[np.ndarray, "faces 3"]:
    """Returns the faces' normals, each as long as the area of its face."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return 0.5 * np.cross(b - a, c - a)


def slice_faces(
    vertices: Vertices, faces: Faces, bottom: float, step: float
) -> tuple[Float[np.ndarray, "cuts 2"], Float[np.ndarray, "cuts 2"], Int[np.ndarray, " cuts"]]:
    """Cuts faces by the horizontal planes at heights `z = bottom + (level + 0.5) step`.

    Faces in a plane are not cut; their neighbours are, so that closed meshes have closed sections.

    Args:
      vertices: corners of the faces, world units.
      faces: faces of a closed mesh.
      bottom: height half a step below the plane of level 0; planes below it have negative levels.
      step: distance between planes.

    Returns:
      Both ends of each cut in its plane, such that the body is to the left; its level.
    """
    order = np.argsort(vertices[faces, 2], axis=1)
    corners = np.take_along_axis(vertices[faces], order[..., None], axis=1)
    heights = (corners[..., 2] - bottom) / step - 0.5
    first = np.ceil(heights[:, 0]).astype(np.int64)
    counts = np.ceil(heights[:, 2]).astype(np.int64) - first
    face = np.repeat(np.arange(len(faces)), counts)
    level = np.arange(len(face)) - np.repeat(np.cumsum(counts) - counts, counts) + first[face]
    corners, heights = corners[face, :, :2], heights[face]
    lower = level < heights[:, 1]
    across = _on_edge(corners, heights, level, np.where(lower, 0, 1), np.where(lower, 1, 2))
    along = _on_edge(corners, heights, level, np.zeros_like(level), np.full_like(level, 2))
    outward = face_vectors(vertices, faces)[face]
    way = across - along
    swap = (outward[:, 0] * way[:, 1] < outward[:, 1] * way[:, 0])[:, None]
    return np.where(swap, across, along), np.where(swap, along, across), level


def _on_edge(
    corners: Float[np.ndarray, "cuts 3 2"],
    heights: Float[np.ndarray, "cuts 3"],
    level: Int[np.ndarray, " cuts"],
    low: Int[np.ndarray, " cuts"],
    high: Int[np.ndarray, " cuts"],
) -> Float[np.ndarray, "cuts 2"]:
    """Returns the points of edges at a height."""
    cut = np.arange(len(level))
    start, rise = heights[cut, low], heights[cut, high] - heights[cut, low]
    share = np.divide(level - start, rise, out=np.zeros_like(rise), where=rise > 0.0)[:, None]
    return (1.0 - share) * corners[cut, low] + share * corners[cut, high]


def vertex_vectors(vertices: Vertices, faces: Faces) -> Vertices:
    """Returns the gradient of the volume with respect to each vertex, which points outwards.

    It is a third of the area vectors of the faces around.
    """
    return gather(
        np.repeat(face_vectors(vertices, faces)[:, None] / 3.0, 3, axis=1), faces, vertices
    )


def gather(values: Float[np.ndarray, "faces 3 3"], faces: Faces, vertices: Vertices) -> Vertices:
    """Sums vectors at the corners of faces over each vertex."""
    at = faces.ravel()
    flat = values.reshape(-1, 3)
    return np.stack([np.bincount(at, flat[:, i], len(vertices)) for i in range(3)], axis=-1)


def neighbours(
    faces: Faces,
) -> tuple[Int[np.ndarray, " edges"], Int[np.ndarray, " edges"], Int[np.ndarray, "edges 2"]]:
    """Returns the two faces at each edge of a closed mesh, and its two vertices."""
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    owner = np.repeat(np.arange(len(faces)), 3)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    edges, owner = edges[order], owner[order]
    same = np.flatnonzero(np.all(edges[1:] == edges[:-1], axis=1))
    return owner[same], owner[same + 1], edges[same]


def is_closed(faces: Faces) -> bool:
    """Returns whether every edge is used as often in one direction as in the other."""
    return np.array_equal(*_directed_edges(faces))


def is_watertight(faces: Faces) -> bool:
    """Returns whether every edge is used by two faces, once in each direction."""
    forward, backward = _directed_edges(faces)
    return np.array_equal(forward, backward) and bool(np.all(np.diff(forward) > 0))


def diameter(vertices: Vertices) -> float:
    """Returns the diagonal of the box along the axes, a body's size in world units."""
    return float(np.linalg.norm(np.ptp(vertices, axis=0)))


def pieces(faces: Faces, count: int) -> Int[np.ndarray, " vertices"]:
    """Numbers the connected pieces of a mesh with `count` vertices."""
    first, second = faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel()
    graph = coo_array((np.ones(first.size, bool), (first, second)), shape=(count, count))
    return connected_components(graph, directed=False)[1]


def join(parts: Sequence[Mesh]) -> Mesh:
    """Returns several meshes, one or more, as one."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    return Mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)]),
        np.concatenate([part.normals for part in parts]),
    )


def keep_faces(mesh: Mesh, kept: np.ndarray) -> Mesh:
    """Returns some of the faces, without the vertices that no longer belong to any."""
    used, numbers = np.unique(mesh.faces[kept], return_inverse=True)
    return Mesh(mesh.vertices[used], numbers.reshape(-1, 3), mesh.normals[kept])


def _directed_edges(faces: Faces) -> tuple[Int[np.ndarray, " edges"], Int[np.ndarray, " edges"]]:
    """Numbers the edges as faces go along them, and against it; both are sorted."""
    start, end = faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel()
    size = int(faces.max(initial=0)) + 1
    return np.sort(start * size + end), np.sort(end * size + start)
