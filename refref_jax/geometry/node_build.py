"""Packs the nodes of a BVH into the tables of `node_table`, on the host (NumPy only)."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from refref_jax.geometry import node_table


class Level(NamedTuple):
    """Nodes of one depth. Each covers the faces `start:end` in leaf order.

    Attributes:
      start, end: range of faces.
      child: index of the left child in the next level (the right child follows), -1 for leaves.
    """

    start: Int[np.ndarray, " nodes"]
    end: Int[np.ndarray, " nodes"]
    child: Int[np.ndarray, " nodes"]


class _Boxes(NamedTuple):
    """Bounds of a level's nodes."""

    lower: Float[np.ndarray, "nodes 3"]
    upper: Float[np.ndarray, "nodes 3"]


# Sign bit of each axis in the number of an octant, as in `boxes.octant`.
_BACKWARDS = ((np.arange(node_table.OCTANTS)[:, None] >> np.arange(3)) & 1).astype(bool)


def pack_nodes(
    levels: list[Level],
    lower: Float[np.ndarray, "faces 3"],
    upper: Float[np.ndarray, "faces 3"],
) -> Int[np.ndarray, "8 nodes 8"]:
    """Numbers the nodes depth first, once for each octant, and packs them.

    Boxes are widened by one unit in the last place of the scene's largest coordinate, so that a
    ray that lies in the face of a box does not miss it.

    Args:
      levels: levels of the tree, from the root down.
      lower: lower corners of the faces' boxes, in leaf order.
      upper: upper corners of the faces' boxes.
    """
    sizes, bounds = _subtree_sizes(levels), _bounds(levels, lower, upper)
    margin = np.spacing(np.float32(max(np.abs(lower).max(), np.abs(upper).max())))
    rows = sizes[0][0] + 1
    tables = np.zeros((node_table.OCTANTS, rows, node_table.WORDS), np.int32)
    for octant, backwards in enumerate(_BACKWARDS):
        index = np.zeros(1, np.int64)
        for depth, (level, size, (low, high)) in enumerate(zip(levels, sizes, bounds, strict=True)):
            words = tables[octant]
            _write_boxes(words, index, low - margin, high + margin, backwards)
            words[index, 6] = index + size + octant * rows
            words[index, 7] = np.where(level.child < 0, level.start + 1, 0)
            inner = np.flatnonzero(level.child >= 0)
            if inner.size:
                left = level.child[inner]
                swapped = _right_is_nearer(bounds[depth + 1], left, backwards)
                next_size = sizes[depth + 1]
                one = index[inner] + 1
                first = np.where(swapped, one + next_size[left + 1], one)
                second = np.where(swapped, one, one + next_size[left])
                index = np.stack([first, second], axis=1).ravel()
    tables[:, -1, 7] = -1
    return tables


def prepare_facets(triangles: Float[np.ndarray, "faces 3 3"]) -> Float[np.ndarray, "faces 12"]:
    """Precomputes triangles for `facets.distance`, in the precision of the input."""
    a, b, c = np.moveaxis(triangles.astype(np.float64), 1, 0)
    normal = np.cross(b - a, c - a)
    return np.concatenate([a, b - a, a - c, normal], axis=-1).astype(triangles.dtype)


def runs(
    start: Int[np.ndarray, " nodes"], counts: Int[np.ndarray, " nodes"]
) -> Int[np.ndarray, " faces"]:
    """Returns the concatenated ranges `start, start + 1, ...` of `counts` numbers per node."""
    first = np.cumsum(counts) - counts
    return np.arange(counts.sum()) + np.repeat(start - first, counts)


def _write_boxes(
    words: Int[np.ndarray, "rows 8"],
    index: Int[np.ndarray, " nodes"],
    lower: Float[np.ndarray, "nodes 3"],
    upper: Float[np.ndarray, "nodes 3"],
    backwards: Bool[np.ndarray, "3"],
) -> None:
    """Writes entry and exit corners, rounded outwards."""
    numbers = words.view(np.float32)
    numbers[index, 0:3] = np.where(backwards, upper, lower)
    numbers[index, 3:6] = np.where(backwards, lower, upper)


def _right_is_nearer(
    below: _Boxes, left: Int[np.ndarray, " nodes"], backwards: Bool[np.ndarray, "3"]
) -> Bool[np.ndarray, " nodes"]:
    """Returns the nodes whose right child comes before the left along the octant's diagonal."""
    diagonal = np.where(backwards, -1.0, 1.0)
    middle = (below.lower + below.upper) @ diagonal
    return middle[left + 1] < middle[left]


def _subtree_sizes(levels: list[Level]) -> list[Int[np.ndarray, " nodes"]]:
    """Returns the number of nodes in each node's subtree, including the node."""
    sizes = [np.ones(levels[-1].start.size, np.int64)]
    for level in reversed(levels[:-1]):
        size = np.ones(level.start.size, np.int64)
        inner = level.child >= 0
        size[inner] += sizes[0][level.child[inner]] + sizes[0][level.child[inner] + 1]
        sizes.insert(0, size)
    return sizes


def _bounds(
    levels: list[Level], lower: Float[np.ndarray, "faces 3"], upper: Float[np.ndarray, "faces 3"]
) -> list[_Boxes]:
    """Returns the boxes of each level's nodes, from the leaves up."""
    # reduceat takes (start, end) pairs; a sentinel row keeps the last end in range.
    lower, upper = np.concatenate([lower, lower[-1:]]), np.concatenate([upper, upper[-1:]])
    found: list[_Boxes] = []
    for level in reversed(levels):
        low, high = np.empty((2, level.start.size, 3), lower.dtype)
        leaf = level.child < 0
        edges = np.stack([level.start[leaf], level.end[leaf]], axis=1).ravel()
        if edges.size:
            low[leaf] = np.minimum.reduceat(lower, edges)[::2]
            high[leaf] = np.maximum.reduceat(upper, edges)[::2]
        if not leaf.all():
            left = level.child[~leaf]
            low[~leaf] = np.minimum(found[0].lower[left], found[0].lower[left + 1])
            high[~leaf] = np.maximum(found[0].upper[left], found[0].upper[left + 1])
        found.insert(0, _Boxes(low, high))
    return found
