"""The vertices of a grid: which rows of a table belong to the cell around a point.

A grid of `n` cells a side covers the unit cube. If its `(n + 1)^3` vertices fit into the table
each has a row of its own, ordered with x fastest; if not, vertices share rows by a hash.

Source: Mueller et al., Instant NGP (2022), section 3.
"""

import itertools
import math
from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float, UInt32

# The primes of Instant NGP's spatial hash.
_PRIMES = (1, 2654435761, 805459861)

_CORNERS = tuple(itertools.product((0, 1), repeat=3))


def corners(
    position: Sequence[Float[Array, "*batch"]], resolution: int, entries: int
) -> list[tuple[UInt32[Array, "*batch"], Float[Array, "*batch"]]]:
    """Returns entry and weight of each of the eight corners of the cell around a point.

    A list and not an array, so that a loop of a CPU can hold them in registers. The weights are
    those of trilinear interpolation. A point that rounding left outside the cube belongs to the
    nearest cell.

    Args:
      position: coordinates x, y and z in the unit cube.
      resolution: cells a side.
      entries: of the table.
    """
    strides = _strides(resolution, entries)
    terms, weights = [], []
    for coordinate, stride in zip(position, strides, strict=True):
        scaled = coordinate * resolution
        cell = jnp.clip(jnp.floor(scaled), 0, resolution - 1)
        low = cell.astype(jnp.uint32) * jnp.uint32(stride)
        terms.append((low, low + jnp.uint32(stride)))
        weights.append((1.0 - (scaled - cell), scaled - cell))
    return [
        (
            _entry([terms[axis][corner[axis]] for axis in range(3)], strides, entries),
            math.prod(weights[axis][corner[axis]] for axis in range(3)),
        )
        for corner in _CORNERS
    ]


def _strides(resolution: int, entries: int) -> tuple[int, int, int]:
    """Returns by how much a step along each axis moves what an entry is made from."""
    side = resolution + 1
    return (1, side, side * side) if side**3 <= entries else _PRIMES


def _entry(
    terms: Sequence[UInt32[Array, "*batch"]], strides: tuple[int, int, int], entries: int
) -> UInt32[Array, "*batch"]:
    x, y, z = terms
    # Brackets so that what two axes share is computed once for two corners.
    return (x ^ (y ^ z)) & jnp.uint32(entries - 1) if strides is _PRIMES else x + (y + z)
