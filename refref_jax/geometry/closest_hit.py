"""The closest hit of one ray, to be mapped and differentiated at will.

Under `vmap`, any number of times, all rays are cast together (see `bvh`). To differentiation the
triangle that is found is a constant, and so is every number about the hit: recompute the point from
the triangle.
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
    """Returns the slot of the triangle that a ray meets first, `NO_SLOT` if none.

    Args:
      bvh: the scene; it can not be mapped over.
      origin: start of the ray.
      direction: unit.
      limit: farthest distance of interest; negative for a ray that is not to be cast.
      leaving: the slot that the ray starts on, or `NO_SLOT`.
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
            "Rays can not be cast into many scenes by one vmap: the tree is an argument that must "
            "not be mapped over. Use jax.lax.map over scenes."
        )
    every = jax.tree.map(
        lambda x, batched: x if batched else jnp.broadcast_to(x, (axis_size, *x.shape)),
        query,
        query_batched,
    )
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), every)
    return _find(bvh, flat).reshape(axis_size, -1), True
