"""Single-ray BVH traversal for accelerators, run in lock-step under `vmap`.

The state of the loop is a row of the node table and the closest hit so far. Under `vmap` it becomes
one loop over all rays, which ends with the slowest ray.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from refref_jax.geometry import bvh_nodes, triangles


class _Walk(NamedTuple):
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
    slabs = bvh_nodes.slabs(origin, direction)
    rows = nodes.shape[0] // bvh_nodes.OCTANTS
    root = bvh_nodes.octant(direction) * rows
    end = root + rows - 1

    def advance(walk: _Walk) -> _Walk:
        node = bvh_nodes.read_node(nodes, walk.node)
        hit = bvh_nodes.overlaps(slabs, node.entry, node.exit, walk.distance)
        tested = hit & (node.leaf > 0)
        distance, primitive_id = jax.lax.cond(
            tested,
            lambda: _test_leaf(packed, origin, direction, exclude_primitive, node.leaf - 1, walk),
            lambda: (walk.distance, walk.primitive_id),
        )
        return _Walk(jnp.where(hit, walk.node + 1, node.skip), distance, primitive_id)

    start = _Walk(
        jnp.where(limit >= 0.0, root, end), limit, jnp.full_like(exclude_primitive, bvh_nodes.NONE)
    )
    walk = jax.lax.while_loop(lambda walk: walk.node < end, advance, start)
    return walk.distance, walk.primitive_id


def _test_leaf(
    packed: Float[Array, "primitives 12"],
    origin: Float[Array, "3"],
    direction: Float[Array, "3"],
    exclude_primitive: Int[Array, ""],
    first: Int[Array, ""],
    walk: _Walk,
) -> tuple[Float[Array, ""], Int[Array, ""]]:
    """Returns the closest of the hit so far and the hits in one leaf; the lower index wins ties."""
    distance, primitive_id = walk.distance, walk.primitive_id
    for offset in range(bvh_nodes.LEAF_SIZE):
        candidate = first + offset
        facet = bvh_nodes.read_row(packed, candidate)
        found = triangles.distance(origin, direction, facet)
        closer = (found < distance) | ((found == distance) & (candidate < primitive_id))
        closer = closer & (candidate != exclude_primitive)
        distance = jnp.where(closer, found, distance)
        primitive_id = jnp.where(closer, candidate, primitive_id)
    return distance, primitive_id
