"""Closest hits of rays with a packed tree of triangles (a bounding volume hierarchy).

The tree is stored depth first. Every node has a *skip pointer*, the node to visit next when its
box is missed; when it is hit, the next node is simply the following one. So a traversal needs
no stack: its whole state is one node index, and it ends when the index runs off the table.

On a CPU a packet of 16 rays shares one node index and descends where any of them hits; packets
run one after the other, so a ray that misses everything costs its packet a single node visit.
On an accelerator every ray walks alone, all in lock-step.

This module works on whole packets (one leading axis of rays); the geometry of one ray with one
box or triangle is in `boxes` and `triangles`.

Source: Smits, Efficiency Issues for Ray Tracing (1998), for skip pointers; Wald et al.,
Interactive Rendering with Coherent Ray Tracing (2001), for packets.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from refref_jax import numerics
from refref_jax.geometry import boxes, triangles
from refref_jax.geometry.native_loop import native_loop
from refref_jax.geometry.rays import Rays

LEAF_SIZE = 4
"""Most triangles a leaf may hold: the number tested at each leaf visit."""

NO_SLOT = -1
"""The slot of a ray that hit nothing, or that leaves no triangle."""

_PACKET = 16


class BVH(NamedTuple):
    """A packed tree, built on the host by `bvh_build`.

    Attributes:
      boxes: lower and upper corner of each node, depth first.
      skips: the node to visit after a node's whole subtree.
      leaves: first triangle slot and number of triangles; the number is 0 at inner nodes.
      triangles: corners by slot, in leaf order, padded so that every leaf can read
        `LEAF_SIZE` of them.
    """

    boxes: Float[Array, "nodes 2 3"]
    skips: Int[Array, " nodes"]
    leaves: Int[Array, "nodes 2"]
    triangles: Float[Array, "slots 3 3"]


class Hits(NamedTuple):
    """The closest hit of each ray.

    Attributes:
      distances: arc length, `inf` for a miss.
      slots: the triangle that was hit, `NO_SLOT` for a miss.
      barycentrics: weights of the triangle's second and third corner.
    """

    distances: Float[Array, " rays"]
    slots: Int[Array, " rays"]
    barycentrics: Float[Array, "rays 2"]


class _Walk(NamedTuple):
    """State of a packet's traversal: the next node, and the closest hits so far."""

    node: Int[Array, ""]
    hits: Hits


def closest_hits(
    bvh: BVH,
    rays: Rays,
    *,
    limits: Float[Array, " rays"],
    leaving: Int[Array, " rays"],
) -> Hits:
    """Finds where each ray first meets a triangle, from either side.

    Ties go to the triangle that is met first in the tree. Gradients do not flow: recompute the
    point from the slot and the barycentrics.

    Args:
      bvh: the scene.
      rays: any number of rays.
      limits: farthest distance of interest; `inf` for all, negative for a ray that is not to
        be traced (it costs next to nothing).
      leaving: the slot of the triangle that a ray starts on, which it can not hit again, or
        `NO_SLOT`.

    Returns:
      The hits, in the order of the rays.
    """
    arguments = jax.lax.stop_gradient((bvh, rays.origins, rays.directions, limits))
    return jax.lax.platform_dependent(
        *arguments, leaving, cpu=_hits_in_packets, default=_hits_in_lockstep
    )


@native_loop
def _hits_in_packets(
    bvh: BVH,
    origins: Float[Array, "rays 3"],
    directions: Float[Array, "rays 3"],
    limits: Float[Array, " rays"],
    leaving: Int[Array, " rays"],
) -> Hits:
    """Traces packet after packet."""
    count = limits.shape[0]
    padding = -count % _PACKET

    def to_packets(x: Array, fill: float | int) -> Array:
        widths = [(0, padding)] + [(0, 0)] * (x.ndim - 1)
        padded = jnp.pad(x, widths, constant_values=fill)
        return padded.reshape(-1, _PACKET, *x.shape[1:])

    hits = jax.lax.map(
        lambda packet: _trace_packet(bvh, *packet),
        (
            to_packets(origins, 0.0),
            to_packets(directions, 1.0),
            to_packets(limits, -1.0),
            to_packets(leaving, NO_SLOT),
        ),
    )
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:count], hits)


def _hits_in_lockstep(
    bvh: BVH,
    origins: Float[Array, "rays 3"],
    directions: Float[Array, "rays 3"],
    limits: Float[Array, " rays"],
    leaving: Int[Array, " rays"],
) -> Hits:
    """Traces all rays at once, each as a packet of one."""

    def trace_one(origin: Array, direction: Array, limit: Array, slot: Array) -> Hits:
        hits = _trace_packet(bvh, origin[None], direction[None], limit[None], slot[None])
        return jax.tree.map(lambda x: x[0], hits)

    return jax.vmap(trace_one)(origins, directions, limits, leaving)


def _trace_packet(
    bvh: BVH,
    origins: Float[Array, "rays 3"],
    directions: Float[Array, "rays 3"],
    limits: Float[Array, " rays"],
    leaving: Int[Array, " rays"],
) -> Hits:
    """Walks the tree once for a packet of rays, at most one visit a node."""
    nodes = bvh.skips.shape[0]
    inverses = numerics.safe_reciprocal(directions)

    def advance(walk: _Walk) -> _Walk:
        reach = jnp.minimum(limits, walk.hits.distances)
        overlap = jax.vmap(boxes.overlaps, in_axes=(0, 0, None, 0))(
            origins, inverses, bvh.boxes[walk.node], reach
        )
        descend = jnp.any(overlap)
        first, count = bvh.leaves[walk.node]
        hits = jax.lax.cond(
            descend & (count > 0),
            lambda hits: _test_leaf(bvh, origins, directions, limits, leaving, first, count, hits),
            lambda hits: hits,
            walk.hits,
        )
        return _Walk(jnp.where(descend, walk.node + 1, bvh.skips[walk.node]), hits)

    misses = Hits(
        jnp.full_like(limits, jnp.inf),
        jnp.full_like(leaving, NO_SLOT),
        jnp.zeros_like(origins[:, :2]),
    )
    start = _Walk(jnp.zeros_like(bvh.skips[0]), misses)
    return jax.lax.while_loop(lambda walk: walk.node < nodes, advance, start).hits


def _test_leaf(
    bvh: BVH,
    origins: Float[Array, "rays 3"],
    directions: Float[Array, "rays 3"],
    limits: Float[Array, " rays"],
    leaving: Int[Array, " rays"],
    first: Int[Array, ""],
    count: Int[Array, ""],
    hits: Hits,
) -> Hits:
    """Keeps the closer of the hits so far and those of one leaf's triangles."""
    for offset in range(LEAF_SIZE):
        slot = first + offset
        found = jax.vmap(triangles.intersect, in_axes=(0, 0, None))(
            origins, directions, bvh.triangles[slot]
        )
        closer = (
            (offset < count)
            & (found.distance < hits.distances)
            & (found.distance <= limits)
            & (slot != leaving)
        )
        hits = _keep(closer, found, slot, hits)
    return hits


def _keep(
    closer: Bool[Array, " rays"],
    found: triangles.Intersection,
    slot: Int[Array, ""],
    hits: Hits,
) -> Hits:
    return Hits(
        jnp.where(closer, found.distance, hits.distances),
        jnp.where(closer, slot, hits.slots),
        jnp.where(closer[:, None], found.barycentric, hits.barycentrics),
    )
