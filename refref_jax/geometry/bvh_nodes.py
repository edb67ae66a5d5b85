"""BVH nodes: their layout in memory, and the intersection of one ray with the box of a node.

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

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex, Float, Int

from refref_jax import numerics

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
