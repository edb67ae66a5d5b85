"""How the nodes of a tree lie in memory, and how they are read on the device.

A node is one row of eight 32-bit words, so that one visit is one contiguous load: the entry corner
of its box (three floats, by their bits), the exit corner, the *skip pointer* and the leaf.

There are eight tables, one an octant of directions, each depth first with the nearer child of
every node before the farther. The skip pointer is the row to visit next when the box is missed;
when it is hit, the next row is simply the following one. So a walk needs no stack: its whole state
is one row. All tables share the triangles.

The last row of a table is its end, which has no box and a leaf below zero.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

OCTANTS = 8

WORDS = 8
"""Words of a node."""

LEAF_SIZE = 4
"""Most triangles a leaf may hold: the number tested at each leaf visit."""

NONE = 2**31 - 1
"""The slot of no triangle, above all others."""


class Node(NamedTuple):
    """A node as it is read.

    Attributes:
      entry, exit: corners of the box.
      skip: the row to visit after the node's whole subtree.
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
    """Returns a row without a check for a negative index, which would cost half a box test."""
    index = index.astype(jnp.uint32)
    start = (index, jnp.zeros_like(index))
    row = jax.lax.dynamic_slice(table, start, (1, table.shape[1]), allow_negative_indices=False)
    return row[0]
