"""Memory layout of BVH nodes, and their access on the device.

A node is one row of eight 32-bit words, so that one visit is one contiguous load: the entry corner
of its box (three floats, bit-cast), the exit corner, the *skip pointer* and the leaf.

There are eight tables, one per octant of directions, each in depth-first order with the nearer
child of every node first. If a box is missed, the traversal continues at the row of the skip
pointer; if it is hit, at the following row. A traversal therefore needs no stack: its state is one
row. All tables share the triangles.

The last row of a table marks its end; it has no box and a negative leaf.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

OCTANTS = 8

WORDS = 8
"""Number of words in a node."""

LEAF_SIZE = 4
"""Maximum number of triangles in a leaf, and the number tested at each leaf visit."""

NONE = 2**31 - 1
"""Slot for "no triangle", above all others."""


class Node(NamedTuple):
    """A decoded node.

    Attributes:
      entry, exit: corners of the box.
      skip: row to visit after the node's subtree.
      leaf: first triangle slot + 1 of a leaf, 0 for an inner node, -1 for the end of the table.
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


def read_row(table: Array, index: Int[Array, ""]) -> Array:
    """Returns a row without the check for negative indices, which would cost half a box test."""
    index = index.astype(jnp.uint32)
    start = (index, jnp.zeros_like(index))
    row = jax.lax.dynamic_slice(table, start, (1, table.shape[1]), allow_negative_indices=False)
    return row[0]
