"""Cuts rays into tiles of one size, so that what renders a tile is compiled once.

What goes tile by tile runs on the host, and compiles on its own.
"""

from collections.abc import Callable, Sequence
from typing import TypeVar

import jax
import numpy as np
from jaxtyping import Int

from refref_jax.geometry.rays import Rays
from refref_jax.optics.media import EMPTY_SLOT

# A ray that fills up a tile starts this far out and goes away: it meets nothing, and leaves the
# room of the tile's budget to the others.
_OUT_OF_REACH = 1e9

# A budget's room must not be that of a ray or two.
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
    """Returns what rays see, tile by tile, as NumPy arrays with the leading axes of the rays.

    Args:
      see: what the rays of a tile see, from them, the parts that they start in, and how many of
        them are real: the others fill it up.
      rays: camera rays with any leading axes.
      tile: rays in a tile.
      nothing: what no rays see.
      instead: what the error tells to do.
      inside: the parts that each ray starts in, if that is known.

    Raises:
      TypeError: if an array has no value yet, see `fetch`.
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
    """Returns the size of the tiles of some rays: few need no large one."""
    return min(most, max(_SMALLEST_TILE, 1 << max(rays - 1, 0).bit_length()))


def join(parts: Sequence[_Tree]) -> _Tree:
    """Returns one tree of NumPy arrays, which are those of the parts behind each other."""
    return jax.tree.map(lambda *each: np.concatenate(each), *parts)


def fetch(tree: _Tree, *, instead: str) -> _Tree:
    """Returns NumPy arrays in place of all arrays.

    Args:
      tree: numbers and arrays.
      instead: what the error tells to do.

    Raises:
      TypeError: if one of them has no value yet, because JAX transforms the calling function.
    """
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree)):
        raise TypeError(
            "Pictures are rendered tile by tile on the host, which can not be part of a function "
            f"that jit, vmap or grad transforms. {instead}"
        )
    return jax.tree.map(np.asarray, jax.device_get(tree))


def cut_out(
    rays: Rays, inside: Int[np.ndarray, "rays slots"] | None, start: int, tile: int
) -> tuple[Rays, Int[np.ndarray, "tile slots"] | None]:
    """Returns one tile of rays, the last one filled up with rays that meet nothing.

    Args:
      rays: all of them, NumPy arrays.
      inside: the parts that each starts in, if that is known.
      start: the first ray of the tile.
      tile: rays in it.
    """
    part, within = jax.tree.map(lambda x: x[start : start + tile], (rays, inside))
    missing = tile - part.radii.shape[0]
    away = np.tile(np.eye(3, dtype=part.directions.dtype)[:1], (missing, 1))
    filling = Rays(_OUT_OF_REACH * away, away, np.ones(missing, part.radii.dtype))
    nowhere = jax.tree.map(lambda x: np.full((missing, x.shape[1]), EMPTY_SLOT, x.dtype), within)
    return jax.tree.map(lambda a, b: np.concatenate([a, b]), (part, within), (filling, nowhere))
