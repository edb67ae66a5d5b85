"""Closed triangle meshes: their shading normals, measures and connected pieces (NumPy only).

Neighbouring faces whose normals differ by less than the crease angle belong to one smooth patch.
At a corner, the face normals of a patch are averaged, weighted by the angle of each face there.
Normals are not averaged across a crease, so a cube stays flat and a cylinder keeps its rim.

Source: Thuermer and Wuethrich, Computing Vertex Normals from Polygonal Facets (1998), for the
weighting by angle.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

CREASE_ANGLE = np.radians(30.0)
"""Smallest angle between face normals, in radians, at which an edge counts as sharp."""

# A face is degenerate if its area is below this fraction of its longest edge squared, as happens
# when single-precision files put three corners on one line.
_DEGENERATE = 1e-6

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
    group = smooth_groups(vertices, faces, crease_angle=crease_angle).reshape(-1)
    weighted = (_corner_angles(corners)[..., None] * flat[:, None]).reshape(-1, 3)
    sums = np.stack([np.bincount(group, weighted[:, axis]) for axis in range(3)], axis=-1)
    averaged = unit_vectors(sums)[group].reshape(-1, 3, 3)
    # Opposite faces may cancel at a corner: fall back to the face normal there.
    cancelled = np.all(averaged == 0.0, axis=-1, keepdims=True)
    return np.where(cancelled, flat[:, None], averaged)


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


def _smooth_patches(
    faces: Int[np.ndarray, "faces 3"],
    normals: Float[np.ndarray, "faces 3"],
    crease_angle: float,
) -> Int[np.ndarray, " faces"]:
    """Numbers the patches of faces that are connected across smooth edges."""
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    owner = np.repeat(np.arange(len(faces)), 3)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    edges, owner = edges[order], owner[order]
    shared = np.all(edges[1:] == edges[:-1], axis=1)
    first, second = owner[:-1][shared], owner[1:][shared]
    cosine = np.sum(normals[first] * normals[second], axis=1)
    solid = np.any(normals != 0.0, axis=1)
    smooth = (cosine > np.cos(crease_angle)) & solid[first] & solid[second]
    graph = coo_array(
        (np.ones(smooth.sum(), bool), (first[smooth], second[smooth])),
        shape=(len(faces), len(faces)),
    )
    return connected_components(graph, directed=False)[1]


def _corner_angles(corners: Float[np.ndarray, "faces 3 3"]) -> Float[np.ndarray, "faces 3"]:
    """Returns the angle of each face at each of its corners, in radians."""
    forward = unit_vectors(np.roll(corners, -1, axis=1) - corners)
    backward = unit_vectors(np.roll(corners, 1, axis=1) - corners)
    return np.arccos(np.clip(np.sum(forward * backward, axis=-1), -1.0, 1.0))


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
    """Returns a mesh with normals averaged by angle, but not across creases (radians)."""
    return Mesh(vertices, faces, corner_normals(vertices, faces, crease_angle=crease_angle))


def volume(vertices: Vertices, faces: Faces) -> float:
    """Returns the volume inside a closed surface, negative if its faces point inwards."""
    a, b, c = np.moveaxis(vertices[faces] - vertices.mean(axis=0), 1, 0)
    return float(np.sum(a * np.cross(b, c)) / 6.0)


def face_vectors(vertices: Vertices, faces: Faces) -> Float[np.ndarray, "faces 3"]:
    """Returns the faces' normals, each as long as the area of its face."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return 0.5 * np.cross(b - a, c - a)


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
