"""Cuts rays into tiles of one size, so that what renders a tile is compiled once.

What goes tile by tile runs on the host, and compiles on its own.
"""

from typing import TypeVar

import jax
import numpy as np
from jaxtyping import Int

from refref_jax.geometry.rays import Rays
from refref_jax.optics.media import EMPTY_SLOT

# A ray that fills up a tile starts this far out and goes away: it meets nothing, and leaves the
# room of the tile's budget to the others.
_OUT_OF_REACH = 1e9


_Tree = TypeVar("_Tree")


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
