"""Table rows and weights of the grid vertices around a point.

A grid of `n` cells per side covers the unit cube. If its `(n + 1)^3` vertices fit into the table,
each vertex has its own row, with x varying fastest; otherwise, vertices are hashed to rows.

Source: Mueller et al., Instant NGP (2022), section 3.
"""

import itertools
import math
from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float, UInt32

# Primes of Instant NGP's spatial hash.
_PRIMES = (1, 2654435761, 805459861)

_CORNERS = tuple(itertools.product((0, 1), repeat=3))


def corners(
    position: Sequence[Float[Array, "*batch"]], resolution: int, entries: int
) -> list[tuple[UInt32[Array, "*batch"], Float[Array, "*batch"]]]:
    """Returns entry and trilinear weight of each of the eight corners of the cell around a point.

    The result is a list instead of an array, so that a CPU loop can hold it in registers. A point
    outside the cube by rounding belongs to the nearest cell.

    Args:
      position: coordinates x, y and z in the unit cube.
      resolution: number of cells per side.
      entries: number of entries of the table.
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
    """Returns the factor of each coordinate in the dense or hashed index."""
    side = resolution + 1
    return (1, side, side * side) if side**3 <= entries else _PRIMES


def _entry(
    terms: Sequence[UInt32[Array, "*batch"]], strides: tuple[int, int, int], entries: int
) -> UInt32[Array, "*batch"]:
    x, y, z = terms
    # Parenthesised so that the term of two axes is computed once for two corners.
    return (x ^ (y ^ z)) & jnp.uint32(entries - 1) if strides is _PRIMES else x + (y + z)
