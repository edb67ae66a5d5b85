"""Puts rays in an order in which neighbours share their way through the tree.

Two rays need the same nodes where they run in one octant of directions, start in one region and
leave in one region. So a ray's key is its octant, then the cell of its origin in the scene's box
(4 x 4 x 4), then the cell of the point where it leaves that box (16 x 16 x 16), both as Morton
codes.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt32

from refref_jax import numerics
from refref_jax.geometry import boxes, counting_sort
from refref_jax.geometry.bvh import BVH, Hits, closest_hits
from refref_jax.geometry.rays import Rays

_ORIGIN_BITS = 2
_EXIT_BITS = 4
_KEY_BITS = 3 + 3 * _ORIGIN_BITS + 3 * _EXIT_BITS


def closest_hits_sorted(
    bvh: BVH,
    rays: Rays,
    *,
    limits: Float[Array, " rays"],
    leaving: Int[Array, " rays"],
) -> Hits:
    """Finds the same hits as `bvh.closest_hits`, tracing the rays in a coherent order.

    It pays on a CPU for rays that come in no order, from some thousands on: rays inside a body
    that are shuffled are then traced more than twice as fast, the sort included. The more rays are
    sorted at once, the more alike are neighbours: 262,144 are a tenth to a fifth faster than
    65,536. Camera rays in tiles, and what a smooth body makes of them, are slower for it.

    Args:
      bvh: the scene.
      rays: any number of rays.
      limits: as for `bvh.closest_hits`.
      leaving: as for `bvh.closest_hits`.

    Returns:
      The hits, in the order of the rays as they were given.
    """
    order = coherent_order(bvh, rays)

    def in_order(values: Array) -> Array:
        return values.at[order].get(mode="promise_in_bounds", unique_indices=True)

    hits = closest_hits(
        bvh, jax.tree.map(in_order, rays), limits=in_order(limits), leaving=in_order(leaving)
    )

    def back(values: Array) -> Array:
        empty = jnp.zeros_like(values)
        return empty.at[order].set(values, mode="promise_in_bounds", unique_indices=True)

    return jax.tree.map(back, hits)


def coherent_order(bvh: BVH, rays: Rays) -> Int[Array, " rays"]:
    """Returns the numbers of the rays in an order in which neighbours are alike.

    Args:
      bvh: the scene, for its box.
      rays: any number of rays.
    """
    corners = jax.lax.bitcast_convert_type(bvh.nodes[0, 0, :6], jnp.float32)
    origins, directions = jax.lax.stop_gradient((rays.origins, rays.directions))
    keys = jax.vmap(_key, in_axes=(0, 0, None, None))(origins, directions, corners[:3], corners[3:])
    return counting_sort.stable_order(keys, bits=_KEY_BITS)


def _key(
    origin: Float[Array, "3"],
    direction: Float[Array, "3"],
    lower: Float[Array, "3"],
    upper: Float[Array, "3"],
) -> UInt32[Array, ""]:
    """Returns the key of one ray in the box of its scene."""
    reciprocal = numerics.safe_reciprocal(direction)
    x, y, z = (jnp.where(direction < 0.0, lower, upper) - origin) * reciprocal
    leaving = origin + jnp.minimum(jnp.minimum(x, y), z) * direction
    octant = boxes.octant(direction).astype(jnp.uint32)
    start = _morton(origin, lower, upper, _ORIGIN_BITS)
    end = _morton(leaving, lower, upper, _EXIT_BITS)
    return (((octant << 3 * _ORIGIN_BITS) | start) << 3 * _EXIT_BITS) | end


def _morton(
    point: Float[Array, "3"], lower: Float[Array, "3"], upper: Float[Array, "3"], bits: int
) -> UInt32[Array, ""]:
    """Returns the number of the point's cell, with the bits of its three coordinates interleaved.

    A point outside the box counts as on its nearest face.
    """
    scaled = (point - lower) * numerics.safe_divide(jnp.ones_like(lower), upper - lower)
    cell = jnp.clip(scaled * 2**bits, 0, 2**bits - 1).astype(jnp.int32).astype(jnp.uint32)
    code = jnp.zeros((), jnp.uint32)
    for axis in range(3):
        for bit in range(bits):
            code = code | (((cell[axis] >> bit) & 1) << (3 * bit + axis))
    return code
