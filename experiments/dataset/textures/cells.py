"""Voronoi cells of jittered lattices, periodic on the unit square."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from experiments.dataset.textures.fields import Field

_ROWS = 64  # at a time: what is in work stays in the cache


class Cells(NamedTuple):
    """Cell of every sample.

    Attributes:
      index: index of the cell.
      border: distance to the nearest border.
      dx, dy: offset from the cell's seed to the sample.
    """

    index: Int[np.ndarray, "h w"]
    border: Field
    dx: Field
    dy: Field


def voronoi(x: Field, y: Field, shape: tuple[int, int], seed: int, *, jitter: float = 0.9) -> Cells:
    """Returns the cells of one seed in each node of a lattice.

    Args:
      x: x coordinates of any value: the cells repeat with period 1.
      y: y coordinates, likewise.
      shape: number of nodes along x and along y.
      seed: seed of the jitter.
      jitter: side of the square in its node in which a seed lies; at 0 the cells are squares.
    """
    offsets = np.random.default_rng(seed).random((shape[1], shape[0], 2), np.float32)
    offsets = (offsets - 0.5) * jitter + 0.5
    blocks = [
        _nearest_two(x[start : start + _ROWS], y[start : start + _ROWS], offsets)
        for start in range(0, x.shape[0], _ROWS)
    ]
    return Cells(*(np.concatenate(parts) for parts in zip(*blocks, strict=True)))


def _nearest_two(x: Field, y: Field, offsets: Float[np.ndarray, "ny nx 2"]) -> Cells:
    along_y, along_x = offsets.shape[:2]
    column, row = np.floor(x * along_x), np.floor(y * along_y)
    column_index, row_index = column.astype(np.int32), row.astype(np.int32)
    first = np.full(x.shape, np.inf, np.float32)
    second = first.copy()
    first_x, first_y, second_x, second_y = (np.zeros_like(first) for _ in range(4))
    index = np.zeros(x.shape, np.int32)
    for right in (-1, 0, 1):
        for down in (-1, 0, 1):
            i, j = (column_index + right) % along_x, (row_index + down) % along_y
            offset = offsets[j, i]
            dx = (x - (column + right + offset[..., 0]) / along_x).astype(np.float32)
            dy = (y - (row + down + offset[..., 1]) / along_y).astype(np.float32)
            distance = dx * dx + dy * dy
            nearest = distance < first
            nearer = ~nearest & (distance < second)
            for old, leader, new in (
                (second, first, distance),
                (second_x, first_x, dx),
                (second_y, first_y, dy),
            ):
                np.copyto(old, leader, where=nearest)
                np.copyto(old, new, where=nearer)
                np.copyto(leader, new, where=nearest)
            np.copyto(index, j * along_x + i, where=nearest)
    # The border to the runner-up is the bisector of both seeds.
    between = np.hypot(second_x - first_x, second_y - first_y)
    border = (second - first) / (2.0 * np.maximum(between, np.float32(1e-9)))
    return Cells(index, border, first_x, first_y)
