"""Samples scalar fields on regular grids and extracts their level sets as meshes (NumPy only).

A field is negative inside an object and positive outside, in world units, and changes by about 1
per unit near the surface. The axes of a grid are x, y, z; point `(i, j, k)` lies at `low + spacing
(i, j, k)`. Level sets are extracted by marching cubes of scikit-image.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import map_coordinates, maximum_filter, minimum_filter

from refref_jax.geometry.triangle_meshes import CREASE_ANGLE, Faces, Mesh, Vertices, corner_normals
from refref_jax.reconstruct import ReconstructionError

Points = Float[np.ndarray, "points 3"]
Values = Float[np.ndarray, " points"]
Field = Callable[[Points], Values]

NEAR = 1.5
"""Largest distance from the surface at which a coarse corner is refined, in coarse cell edges.

An exact distance needs sqrt(3) / 2; an approximate distance needs a little more.
"""

# Fine cells along the edge of a coarse cell.
_COARSE = 4

# Points evaluated at once, which bounds the memory of a field with many terms.
_SWEEP = 1 << 18


class Box(NamedTuple):
    """An axis-aligned box.

    Attributes:
      low: corner with the smallest coordinates, world units.
      high: corner with the largest coordinates, world units.
    """

    low: Float[np.ndarray, "3"]
    high: Float[np.ndarray, "3"]


class Grid(NamedTuple):
    """A sampled field.

    Attributes:
      values: field values, exact within a few cells of the surface; elsewhere only the sign is
        right.
      low: position of the first point, world units.
      spacing: distance between points, world units.
    """

    values: Float[np.ndarray, "nx ny nz"]
    low: Float[np.ndarray, "3"]
    spacing: float


def sample(
    field: Field, box: Box, *, spacing: float, level: float = 0.0, near: float = NEAR
) -> Grid:
    """Samples a field, finely only near one of its level sets.

    Far from it the values are those of a coarser grid. A feature thinner than the coarse cells (4
    spacings) may be missed if the field is above 6 spacings at all corners around it.

    Args:
      field: function to sample, see the module.
      box: region to cover; the grid exceeds it by less than 4 spacings on each side.
      spacing: distance between points of the fine grid, world units.
      level: value whose surroundings are sampled finely.
      near: largest distance from the surface at which a coarse corner is refined, in coarse cell
        edges.
    """
    cells = np.maximum(np.ceil((box.high - box.low) / (_COARSE * spacing)), 1).astype(np.int64)
    low = 0.5 * (box.low + box.high) - 0.5 * cells * _COARSE * spacing
    shape = tuple(cells * _COARSE + 1)
    coarse = _evaluate(field, low, _COARSE * spacing, np.indices(cells + 1).reshape(3, -1).T)
    corners = coarse.reshape(cells + 1) - level
    close_corners = np.abs(corners) < near * _COARSE * spacing
    close = maximum_filter(close_corners, size=2, origin=-1)
    # A discontinuous field may cross the level with no corner near it.
    signs = np.sign(corners)
    close |= maximum_filter(signs, size=2, origin=-1) != minimum_filter(signs, size=2, origin=-1)
    looked_at = np.zeros(shape, bool)
    # The points of a cell, and those on its far sides.
    looked_at[:-1, :-1, :-1] = _spread(close[:-1, :-1, :-1])
    looked_at = maximum_filter(looked_at, size=2)
    nearest = [np.rint(np.arange(n) / _COARSE).astype(np.int64) for n in shape]
    values = corners[np.ix_(*nearest)] + level
    values[looked_at] = _evaluate(field, low, spacing, np.argwhere(looked_at))
    return Grid(values, low, spacing)


def lattice(box: Box, count: int) -> Points:
    """Returns a regular lattice over a box, with `count` points along each edge."""
    ticks = [np.linspace(low, high, count) for low, high in zip(*box, strict=True)]
    return np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)


def interpolate(grid: Grid, points: Points) -> Values:
    """Returns the values between grid points, linear along each axis; the nearest ones outside."""
    return map_coordinates(grid.values, _index(grid, points), order=1, mode="nearest")


def gradient(grid: Grid, points: Points) -> Points:
    """Returns the field's gradient: central differences at grid points, linear between them."""
    index = _index(grid, points)
    return np.stack(
        [
            map_coordinates(slope, index, order=1, mode="nearest")
            for slope in np.gradient(grid.values, grid.spacing)
        ],
        axis=-1,
    )


def _evaluate(
    field: Field, low: Float[np.ndarray, "3"], spacing: float, index: Int[np.ndarray, "points 3"]
) -> Values:
    parts = [
        field(low + spacing * index[start : start + _SWEEP])
        for start in range(0, len(index), _SWEEP)
    ]
    return np.concatenate([np.zeros(0), *parts])


def _index(grid: Grid, points: Points) -> Float[np.ndarray, "3 points"]:
    return ((points - grid.low) / grid.spacing).T


def _spread(cells: Bool[np.ndarray, "n m k"]) -> Bool[np.ndarray, "fn fm fk"]:
    for axis in range(3):
        cells = np.repeat(cells, _COARSE, axis=axis)
    return cells


# Values closer to zero than this, in cells, are pushed away from it, so that no two vertices of
# marching cubes coincide in a grid corner and no face is degenerate.
CLEARANCE = 0.1

# Newton steps back to the zero set: their number, the longest one in cells, and the smallest slope.
_NEWTON_STEPS = 3
_LONGEST = 0.3
_FLATTEST = 0.1


def find_isosurface(grid: Grid, *, level: float = 0.0) -> Mesh:
    """Returns the level set of a grid: closed, outward, normals from the grid's gradient.

    The surface is closed where the object reaches the border of the grid. Where the gradient
    deviates from a smooth patch (at an edge, across which finite differences average), the normals
    are those of the faces, averaged within the crease angle.

    Args:
      grid: sampled field, negative inside.
      level: value on the surface.

    Raises:
      ReconstructionError: if no value is below the level, or scikit-image is not installed.
    """
    values = np.pad(grid.values - level, 1, constant_values=grid.spacing)
    if not np.any(values < 0.0):
        raise ReconstructionError(
            f"No value of the grid is below {level:g}, so it contains no surface. Check that the "
            "field is negative inside, or sample it more finely."
        )
    padded = Grid(values, grid.low - grid.spacing, grid.spacing)
    vertices, faces = march(values, grid.spacing)
    vertices = _settle(padded, padded.low + vertices)
    slopes = gradient(padded, vertices)
    return Mesh(vertices, faces, _normals(slopes, vertices, faces))


def march(values: np.ndarray, spacing: float) -> tuple[Vertices, Faces]:
    """Returns the zero level set of values as triangles, without degenerate ones.

    Vertices may lie up to `CLEARANCE` of a cell away from the zero crossing.

    Args:
      values: field values at grid points, positive on the border.
      spacing: distance between grid points.

    Raises:
      ReconstructionError: if scikit-image is not installed.
    """
    clearance = CLEARANCE * spacing
    cleared = np.copysign(np.maximum(np.abs(values), clearance), values)
    vertices, faces, _, _ = import_skimage().marching_cubes(
        cleared, 0.0, gradient_direction="descent"
    )
    return spacing * vertices.astype(np.float64), faces.astype(np.int64)


def _settle(grid: Grid, vertices: Points) -> Points:
    """Returns vertices moved along the gradient to where the grid is zero."""
    for _ in range(_NEWTON_STEPS):
        value, slope = interpolate(grid, vertices), gradient(grid, vertices)
        squared = np.sum(slope**2, axis=-1)
        # At a kink the differences may cancel; such a vertex is not moved.
        step = -np.where(squared > _FLATTEST, value, 0.0)[:, None] * slope
        step /= np.maximum(squared, _FLATTEST)[:, None]
        length = np.linalg.norm(step, axis=-1, keepdims=True)
        longest = _LONGEST * grid.spacing
        vertices = vertices + step * (longest / np.maximum(length, longest))
    return vertices


def _normals(slopes: Points, vertices: Vertices, faces: Faces) -> np.ndarray:
    """Returns unit gradients at corners, or face normals where the two deviate."""
    averaged = corner_normals(vertices, faces)
    length = np.linalg.norm(slopes, axis=-1, keepdims=True)
    unit = np.divide(slopes, length, out=np.zeros_like(slopes), where=length > 0.0)[faces]
    agrees = np.sum(unit * averaged, axis=-1, keepdims=True) > np.cos(0.5 * CREASE_ANGLE)
    return np.where(agrees, unit, averaged)


def import_skimage() -> Any:
    """Returns scikit-image's `measure`, so that a missing package is reported early.

    Raises:
      ReconstructionError: if scikit-image is not installed.
    """
    try:
        import skimage.measure
    except ImportError as error:
        raise ReconstructionError(
            "scikit-image, which extracts surfaces, is not installed. Install it with "
            "pip install -e '.[r3f]'."
        ) from error
    return skimage.measure
