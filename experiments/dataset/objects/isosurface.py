"""Extracts the surface of a field (see `distance_fields`) as triangles (NumPy only).

Marching cubes gives the right topology, but thin triangles. Therefore its vertices are distributed
evenly along the surface, and projected to the zero set by Newton steps along the gradient.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import maximum_filter
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components

from experiments.dataset.objects.distance_fields import Distances, Field, Points, evaluate
from experiments.dataset.parts import RADIUS
from refref_jax.reconstruct.grids import march

# Number of fine cells along the edge of a coarse one; and largest distance of coarse corners to the
# surface, in coarse edges: sqrt(3) / 2 for a 1-Lipschitz field, and more for an approximate one.
_COARSE = 4
_NEAR = 1.5

# Number of smoothing steps, relaxation factor, largest step in cells, additional weight of a
# neighbour per radian between the normals; and number of final Newton steps.
_RELAXATIONS = 8
_SHARE = 0.5
_LONGEST = 0.3
_STIFFENING = 6.0
_NEWTON_STEPS = 2

# Step of the finite differences for gradients, in cells.
_DIFFERENCE = 1e-3


class Surface(NamedTuple):
    """A closed triangle mesh.

    Attributes:
      vertices: positions, world units.
      faces: vertex indices, counter-clockwise seen from outside, closed.
    """

    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]


def isosurface(field: Field, *, spacing: float, half_extent: float = RADIUS + 0.4) -> Surface:
    """Returns the zero set of a field: closed, outward, evenly triangulated.

    Args:
      field: signed distance, negative inside.
      spacing: spacing of the grid, and about the length of an edge; less than the thinnest wall.
      half_extent: half the edge of the searched cube around the origin.

    Raises:
      ValueError: if the cube contains no surface, or the surface leaves the cube.
    """
    values, low = sample(field, spacing=spacing, half_extent=half_extent)
    shell = np.ones(values.shape, bool)
    shell[1:-1, 1:-1, 1:-1] = False
    if not np.any(values < 0.0) or np.any(values[shell] < 0.0):
        raise ValueError(
            f"No closed surface lies within {half_extent} of the origin. Check the dimensions "
            "of the solid."
        )
    vertices, faces = march(values, spacing)
    return Surface(settle(field, low + vertices, faces, spacing=spacing), faces)


def sample(
    field: Field, *, spacing: float, half_extent: float
) -> tuple[Float[np.ndarray, "n n n"], Float[np.ndarray, "3"]]:
    """Returns a field's values on a grid, exact near the surface, and the grid's first point.

    Elsewhere values come from a coarser grid and have the right sign. The field must not change
    much faster than 1 per unit.
    """
    cells = int(np.ceil(2.0 * half_extent / (_COARSE * spacing)))
    low = np.full(3, -0.5 * cells * _COARSE * spacing)
    ticks = low[0] + spacing * np.arange(cells * _COARSE + 1)
    corners = _on_grid(field, ticks[::_COARSE])
    close = maximum_filter(np.abs(corners) < _NEAR * _COARSE * spacing, size=2, origin=-1)
    looked_at = np.zeros((len(ticks),) * 3, bool)
    # A cell's own points, and those on its far sides.
    looked_at[:-1, :-1, :-1] = _spread(close[:-1, :-1, :-1], _COARSE)
    looked_at = maximum_filter(looked_at, size=2)
    nearest = np.rint(np.arange(len(ticks)) / _COARSE).astype(np.int64)
    values = corners[np.ix_(nearest, nearest, nearest)]
    at = np.argwhere(looked_at)
    values[looked_at] = evaluate(field, low + spacing * at)
    return values, low


def settle(
    field: Field, vertices: Points, faces: Int[np.ndarray, "faces 3"], *, spacing: float
) -> Points:
    """Returns vertices near a zero set, distributed evenly and projected to it."""
    start, end = faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel()
    for _ in range(_RELAXATIONS):
        vertices, normals = _towards_zero(field, vertices, spacing)
        # Stiffer where the curvature is high, so that edges are shorter there.
        stiffness = 1.0 + _STIFFENING * np.linalg.norm(normals[start] - normals[end], axis=-1)
        # In a closed surface, every edge occurs once in each direction.
        pull = csr_array((stiffness, (start, end)), shape=(len(vertices),) * 2)
        mean = (pull @ vertices) / pull.sum(axis=1)[:, None]
        step = _SHARE * (mean - vertices)
        step -= np.einsum("vc,vc->v", step, normals)[:, None] * normals
        vertices = vertices + _shortened(step, _LONGEST * spacing)
    for _ in range(_NEWTON_STEPS):
        vertices, _ = _towards_zero(field, vertices, spacing)
    return vertices


def largest_piece(surface: Surface) -> Surface:
    """Returns the connected component with the most vertices."""
    labels = _pieces(surface)
    return without(surface, labels != np.argmax(np.bincount(labels)))


def without(surface: Surface, dropped: Bool[np.ndarray, " vertices"]) -> Surface:
    """Returns a surface without all faces that have a dropped vertex."""
    faces = surface.faces[~np.any(dropped[surface.faces], axis=1)]
    used, numbers = np.unique(faces, return_inverse=True)
    return Surface(surface.vertices[used], numbers.reshape(-1, 3))


def _pieces(surface: Surface) -> Int[np.ndarray, " vertices"]:
    count = len(surface.vertices)
    first, second = surface.faces[:, [0, 1]].ravel(), surface.faces[:, [1, 2]].ravel()
    graph = coo_array((np.ones(first.size, bool), (first, second)), shape=(count, count))
    return connected_components(graph, directed=False)[1]


def _on_grid(field: Field, ticks: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n n n"]:
    points = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), axis=-1)
    return evaluate(field, points.reshape(-1, 3)).reshape(points.shape[:3])


def _spread(cells: Bool[np.ndarray, "n n n"], times: int) -> Bool[np.ndarray, "m m m"]:
    for axis in range(3):
        cells = np.repeat(cells, times, axis=axis)
    return cells


def _towards_zero(field: Field, vertices: Points, spacing: float) -> tuple[Points, Points]:
    """Makes a Newton step along the gradient; returns the vertices and the gradient's direction."""
    value, step = evaluate(field, vertices), _DIFFERENCE * spacing
    slope = np.stack([evaluate(field, vertices + step * e) - value for e in np.eye(3)], axis=-1)
    slope /= step
    squared = np.sum(slope**2, axis=-1, keepdims=True)
    # At a kink of the field the differences may cancel; such vertices do not move.
    squared = np.where(squared > 0.01, squared, np.inf)
    move = _shortened(-value[:, None] * slope / squared, _LONGEST * spacing)
    return vertices + move, slope / np.sqrt(squared)


def _shortened(steps: Points, longest: float) -> Points:
    length: Distances = np.linalg.norm(steps, axis=-1, keepdims=True)
    return steps * np.minimum(1.0, longest / np.maximum(length, 1e-300))
