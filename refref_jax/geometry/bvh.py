"""Closest hits of rays with a packed bounding volume hierarchy (BVH) of triangles, and its nodes.

On a CPU, packets of rays traverse the tree together; on an accelerator, every ray traverses it
alone and all rays run in lock-step (`traversal`). With the environment variable
`REFREF_TRAVERSAL=warp`, a kernel of NVIDIA Warp finds the hits instead, on CPUs and NVIDIA GPUs.
`bvh_build` describes the construction of the tree.

`closest_hits` takes a batch of rays with one leading axis. `closest_primitive` takes one ray, for
use under `vmap` and differentiation: under any nesting of `vmap`, all rays are cast as one batch.
The triangle that is hit is a constant for differentiation: recompute the hit point from the
triangle to obtain gradients.

A ray's *octant* is the set of axes along which its direction is negative, as a 3-bit number (x is
the lowest bit). All rays of an octant enter and leave a box through the same faces, so the slab
test needs no sorting: the *entry corner* is where the three entered faces meet, the *exit corner*
where the three exited faces meet.

A node is one row of eight 32-bit words, so that one visit is one contiguous load: the entry corner
of its box (three floats, bit-cast), the exit corner, the *skip pointer* and the leaf.

There are eight tables, one per octant of directions, each in depth-first order with the nearer
child of every node first. If a box is missed, the traversal continues at the row of the skip
pointer; if it is hit, at the following row. A traversal therefore needs no stack: its state is one
row. All tables share the triangles. The last row of a table marks its end; it has no box and a
negative leaf.

Source: the slab method, Kay and Kajiya (1986).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, Complex, Float, Int

from refref_jax import compilation, numerics
from refref_jax.geometry.rays import Rays, facet_barycentric

# The products of plane and origin with the reciprocal are each rounded once, by half a unit in the
# last place of the second. Two units cover both.
_SLACK = 2.4e-7

FAR_PADDING = 1.0000004
"""Two roundings up on the far side, so that a triangle that lies in a box face is never culled."""

OCTANTS = 8

WORDS = 8
"""Number of words in a node."""

LEAF_SIZE = 4
"""Maximum number of triangles in a leaf, and the number tested at each leaf visit."""

BOXES = 3
"""Number of rows that a read of `boxes` returns."""

NONE = 2**31 - 1
"""Slot for "no triangle", above all others."""

NO_PRIMITIVE = -1
"""Primitive of a ray that hit nothing, or that does not start on a triangle."""


# ---- Nodes ----


class Slabs(NamedTuple):
    """A ray prepared for box tests, computed once for all boxes.

    The distance to a plane is one fused multiply-add, `plane * reciprocal - offset`. The offset
    is rounded so that boxes are entered early and left late.

    Attributes:
      reciprocals: reciprocals of the direction's components, all finite.
      entries: offsets for the planes through which a box is entered.
      exits: offsets for the planes through which a box is left.
    """

    reciprocals: Float[Array, "3"]
    entries: Float[Array, "3"]
    exits: Float[Array, "3"]


def octant(direction: Float[Array, "3"]) -> Int[Array, ""]:
    """Returns the octant of a direction, 0 to 7; zeros count by their sign bit, as in `slabs`."""
    x, y, z = jnp.signbit(direction).astype(jnp.int32)
    return x + 2 * y + 4 * z


def slabs(origin: Float[Array, "3"], direction: Float[Array, "3"]) -> Slabs:
    """Prepares a ray for `overlaps`."""
    reciprocals = numerics.safe_reciprocal(direction)
    offsets = origin * reciprocals
    slack = _SLACK * jnp.abs(offsets)
    return Slabs(reciprocals, offsets + slack, offsets - slack)


def overlaps(
    ray: Slabs,
    entry: Float[Array, "3"],
    exit: Float[Array, "3"],
    limit: Float[Array, ""],
) -> Bool[Array, ""]:
    """Returns whether the ray passes through the box at a distance in `[0, limit]`.

    Args:
      ray: the ray, from `slabs`.
      entry: entry corner of the box in the octant of the ray.
      exit: exit corner of the box.
      limit: farthest distance of interest; a negative limit overlaps no box.
    """
    # Written out by components and with `where` instead of `minimum`, which would propagate NaN:
    # in a packet each line is then one instruction for eight rays.
    kind = ray.reciprocals.dtype  # boxes are in single precision, rays in any
    enter_x, enter_y, enter_z = entry.astype(kind) * ray.reciprocals - ray.entries
    leave_x, leave_y, leave_z = exit.astype(kind) * ray.reciprocals - ray.exits
    near = _larger(_larger(enter_x, enter_y), _larger(enter_z, jnp.zeros_like(enter_z)))
    far = _smaller(_smaller(leave_x, leave_y), leave_z) * FAR_PADDING
    return near <= _smaller(far, limit)


def _larger(a: Float[Array, ""], b: Float[Array, ""]) -> Float[Array, ""]:
    return jnp.where(a > b, a, b)


def _smaller(a: Float[Array, ""], b: Float[Array, ""]) -> Float[Array, ""]:
    return jnp.where(a < b, a, b)


class Node(NamedTuple):
    """A decoded node.

    Attributes:
      entry, exit: corners of the box.
      skip: row to visit after the node's subtree.
      leaf: first triangle + 1 of a leaf, 0 for an inner node, -1 for the end of the table.
    """

    entry: Float[Array, "3"]
    exit: Float[Array, "3"]
    skip: Int[Array, ""]
    leaf: Int[Array, ""]


def read_node(nodes: Int[Array, "rows 8"], index: Int[Array, ""]) -> Node:
    """Returns one node of the table."""
    words = read_row(nodes, index)
    corners = jax.lax.bitcast_convert_type(words[:6], jnp.float32)
    return Node(corners[:3], corners[3:], words[6], words[7])


def boxes(nodes: Int[Array, "rows 8"]) -> Complex[Array, "padded 4"]:
    """Returns the nodes for lock-step traversal: pairs of words are real and imaginary parts.

    The first three pairs are entry and exit corner. The last real part is the *link*, bit-cast:
    minus the leaf, or the skip pointer of a node that is none; a leaf that is missed continues at
    the following row in any case. XLA repeats the computation of a row's index for every column
    that is read, and these are half as many. The last row is repeated for `read_boxes`.
    """
    nodes = jnp.concatenate([nodes, jnp.repeat(nodes[-1:], BOXES - 1, axis=0)])
    corners = jax.lax.bitcast_convert_type(nodes[:, :6], jnp.float32)
    link = jnp.where(nodes[:, 7:] > 0, -nodes[:, 7:], nodes[:, 6:7])
    words = jax.lax.bitcast_convert_type(link, jnp.float32)
    parts = [jnp.concatenate([corners[:, at : at + 3], words], axis=1) for at in (0, 3)]
    return jax.lax.complex(*parts)


def read_boxes(boxes: Complex[Array, "padded 4"], index: Int[Array, ""]) -> Complex[Array, "3 4"]:
    """Returns `BOXES` rows of `boxes` from an index."""
    index = index.astype(jnp.uint32)
    start = (index, jnp.zeros_like(index))
    return jax.lax.dynamic_slice(boxes, start, (BOXES, 4), allow_negative_indices=False)


def corners_and_link(
    box: Complex[Array, "4"],
) -> tuple[Float[Array, "3"], Float[Array, "3"], Int[Array, ""]]:
    """Returns entry corner, exit corner and link of a row of `boxes`."""
    return box[:3].real, box[:3].imag, jax.lax.bitcast_convert_type(box[3].real, jnp.int32)


def read_row(table: Array, index: Int[Array, ""]) -> Array:
    """Returns a row without the check for negative indices, which would cost half a box test."""
    index = index.astype(jnp.uint32)
    start = (index, jnp.zeros_like(index))
    row = jax.lax.dynamic_slice(table, start, (1, table.shape[1]), allow_negative_indices=False)
    return row[0]


# ---- Closest hits ----


class BVH(NamedTuple):
    """A packed tree, built on the host by `bvh_build`.

    Attributes:
      nodes: one node table for each octant of directions (see above).
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
    nodes = bvh.nodes.reshape(-1, WORDS)
    limits = jnp.where(_finite(origins) & _finite(directions), limits, -1.0)
    distances, primitive_ids = _traverse(
        nodes, bvh.facets, origins, directions, limits, exclude_primitive
    )
    return _finish(bvh, origins, directions, distances, primitive_ids)


def _traverse(*arguments: Array) -> tuple[Float[Array, " rays"], Int[Array, " rays"]]:
    """Traverses the tree in the way that suits the device that it is compiled for."""
    from refref_jax.geometry import traversal  # which reads the nodes of this module

    if compilation.chosen_traversal() == "warp":
        warp = traversal.trace_in_warp
        return jax.lax.platform_dependent(*arguments, cpu=warp, cuda=warp, default=_closest_by_ray)
    return _by_platform(*arguments)


def _closest_by_ray(*arguments: Array) -> tuple[Float[Array, " rays"], Int[Array, " rays"]]:
    """Casts all rays, each by itself."""
    from refref_jax.geometry import traversal  # which reads the nodes of this module

    return jax.vmap(traversal.trace_ray, in_axes=(None, None, 0, 0, 0, 0))(*arguments)


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
    hit = jnp.isfinite(distances) & (primitive_ids != NONE)
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
    from refref_jax.geometry import traversal  # which reads the nodes of this module

    count = limits.shape[0]
    padding = -count % traversal.PACKET

    def by_component(vectors: Float[Array, "rays 3"]) -> Float[Array, "packets 3 width"]:
        padded = jnp.pad(vectors, ((0, padding), (0, 0)), constant_values=1.0)
        return jnp.swapaxes(padded.reshape(-1, traversal.PACKET, 3), 1, 2)

    def by_ray(values: Array, fill: float | int) -> Array:
        padded = jnp.pad(values, (0, padding), constant_values=fill)
        return padded.reshape(-1, traversal.PACKET)

    prepared = jax.vmap(slabs)(origins, directions)
    octants = jnp.where(limits >= 0.0, jax.vmap(octant)(directions), OCTANTS)
    closest = traversal.trace(
        nodes,
        facets,
        traversal.Packet(
            by_component(origins),
            by_component(directions),
            jax.tree.map(by_component, prepared),
            by_ray(octants, OCTANTS),
            by_ray(limits, -1.0),
            by_ray(exclude_primitive, NO_PRIMITIVE),
        ),
    )
    return jax.tree.map(lambda x: x.reshape(-1)[:count], tuple(closest))


_by_platform = compilation.chosen_by_platform(
    "closest_hits", cpu=_closest_in_packets, default=_closest_by_ray, like=lambda *query: query[4:]
)


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
