"""Splits rays into tiles of one size, so that the function that renders a tile compiles once.

The loop over tiles runs on the host, so it cannot be part of a transformed function.
"""

from collections.abc import Callable, Sequence
from typing import TypeVar

import jax
import numpy as np
from jaxtyping import Int

from refref_jax.geometry.rays import Rays
from refref_jax.optics.media import EMPTY_SLOT

# Padding rays of a tile start at this distance and point away from the scene: they hit nothing and
# leave the capacity of the path buffers to the other rays.
_OUT_OF_REACH = 1e9

# Smaller tiles would have too little capacity for the paths of a ray.
_SMALLEST_TILE = 1024

_Tree = TypeVar("_Tree")


def in_tiles(
    see: Callable[[Rays, Int[np.ndarray, "tile slots"] | None, int], _Tree],
    rays: Rays,
    *,
    tile: int,
    nothing: _Tree,
    instead: str,
    inside: Int[np.ndarray, "*rays slots"] | None = None,
) -> _Tree:
    """Renders rays tile by tile, to NumPy arrays with the leading axes of the rays.

    Args:
      see: function that renders a tile, given its rays, their interior lists, and the number of
        rays that are not padding.
      rays: camera rays with any leading axes.
      tile: number of rays per tile.
      nothing: result for 0 rays.
      instead: advice at the end of the error message.
      inside: interior list of each ray's origin, if known.

    Raises:
      TypeError: if an array is a tracer, see `fetch`.
    """
    rays, inside = fetch((rays, inside), instead=instead)
    shape, count = rays.radii.shape, rays.radii.size
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[len(shape) :]), (rays, inside))
    parts = []
    for start in range(0, count, tile):
        seen = see(*cut_out(*flat, start, tile), min(tile, count - start))
        parts.append(fetch(seen, instead=instead))
    joined = join(parts or [nothing])
    return jax.tree.map(lambda x: x[:count].reshape((*shape, *x.shape[1:])), joined)


def size_for(rays: int, *, most: int) -> int:
    """Returns the tile size for a number of rays: smaller tiles for few rays."""
    return min(most, max(_SMALLEST_TILE, 1 << max(rays - 1, 0).bit_length()))


def join(parts: Sequence[_Tree]) -> _Tree:
    """Concatenates the arrays of several pytrees, as NumPy arrays."""
    return jax.tree.map(lambda *each: np.concatenate(each), *parts)


def fetch(tree: _Tree, *, instead: str) -> _Tree:
    """Converts all arrays of a pytree to NumPy arrays.

    Args:
      tree: pytree of numbers and arrays.
      instead: advice at the end of the error message.

    Raises:
      TypeError: if an array is a tracer, because JAX transforms the calling function.
    """
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree)):
        raise TypeError(
            "This function works tile by tile on the host and cannot be part of a function "
            f"that jit, vmap or grad transforms. {instead}"
        )
    return jax.tree.map(np.asarray, jax.device_get(tree))


def cut_out(
    rays: Rays, inside: Int[np.ndarray, "rays slots"] | None, start: int, tile: int
) -> tuple[Rays, Int[np.ndarray, "tile slots"] | None]:
    """Returns one tile of rays; the last tile is padded with rays that hit nothing.

    Args:
      rays: all rays, as NumPy arrays.
      inside: interior list of each ray's origin, if known.
      start: index of the first ray of the tile.
      tile: number of rays per tile.
    """
    part, within = jax.tree.map(lambda x: x[start : start + tile], (rays, inside))
    missing = tile - part.radii.shape[0]
    away = np.tile(np.eye(3, dtype=part.directions.dtype)[:1], (missing, 1))
    filling = Rays(_OUT_OF_REACH * away, away, np.ones(missing, part.radii.dtype))
    nowhere = jax.tree.map(lambda x: np.full((missing, x.shape[1]), EMPTY_SLOT, x.dtype), within)
    return jax.tree.map(lambda a, b: np.concatenate([a, b]), (part, within), (filling, nowhere))
