"""Closed triangle meshes: what is measured on them, and their pieces (NumPy only)."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from refref_jax.geometry.corner_normals import CREASE_ANGLE, corner_normals

Vertices = Float[np.ndarray, "vertices 3"]
Faces = Int[np.ndarray, "faces 3"]


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
    """Returns normals as long as the faces' areas."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return 0.5 * np.cross(b - a, c - a)


def vertex_vectors(vertices: Vertices, faces: Faces) -> Vertices:
    """Returns the gradient of the volume with respect to each vertex: outward, as long as an area.

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
    """Numbers the connected pieces of a mesh with so many vertices."""
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
