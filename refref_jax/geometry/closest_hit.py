"""Closest hit of one ray, for use under `vmap` and differentiation.

Under any nesting of `vmap`, all rays are cast as one batch (see `bvh`). The triangle that is hit is
a constant for differentiation: recompute the hit point from the triangle to obtain gradients.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Float, Int

from refref_jax.geometry.bvh import BVH, Hits, closest_hits
from refref_jax.geometry.rays import Rays


class _Query(NamedTuple):
    """Rays to cast; arguments of `bvh.closest_hits`."""

    origins: Float[Array, " *rays 3"]
    directions: Float[Array, "*rays 3"]
    limits: Float[Array, "*rays"]
    leaving: Int[Array, "*rays"]


def closest_slot(
    bvh: BVH,
    origin: Float[Array, "3"],
    direction: Float[Array, "3"],
    limit: Float[Array, ""],
    leaving: Int[Array, ""],
) -> Int[Array, ""]:
    """Returns the slot of the first triangle that a ray hits, `NO_SLOT` if there is none.

    Args:
      bvh: the tree of the scene; it cannot be mapped over.
      origin: start of the ray.
      direction: unit vector.
      limit: farthest distance of interest; negative for a ray that is not to be cast.
      leaving: excluded primitive, the slot that the ray starts on, or `NO_SLOT`.
    """
    query = _Query(origin[None], direction[None], limit[None], leaving[None])
    return _find(*jax.lax.stop_gradient((bvh, query)))[0]


@custom_vmap
def _find(bvh: BVH, query: _Query) -> Int[Array, " rays"]:
    rays = Rays(query.origins, query.directions, jnp.zeros_like(query.limits))
    hits: Hits = closest_hits(bvh, rays, limits=query.limits, leaving=query.leaving)
    return hits.slots


@_find.def_vmap
def _find_mapped(
    axis_size: int, in_batched: list, bvh: BVH, query: _Query
) -> tuple[Int[Array, "axis rays"], bool]:
    bvh_batched, query_batched = in_batched
    if any(jax.tree.leaves(bvh_batched)):
        raise TypeError(
            "vmap over the argument bvh is not supported: one vmap cannot cast rays into several "
            "scenes. Use jax.lax.map over scenes."
        )
    every = jax.tree.map(
        lambda x, batched: x if batched else jnp.broadcast_to(x, (axis_size, *x.shape)),
        query,
        query_batched,
    )
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), every)
    return _find(bvh, flat).reshape(axis_size, -1), True
