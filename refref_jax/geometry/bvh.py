"""Closest hits of rays with a packed bounding volume hierarchy (BVH) of triangles.

On a CPU, packets of rays traverse the tree together; on an accelerator, every ray traverses it
alone and all rays run in lock-step (`traversal`). With the environment variable
`REFREF_TRAVERSAL=warp`, a kernel of NVIDIA Warp finds the hits instead, on CPUs and NVIDIA GPUs.
`bvh_nodes` describes the memory layout of the tree, `bvh_build` its construction.

`closest_hits` takes a batch of rays with one leading axis. `closest_primitive` takes one ray, for
use under `vmap` and differentiation: under any nesting of `vmap`, all rays are cast as one batch.
The triangle that is hit is a constant for differentiation: recompute the hit point from the
triangle to obtain gradients.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, Float, Int

from refref_jax import compilation
from refref_jax.geometry import bvh_nodes, traversal
from refref_jax.geometry.rays import Rays, facet_barycentric
from refref_jax.geometry.traversal import PACKET, Packet

LEAF_SIZE = bvh_nodes.LEAF_SIZE
"""Maximum number of triangles in a leaf."""

NO_PRIMITIVE = -1
"""Primitive of a ray that hit nothing, or that does not start on a triangle."""


class BVH(NamedTuple):
    """A packed tree, built on the host by `bvh_build`.

    Attributes:
      nodes: one node table for each octant of directions (see `bvh_nodes`).
      triangles: corners of each primitive, in leaf order, then `LEAF_SIZE` that are never hit.
      facets: the same triangles, precomputed for the intersection test (see `rays`).
    """

    nodes: Int[Array, "8 nodes 8"]
    triangles: Float[Array, "primitives 3 3"]
    facets: Float[Array, "primitives 12"]


class Hits(NamedTuple):
    """The closest hit of each ray.

    Attributes:
      distances: arc length, `inf` for a miss.
      primitive_ids: index of the triangle that was hit, in leaf order, `NO_PRIMITIVE` for a miss.
      barycentrics: weights of the triangle's second and third corner, 0 for a miss.
    """

    distances: Float[Array, " rays"]
    primitive_ids: Int[Array, " rays"]
    barycentrics: Float[Array, "rays 2"]


def closest_hits(
    bvh: BVH,
    rays: Rays,
    *,
    limits: Float[Array, " rays"],
    exclude_primitive: Int[Array, " rays"],
) -> Hits:
    """Finds the first triangle that each ray hits, from either side.

    Among triangles at the same distance the lowest index is returned. Gradients do not flow through
    the search: recompute the point from the triangle and the barycentrics.

    Neighbours in the batch should be neighbours in space, because on a CPU 16 of them traverse the
    tree together. Pixels in tiles of 4 x 4 are coherent already; sort incoherent rays as in
    `benchmarks/ray_sorting.py`.

    Args:
      bvh: the tree of the scene.
      rays: any number of rays; rays that are not finite hit nothing.
      limits: farthest distance of interest; `inf` for no limit, negative for a ray that is not to
        be traced (its cost is negligible).
      exclude_primitive: index of the triangle that a ray starts on, which it cannot
        hit again, or `NO_PRIMITIVE`.

    Returns:
      The hits, in the order of the rays.
    """
    bvh, origins, directions, limits = jax.lax.stop_gradient(
        (bvh, rays.origins, rays.directions, limits)
    )
    nodes = bvh.nodes.reshape(-1, bvh_nodes.WORDS)
    limits = jnp.where(_finite(origins) & _finite(directions), limits, -1.0)
    distances, primitive_ids = jax.lax.platform_dependent(
        nodes,
        bvh.facets,
        origins,
        directions,
        limits,
        exclude_primitive,
        **_traversals(),
        default=jax.vmap(traversal.trace_ray, in_axes=(None, None, 0, 0, 0, 0)),
    )
    return _finish(bvh, origins, directions, distances, primitive_ids)


def _traversals() -> dict[str, Callable[..., Any]]:
    """Returns the traversal of each kind of device that has one of its own."""
    if compilation.chosen_traversal() == "warp":
        return {"cpu": traversal.trace_in_warp, "cuda": traversal.trace_in_warp}
    return {"cpu": _closest_in_packets}


def _finite(vectors: Float[Array, "rays 3"]) -> Bool[Array, " rays"]:
    # Beyond the bound, the products of the slab test could overflow to NaN.
    return jnp.all(jnp.abs(vectors) < 1e18, axis=-1)


def _finish(
    bvh: BVH,
    origins: Float[Array, "rays 3"],
    directions: Float[Array, "rays 3"],
    distances: Float[Array, " rays"],
    primitive_ids: Int[Array, " rays"],
) -> Hits:
    """Converts the result of a traversal to hits."""
    # Infinite distances tie, so a missed triangle may have been recorded.
    hit = jnp.isfinite(distances) & (primitive_ids != bvh_nodes.NONE)
    found = jnp.where(hit, primitive_ids, 0)
    met = bvh.facets.at[found].get(mode="promise_in_bounds")
    barycentrics = jax.vmap(facet_barycentric)(origins, directions, met)
    return Hits(
        jnp.where(hit, distances, jnp.inf),
        jnp.where(hit, primitive_ids, NO_PRIMITIVE),
        jnp.where(hit[:, None], barycentrics, 0.0),
    )


def _closest_in_packets(
    nodes: Int[Array, "rows 8"],
    facets: Float[Array, "primitives 12"],
    origins: Float[Array, "rays 3"],
    directions: Float[Array, "rays 3"],
    limits: Float[Array, " rays"],
    exclude_primitive: Int[Array, " rays"],
) -> tuple[Float[Array, " rays"], Int[Array, " rays"]]:
    """Traces all rays, 16 to a packet."""
    count = limits.shape[0]
    padding = -count % PACKET

    def by_component(vectors: Float[Array, "rays 3"]) -> Float[Array, "packets 3 width"]:
        padded = jnp.pad(vectors, ((0, padding), (0, 0)), constant_values=1.0)
        return jnp.swapaxes(padded.reshape(-1, PACKET, 3), 1, 2)

    def by_ray(values: Array, fill: float | int) -> Array:
        return jnp.pad(values, (0, padding), constant_values=fill).reshape(-1, PACKET)

    slabs = jax.vmap(bvh_nodes.slabs)(origins, directions)
    octants = jnp.where(limits >= 0.0, jax.vmap(bvh_nodes.octant)(directions), bvh_nodes.OCTANTS)
    closest = traversal.trace(
        nodes,
        facets,
        Packet(
            by_component(origins),
            by_component(directions),
            jax.tree.map(by_component, slabs),
            by_ray(octants, bvh_nodes.OCTANTS),
            by_ray(limits, -1.0),
            by_ray(exclude_primitive, NO_PRIMITIVE),
        ),
    )
    return jax.tree.map(lambda x: x.reshape(-1)[:count], tuple(closest))


class _Query(NamedTuple):
    """Rays to cast; arguments of `bvh.closest_hits`."""

    origins: Float[Array, " *rays 3"]
    directions: Float[Array, "*rays 3"]
    limits: Float[Array, "*rays"]
    exclude_primitive: Int[Array, "*rays"]


def closest_primitive(
    bvh: BVH,
    origin: Float[Array, "3"],
    direction: Float[Array, "3"],
    limit: Float[Array, ""],
    exclude_primitive: Int[Array, ""],
) -> Int[Array, ""]:
    """Returns the index of the first triangle that a ray hits, `NO_PRIMITIVE` if there is none.

    Args:
      bvh: the tree of the scene; it cannot be mapped over.
      origin: start of the ray.
      direction: unit vector.
      limit: farthest distance of interest; negative for a ray that is not to be cast.
      exclude_primitive: index of the triangle that the ray starts on, or `NO_PRIMITIVE`.
    """
    query = _Query(origin[None], direction[None], limit[None], exclude_primitive[None])
    return _find(*jax.lax.stop_gradient((bvh, query)))[0]


@custom_vmap
def _find(bvh: BVH, query: _Query) -> Int[Array, " rays"]:
    rays = Rays(query.origins, query.directions, jnp.zeros_like(query.limits))
    hits: Hits = closest_hits(
        bvh, rays, limits=query.limits, exclude_primitive=query.exclude_primitive
    )
    return hits.primitive_ids


@_find.def_vmap
def _find_mapped(
    axis_size: int, in_batched: list[Any], bvh: BVH, query: _Query
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
