"""Blender's monkey, Suzanne, as one closed mesh (NumPy only).

Blender writes the mesh (`export_monkey`), and `monkey(load_suzanne(path))` makes the object. Its
head has open eye sockets with eyes that are open at the back: holes in each of the three pieces are
closed, and the pieces are united with rounded seams.
"""

import zipfile
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.ndimage import gaussian_filter
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from experiments.dataset.objects.distance_fields import Distances, Field, Points
from experiments.dataset.objects.field_operations import gridded, union
from experiments.dataset.objects.formed import centred, spacing
from experiments.dataset.objects.isosurface import Surface, isosurface, sample
from experiments.dataset.parts import Object, ObjectPart

_RADIUS = 1.7

# Suzanne is 2.7 wide in Blender, and faces -y.
_HALF_EXTENT = 1.6

# The grid of distances: its spacing, the Gaussian's width, and the seams' blending length.
_GRID, _SMOOTHING, _SEAM = 0.035, 0.03, 0.06

# Number of candidate triangles per point: those with the nearest centres.
_CANDIDATES = 10


def load_suzanne(path: Path) -> Surface:
    """Reads the file written by `export_monkey`.

    Raises:
      ValueError: if it is missing or is another file.
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return Surface(arrays["vertices"].astype(np.float64), arrays["faces"].astype(np.int64))
    except (OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise ValueError(
            f"{path} does not hold Blender's monkey ({error}). Write it with "
            "experiments/dataset/export_monkey.py."
        ) from error


def monkey(mesh: Surface) -> Object:
    """Returns the monkey made of a mesh of open pieces.

    Args:
      mesh: mesh from `load_suzanne`; within 1.6 of the origin along each axis.
    """

    def make(detail: float) -> list[ObjectPart]:
        pieces = [_solid(closed(piece)) for piece in pieces_of(mesh)]
        values, low = sample(union(*pieces, blend=_SEAM), spacing=_GRID, half_extent=_HALF_EXTENT)
        field = gridded(gaussian_filter(values, _SMOOTHING / _GRID), low, _GRID)
        surface = isosurface(
            field, spacing=0.75 * spacing(detail, thinnest=0.1), half_extent=_HALF_EXTENT
        )
        return centred([ObjectPart("body", "glass", *surface)], _RADIUS)

    return Object("monkey", "smncvx", make)


def pieces_of(mesh: Surface) -> list[Surface]:
    """Returns the connected pieces of a mesh, the largest first."""
    count = len(mesh.vertices)
    first, second = mesh.faces[:, [0, 1]].ravel(), mesh.faces[:, [1, 2]].ravel()
    graph = coo_array((np.ones(first.size, bool), (first, second)), shape=(count, count))
    labels = connected_components(graph, directed=False)[1]
    order = np.argsort(-np.bincount(labels), kind="stable")
    pieces = []
    for label in order.tolist():
        used, numbers = np.unique(
            mesh.faces[labels[mesh.faces[:, 0]] == label], return_inverse=True
        )
        if len(used):
            pieces.append(Surface(mesh.vertices[used], numbers.reshape(-1, 3)))
    return pieces


def closed(piece: Surface) -> Surface:
    """Returns a piece with a fan of triangles over each of its holes."""
    directed = piece.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    count = len(piece.vertices)
    keys, back = directed @ [count, 1], directed @ [1, count]
    rim = directed[~np.isin(keys, back)]
    graph = coo_array((np.ones(len(rim), bool), (rim[:, 0], rim[:, 1])), shape=(count, count))
    labels = connected_components(graph, directed=False)[1][rim[:, 0]]
    vertices, faces = [piece.vertices], [piece.faces]
    for number, label in enumerate(np.unique(labels).tolist()):
        edges = rim[labels == label]
        vertices.append(piece.vertices[edges[:, 0]].mean(axis=0, keepdims=True))
        middle = np.full((len(edges), 1), count + number)
        faces.append(np.concatenate([edges[:, ::-1], middle], axis=1))
    return Surface(np.concatenate(vertices), np.concatenate(faces))


def _solid(surface: Surface) -> Field:
    """Returns the distance to a closed surface with triangles that are small for its curvature."""
    mesh = trimesh.Trimesh(*surface, process=False)
    corners = surface.vertices[surface.faces]
    normals = np.asarray(mesh.vertex_normals)[surface.faces]
    tree = KDTree(corners.mean(axis=1))

    def distance(points: Points) -> Distances:
        candidates = tree.query(points, k=min(_CANDIDATES, len(corners)))[1]
        nearest, face = _nearest(points, corners, candidates)
        shares = trimesh.triangles.points_to_barycentric(corners[face], nearest)
        outward = np.einsum("pc,pcx->px", shares, normals[face])
        away = points - nearest
        sign = np.where(np.einsum("px,px->p", away, outward) < 0.0, -1.0, 1.0)
        return sign * np.linalg.norm(away, axis=-1)

    middle = 0.5 * (surface.vertices.min(axis=0) + surface.vertices.max(axis=0))
    x, y, z = middle.tolist()
    return Field(
        distance, (x, y, z), float(np.max(np.linalg.norm(surface.vertices - middle, axis=-1)))
    )


def _nearest(
    points: Points,
    corners: Float[np.ndarray, "faces 3 3"],
    candidates: Int[np.ndarray, "points candidates"],
) -> tuple[Points, Int[np.ndarray, " points"]]:
    """Returns the nearest point on the candidates for each point, and its candidate's index."""
    best, found, face = np.full(len(points), np.inf), np.zeros_like(points), candidates[:, 0].copy()
    for candidate in candidates.T:
        on = trimesh.triangles.closest_point(corners[candidate], points)
        away = np.sum((points - on) ** 2, axis=-1)
        better = away < best
        best[better], found[better], face[better] = away[better], on[better], candidate[better]
    return found, face
