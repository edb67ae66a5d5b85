"""Closest hits of more rays than should be prepared at once."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from refref_jax.geometry.bvh import BVH, Hits, closest_hits
from refref_jax.geometry.rays import Rays

TILE = 2**16
"""Rays that are traced at once by default."""


def closest_hits_in_tiles(
    bvh: BVH,
    rays: Rays,
    *,
    limits: Float[Array, " rays"],
    leaving: Int[Array, " rays"],
    trace: Callable[..., Hits] = closest_hits,
    tile: int = TILE,
) -> Hits:
    """Finds the same hits as `trace` on all rays, tile after tile.

    Beside rays and hits it needs memory for one tile only, whatever the number of rays.

    Args:
      bvh: the scene.
      rays: any number of rays.
      limits: as for `bvh.closest_hits`.
      leaving: as for `bvh.closest_hits`.
      trace: what finds the hits of a tile, `bvh.closest_hits` or `coherence.closest_hits_sorted`.
      tile: rays in a tile.

    Raises:
      ValueError: if a tile is to hold no ray.
    """
    if tile < 1:
        raise ValueError(f"A tile of {tile} rays holds nothing. Give a positive number of rays.")
    count = rays.radii.shape[0]
    whole = count - count % tile

    def trace_tile(part: tuple[Rays, Array, Array]) -> Hits:
        return trace(bvh, part[0], limits=part[1], leaving=part[2])

    def body(values: Array) -> Array:
        return values[:whole].reshape(-1, tile, *values.shape[1:])

    everything = (rays, limits, leaving)
    hits = jax.lax.map(trace_tile, jax.tree.map(body, everything))
    hits = jax.tree.map(lambda x: x.reshape(whole, *x.shape[2:]), hits)
    if whole == count:
        return hits
    rest = trace_tile(jax.tree.map(lambda x: x[whole:], everything))
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), hits, rest)
