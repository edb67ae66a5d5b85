"""Scalar fields on regular grids (NumPy only).

A field is negative inside a body and positive outside, in world units, and changes by about 1 per
unit near the surface. A grid's axes are x, y, z; point `(i, j, k)` lies at `low + spacing (i, j,
k)`.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import map_coordinates, maximum_filter, minimum_filter

Points = Float[np.ndarray, "points 3"]
Values = Float[np.ndarray, " points"]
Field = Callable[[Points], Values]

NEAR = 1.5
"""Edges of a coarse cell from the surface within which a corner is looked around.

An exact distance needs sqrt(3) / 2, and a field that is nearly one some more.
"""

# Fine cells along the edge of a coarse one.
_COARSE = 4

# Points of one sweep: bounds the memory of a field with many terms.
_SWEEP = 1 << 18


class Box(NamedTuple):
    """A box along the axes.

    Attributes:
      low: its least corner, world units.
      high: its greatest corner.
    """

    low: Float[np.ndarray, "3"]
    high: Float[np.ndarray, "3"]


class Grid(NamedTuple):
    """A sampled field.

    Attributes:
      values: exact within a few cells of the surface; elsewhere of the right sign.
      low: the first point, world units.
      spacing: between points, world units.
    """

    values: Float[np.ndarray, "nx ny nz"]
    low: Float[np.ndarray, "3"]
    spacing: float


def sample(
    field: Field, box: Box, *, spacing: float, level: float = 0.0, near: float = NEAR
) -> Grid:
    """Samples a field, finely only near one of its level sets.

    Far from it the values are those of a coarser grid: a feature thinner than its cells
    (4 spacings) may be missed if no corner is within 6 spacings of the surface by the field's
    value.

    Args:
      field: see the module.
      box: is covered, and exceeded by less than 4 spacings on each side.
      spacing: of the fine grid.
      level: the value whose surroundings are sampled.
      near: edges of a coarse cell within which of the surface a corner is looked around.
    """
    cells = np.maximum(np.ceil((box.high - box.low) / (_COARSE * spacing)), 1).astype(np.int64)
    low = 0.5 * (box.low + box.high) - 0.5 * cells * _COARSE * spacing
    shape = tuple(cells * _COARSE + 1)
    coarse = _evaluate(field, low, _COARSE * spacing, np.indices(cells + 1).reshape(3, -1).T)
    corners = coarse.reshape(cells + 1) - level
    close_corners = np.abs(corners) < near * _COARSE * spacing
    close = maximum_filter(close_corners, size=2, origin=-1)
    # A field with a jump may cross the level with no corner near it.
    signs = np.sign(corners)
    close |= maximum_filter(signs, size=2, origin=-1) != minimum_filter(signs, size=2, origin=-1)
    looked_at = np.zeros(shape, bool)
    # A cell's own points, and those on its far sides.
    looked_at[:-1, :-1, :-1] = _spread(close[:-1, :-1, :-1])
    looked_at = maximum_filter(looked_at, size=2)
    nearest = [np.rint(np.arange(n) / _COARSE).astype(np.int64) for n in shape]
    values = corners[np.ix_(*nearest)] + level
    values[looked_at] = _evaluate(field, low, spacing, np.argwhere(looked_at))
    return Grid(values, low, spacing)


def lattice(box: Box, count: int) -> Points:
    """Returns the points of a regular lattice over a box, so many along each edge."""
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
