"""Traversal of the BVH: packets of rays on CPUs, single rays in lock-step on accelerators.

As an option, a kernel of NVIDIA Warp traces single rays, each in a thread of its own on a GPU.

The rays of a packet share one node index, and the packet descends where any of its rays hits. Rays
are stored component by component, so that XLA turns each operation of the single-ray functions in
`bvh` and `rays` into one vector instruction. Packets are traced one after the other; the
cost of a packet without active rays is negligible.

A packet uses the node table of its rays' octant. If its rays have several octants, it traverses
the tree once for each, with the other rays masked.

On an accelerator, the state of a ray's loop is a row of the node table and the closest hit so far.
Under `vmap`, `trace_ray` becomes one loop over all rays, which ends with the slowest ray. Between
two iterations the host waits for the accelerator, so each iteration visits many nodes, and tests
the few leaves that it met at its end. A read from a computed row costs most of a kernel, so each
one reads the following rows, too, which are the likely next nodes.

The kernel (`trace_in_warp`) is `trace_ray` again, over the same tables and with the same rules of
edges, ties and of the triangle that a ray leaves: a change of one is a change of both. Without
fused multiply-adds, its distances are the bits of the formulas in `rays`, operation by operation.

Source: Wald et al., Interactive Rendering with Coherent Ray Tracing (2001), for packets; Smits,
Efficiency Issues for Ray Tracing (1998), for skip pointers.
"""

import functools
from typing import Any, NamedTuple, no_type_check

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float, Int

from refref_jax.compilation import native_loop
from refref_jax.geometry import bvh
from refref_jax.geometry.rays import EDGE_TOLERANCE, facet_distance

PACKET = 16
"""Number of rays in a packet: two vectors of eight, which hide each other's latency."""

_VISITS = 2
"""Number of nodes that a packet visits in one iteration of the loop."""

# Reads of nodes by a single ray in one iteration of the loop, and leaves that it can meet in it.
_READS_OF_RAY, _LEAVES_OF_RAY = 16, 4

# Options with which Warp compiles operations as they are written.
_WARP_OPTIONS = {"enable_backward": False, "fuse_fp": False, "fast_math": False}

_DONE = bvh.OCTANTS
"""Octant of a ray whose traversal is complete."""


class Packet(NamedTuple):
    """Rays that traverse the tree together, or many packets of them along a leading axis.

    Attributes:
      origins, directions: origins and unit directions of the rays.
      slabs: rays prepared for box tests.
      octants: octants of the directions, `_DONE` for a ray that is not to be traced.
      limits: farthest distance of interest.
      exclude_primitive: triangle that a ray cannot hit.
    """

    origins: Float[Array, "*packets 3 rays"]
    directions: Float[Array, "*packets 3 rays"]
    slabs: bvh.Slabs
    octants: Int[Array, "*packets rays"]
    limits: Float[Array, "*packets rays"]
    exclude_primitive: Int[Array, "*packets rays"]


class Closest(NamedTuple):
    """The closest hit so far: distance (initially the limit) and primitive (initially `NONE`)."""

    distances: Float[Array, "*packets rays"]
    primitive_ids: Int[Array, "*packets rays"]


class _Rounds(NamedTuple):
    """State of a packet's traversals: next octant, remaining octants of the rays, hits so far."""

    octant: Int[Array, ""]
    octants: Int[Array, " rays"]
    closest: Closest


class _Walk(NamedTuple):
    """State of one traversal: the next node, the current leaf (0 for none), the hits so far."""

    node: Int[Array, ""]
    leaf: Int[Array, ""]
    closest: Closest


@native_loop
def trace(
    nodes: Int[Array, "rows 8"], packed: Float[Array, "primitives 12"], packets: Packet
) -> Closest:
    """Traces packets one after the other.

    Args:
      nodes: node tables of all octants, concatenated.
      packed: precomputed triangles.
      packets: any number of packets, along the leading axis.
    """
    return jax.lax.map(lambda packet: _trace_packet(nodes, packed, packet), packets)


def _trace_packet(nodes: Int[Array, "rows 8"], packed: Array, packet: Packet) -> Closest:
    """Traverses the tree once for each octant among the packet's rays."""

    def walk_octant(rounds: _Rounds) -> _Rounds:
        octant, octants, closest = rounds
        awake = octants == octant
        reach = jnp.where(awake, closest.distances, -1.0)
        walked = _walk(nodes, packed, packet, octant, Closest(reach, closest.primitive_ids))
        distances = jnp.where(awake, walked.distances, closest.distances)
        left = jnp.where(awake, _DONE, octants)
        return _Rounds(jnp.min(left), left, Closest(distances, walked.primitive_ids))

    nothing = Closest(packet.limits, jnp.full_like(packet.exclude_primitive, bvh.NONE))
    start = _Rounds(jnp.min(packet.octants), packet.octants, nothing)
    return jax.lax.while_loop(lambda rounds: rounds.octant < _DONE, walk_octant, start).closest


def _walk(
    nodes: Int[Array, "rows 8"],
    packed: Float[Array, "primitives 12"],
    packet: Packet,
    octant: Int[Array, ""],
    closest: Closest,
) -> Closest:
    """Traverses the table of one octant, visiting each node at most once, and tests its leaves.

    The inner loop over nodes between two leaves carries only two numbers, not the hits.
    """

    def find_leaf(node: Array, reach: Array) -> tuple[Array, Array]:
        return jax.lax.while_loop(
            lambda state: state[1] == 0,
            lambda state: _visit_some(nodes, packet.slabs, reach, state[0]),
            (node, jnp.zeros_like(node)),
        )

    def advance(walk: _Walk) -> _Walk:
        closest = _test_leaf(packed, packet, walk.leaf - 1, walk.closest)
        return _Walk(*find_leaf(walk.node, closest.distances), closest)

    root = octant * (nodes.shape[0] // bvh.OCTANTS)
    start = _Walk(*find_leaf(root, closest.distances), closest)
    return jax.lax.while_loop(lambda walk: walk.leaf > 0, advance, start).closest


def _visit_some(
    nodes: Int[Array, "rows 8"],
    slabs: bvh.Slabs,
    reach: Float[Array, " rays"],
    index: Int[Array, ""],
) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """Visits `_VISITS` nodes in sequence; visits after a leaf are discarded.

    Visits are bound by latency, not by throughput, so several visits per iteration are up to 10 %
    faster than one.
    """
    index, leaf = _visit(nodes, slabs, reach, index)
    for _ in range(_VISITS - 1):
        after, next_leaf = _visit(nodes, slabs, reach, index)
        index = jnp.where(leaf != 0, index, after)
        leaf = jnp.where(leaf != 0, leaf, next_leaf)
    return index, leaf


def _visit(
    nodes: Int[Array, "rows 8"],
    slabs: bvh.Slabs,
    reach: Float[Array, " rays"],
    index: Int[Array, ""],
) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """Returns the node to visit next, and the leaf of this node if it is one and was hit.

    The end of the table is always returned, so that every traversal terminates.
    """
    node = bvh.read_node(nodes, index)
    overlap = jax.vmap(bvh.overlaps, in_axes=(-1, None, None, 0))(
        slabs, node.entry, node.exit, reach
    )
    hit = jnp.any(overlap)
    leaf = jnp.where(hit, node.leaf, jnp.minimum(node.leaf, 0))
    return jnp.where(hit, index + 1, node.skip), leaf


def _test_leaf(
    packed: Float[Array, "primitives 12"],
    packet: Packet,
    first: Int[Array, ""],
    closest: Closest,
) -> Closest:
    """Returns the closest of the hits so far and the hits in one leaf.

    Triangles are tested independently and compared afterwards. At equal distance the lower index
    wins, regardless of the order of traversal.
    """

    def meet(offset: int) -> Closest:
        primitive_id = first + offset
        facet = bvh.read_row(packed, primitive_id)
        distances = jax.vmap(facet_distance, in_axes=(-1, -1, None))(
            packet.origins, packet.directions, facet
        )
        return Closest(
            jnp.where(packet.exclude_primitive == primitive_id, jnp.inf, distances),
            jnp.broadcast_to(primitive_id, distances.shape),
        )

    best = meet(0)
    for offset in range(1, bvh.LEAF_SIZE):
        found = meet(offset)
        best = _closer(found, best, found.distances < best.distances)
    tied = (best.distances == closest.distances) & (best.primitive_ids < closest.primitive_ids)
    return _closer(best, closest, (best.distances < closest.distances) | tied)


def _closer(a: Closest, b: Closest, take: Array) -> Closest:
    return Closest(*(jnp.where(take, x, y) for x, y in zip(a, b, strict=True)))


class Ray(NamedTuple):
    """A single ray, prepared for box tests."""

    origin: Float[Array, "3"]
    direction: Float[Array, "3"]
    slabs: bvh.Slabs
    exclude_primitive: Int[Array, ""]


class RayWalk(NamedTuple):
    """State of a ray's traversal: the next node, and the closest hit so far."""

    node: Int[Array, ""]
    distance: Float[Array, ""]
    primitive_id: Int[Array, ""]


def trace_ray(
    nodes: Int[Array, "rows 8"],
    packed: Float[Array, "primitives 12"],
    origin: Float[Array, "3"],
    direction: Float[Array, "3"],
    limit: Float[Array, ""],
    exclude_primitive: Int[Array, ""],
) -> tuple[Float[Array, ""], Int[Array, ""]]:
    """Traces one ray.

    Args:
      nodes: node tables of all octants, concatenated.
      packed: precomputed triangles.
      origin: start of the ray.
      direction: unit vector.
      limit: farthest distance of interest, negative for a ray that is not to be traced.
      exclude_primitive: triangle that the ray cannot hit.

    Returns:
      The distance and index of the closest hit; the limit and `NONE` for a miss.
    """
    ray, end, start = begin_ray(nodes, origin, direction, limit, exclude_primitive)
    boxes = bvh.boxes(nodes)
    walk = jax.lax.while_loop(
        lambda walk: walk.node < end, lambda walk: advance_ray(boxes, packed, ray, end, walk), start
    )
    return walk.distance, walk.primitive_id


def begin_ray(
    nodes: Int[Array, "rows 8"],
    origin: Float[Array, "3"],
    direction: Float[Array, "3"],
    limit: Float[Array, ""],
    exclude_primitive: Int[Array, ""],
) -> tuple[Ray, Int[Array, ""], RayWalk]:
    """Returns a prepared ray, the end of its table, and the state of its loop; see `trace_ray`."""
    ray = Ray(origin, direction, bvh.slabs(origin, direction), exclude_primitive)
    rows = nodes.shape[0] // bvh.OCTANTS
    root = bvh.octant(direction) * rows
    end = root + rows - 1
    nothing = jnp.full_like(exclude_primitive, bvh.NONE)
    return ray, end, RayWalk(jnp.where(limit >= 0.0, root, end), limit, nothing)


def advance_ray(
    boxes: Complex[Array, "padded 4"],
    packed: Float[Array, "primitives 12"],
    ray: Ray,
    end: Int[Array, ""],
    walk: RayWalk,
) -> RayWalk:
    """Reads nodes `_READS_OF_RAY` times, then tests the leaves that the ray met.

    The ray waits at a leaf if it has met `_LEAVES_OF_RAY` before. At the end of the table it stays.
    """
    seen = _Seen(walk.node, (jnp.zeros_like(walk.node),) * _LEAVES_OF_RAY)

    def read(_: int | Array, seen: _Seen) -> _Seen:
        first, rows = seen.node, bvh.read_boxes(boxes, seen.node)
        for offset in range(bvh.BOXES):
            visited = _visit_by_ray(rows[offset], ray, walk.distance, seen)
            is_next = (seen.node == first + offset) & (first + offset < end)
            seen = jax.tree.map(functools.partial(jnp.where, is_next), visited, seen)
        return seen

    # XLA:CPU, for tests alone, would repeat the computation of all reads in each later one.
    loop = functools.partial(jax.lax.fori_loop, 0, _READS_OF_RAY, read)
    seen = jax.lax.platform_dependent(seen, cpu=loop, default=functools.partial(loop, unroll=True))
    walk = walk._replace(node=seen.node)
    for leaf in seen.leaves:
        walk = _test_leaf_of_ray(packed, ray, leaf, walk)
    return walk


class _Seen(NamedTuple):
    """The next node, and the leaves met so far (first triangle + 1, 0 for none)."""

    node: Int[Array, ""]
    leaves: tuple[Int[Array, ""], ...]


def _visit_by_ray(
    box: Complex[Array, "4"], ray: Ray, reach: Float[Array, ""], seen: _Seen
) -> _Seen:
    """Visits the next node, whose box is given."""
    entry, exit, link = bvh.corners_and_link(box)
    hit, is_leaf = bvh.overlaps(ray.slabs, entry, exit, reach), link < 0
    waiting = hit & is_leaf
    leaves = []
    for leaf in seen.leaves:
        leaves.append(jnp.where(waiting & (leaf == 0), -link, leaf))
        waiting &= leaf > 0
    after = jnp.where(hit | is_leaf, seen.node + 1, link)
    return _Seen(jnp.where(waiting, seen.node, after), tuple(leaves))


def _test_leaf_of_ray(
    packed: Float[Array, "primitives 12"], ray: Ray, leaf: Int[Array, ""], walk: RayWalk
) -> RayWalk:
    """Returns the closest of the hit so far and the hits in one leaf; the lower index wins ties."""
    node, distance, primitive_id = walk
    for offset in range(bvh.LEAF_SIZE):
        candidate = jnp.maximum(leaf - 1, 0) + offset
        facet = bvh.read_row(packed, candidate)
        found = facet_distance(ray.origin, ray.direction, facet)
        closer = (found < distance) | ((found == distance) & (candidate < primitive_id))
        closer = closer & (candidate != ray.exclude_primitive) & (leaf > 0)
        distance = jnp.where(closer, found, distance)
        primitive_id = jnp.where(closer, candidate, primitive_id)
    return RayWalk(node, distance, primitive_id)


def trace_in_warp(
    nodes: Int[Array, "rows 8"],
    packed: Float[Array, "primitives 12"],
    origins: Float[Array, "rays 3"],
    directions: Float[Array, "rays 3"],
    limits: Float[Array, " rays"],
    exclude_primitive: Int[Array, " rays"],
) -> tuple[Float[Array, " rays"], Int[Array, " rays"]]:
    """Traces rays by the kernel of Warp, on a CPU or an NVIDIA GPU.

    Arguments and results are those of `trace_ray`, for many rays.

    Raises:
      TypeError: if the rays are not in single precision.
    """
    if origins.dtype != jnp.float32:
        raise TypeError(
            f"The traversal in Warp takes rays of float32, not {origins.dtype}. Convert them, or "
            "unset REFREF_TRAVERSAL."
        )
    rows = nodes.shape[0] // bvh.OCTANTS
    roots = rows * jax.vmap(bvh.octant)(directions)
    distances, primitive_ids = _warp_walk()(
        nodes.reshape(-1, 4),
        packed.reshape(-1, 4),
        jnp.where(limits >= 0.0, roots, roots + rows - 1),
        roots + rows - 1,
        origins,
        directions,
        *jax.vmap(bvh.slabs)(origins, directions),
        limits,
        exclude_primitive,
        launch_dims=limits.shape[0],
        output_dims=limits.shape[0],
    )
    return distances, primitive_ids


@functools.cache
@no_type_check
def _warp_walk() -> Any:
    """Returns the kernel as a function of JAX arrays; two rows are a node, three a triangle."""
    import warp as wp

    if wp.config.log_level == wp.LOG_INFO:
        wp.config.log_level = wp.LOG_WARNING  # else it prints its devices and compilations
    overlaps, distance_to = _warp_overlaps(), _warp_distance()
    leaf_size, none = bvh.LEAF_SIZE, bvh.NONE

    def traversal(
        nodes: wp.array(dtype=wp.vec4i),
        packed: wp.array(dtype=wp.vec4f),
        starts: wp.array(dtype=wp.int32),
        ends: wp.array(dtype=wp.int32),
        origins: wp.array(dtype=wp.vec3f),
        directions: wp.array(dtype=wp.vec3f),
        reciprocals: wp.array(dtype=wp.vec3f),
        entries: wp.array(dtype=wp.vec3f),
        exits: wp.array(dtype=wp.vec3f),
        limits: wp.array(dtype=wp.float32),
        exclude_primitive: wp.array(dtype=wp.int32),
        distances: wp.array(dtype=wp.float32),
        primitive_ids: wp.array(dtype=wp.int32),
    ):
        ray = wp.tid()
        node = starts[ray]
        distance = limits[ray]
        primitive_id = wp.int32(none)
        while node < ends[ray]:
            low, high = nodes[2 * node], nodes[2 * node + 1]
            if overlaps(reciprocals[ray], entries[ray], exits[ray], low, high, distance):
                node += 1
                if high[3] > 0:
                    for offset in range(leaf_size):
                        at = high[3] - 1 + offset
                        found = distance_to(origins[ray], directions[ray], packed, at)
                        closer = found < distance or (found == distance and at < primitive_id)
                        if closer and at != exclude_primitive[ray]:
                            distance = found
                            primitive_id = at
            else:
                node = high[2]
        distances[ray] = distance
        primitive_ids[ray] = primitive_id

    kernel = wp.kernel(traversal, module="unique", module_options=_WARP_OPTIONS)
    return wp.jax_kernel(kernel, num_outputs=2, vmap_method="sequential")


@no_type_check
def _warp_overlaps() -> Any:
    """Returns `bvh.overlaps` in Warp; a node is two rows of four words."""
    import warp as wp

    far_padding = bvh.FAR_PADDING

    @wp.func
    def overlaps(
        reciprocals: wp.vec3f,
        entries: wp.vec3f,
        exits: wp.vec3f,
        low: wp.vec4i,
        high: wp.vec4i,
        limit: wp.float32,
    ):
        enter_x = wp.cast(low[0], wp.float32) * reciprocals[0] - entries[0]
        enter_y = wp.cast(low[1], wp.float32) * reciprocals[1] - entries[1]
        enter_z = wp.cast(low[2], wp.float32) * reciprocals[2] - entries[2]
        leave_x = wp.cast(low[3], wp.float32) * reciprocals[0] - exits[0]
        leave_y = wp.cast(high[0], wp.float32) * reciprocals[1] - exits[1]
        leave_z = wp.cast(high[1], wp.float32) * reciprocals[2] - exits[2]
        near = wp.max(wp.max(enter_x, enter_y), wp.max(enter_z, 0.0))
        far = wp.min(wp.min(leave_x, leave_y), leave_z) * far_padding
        return near <= wp.min(far, limit)

    return overlaps


@no_type_check
def _warp_distance() -> Any:
    """Returns `rays.facet_distance` in Warp; a facet is three rows of four numbers."""
    import warp as wp

    edge_tolerance = EDGE_TOLERANCE

    @wp.func
    def distance(
        origin: wp.vec3f, direction: wp.vec3f, packed: wp.array(dtype=wp.vec4f), facet: wp.int32
    ):
        a, b, c = packed[3 * facet], packed[3 * facet + 1], packed[3 * facet + 2]
        to_corner = wp.vec3f(a[0], a[1], a[2]) - origin
        normal = wp.vec3f(c[1], c[2], c[3])
        moment = wp.cross(direction, to_corner)
        determinant = wp.dot(direction, normal)
        side = wp.where(determinant < 0.0, -1.0, 1.0)
        u = wp.dot(moment, wp.vec3f(b[2], b[3], c[0])) * side
        v = wp.dot(moment, wp.vec3f(a[3], b[0], b[1])) * side
        reach, area = wp.dot(to_corner, normal) * side, wp.abs(determinant)
        outside = wp.min(wp.min(u, v), area - (u + v))
        hit = wp.min(reach, area) > 0.0 and outside >= -edge_tolerance * area
        return wp.where(hit, reach, wp.inf) / area

    return distance
