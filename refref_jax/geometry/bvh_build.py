"""Builds the packed BVH on the host (NumPy only), level by level.

Each level splits all of its large nodes at once, at the minimum of the surface area heuristic over
all positions between two centroids along each of the three axes. The centroids are sorted once;
every split preserves the three orders.

Source: Wald, On fast Construction of SAH-based Bounding Volume Hierarchies (2007), without bins.
"""

import numpy as np
from jaxtyping import Float, Int

from refref_jax.geometry import node_build
from refref_jax.geometry.bvh import BVH, LEAF_SIZE
from refref_jax.geometry.node_build import Level
from refref_jax.geometry.sweep import best_splits


def build(
    triangles: Float[np.ndarray, "faces 3 3"],
) -> tuple[BVH, Int[np.ndarray, " slots"]]:
    """Builds the tree of a triangle soup.

    Args:
      triangles: corners, world units, finite. May be empty, degenerate or duplicate.

    Returns:
      The tree, with triangles in leaf order, and the face of each slot (padding slots repeat the
      last face and are never hit).

    Raises:
      ValueError: if a coordinate is not finite.
    """
    if not np.all(np.isfinite(triangles)):
        raise ValueError(
            "A triangle has a coordinate that is not finite. Clean the mesh before building its "
            "tree."
        )
    if len(triangles) == 0:
        return _empty(triangles.dtype), np.zeros(LEAF_SIZE, np.int32)
    lower, upper = triangles.min(axis=1), triangles.max(axis=1)
    levels, order = _split_all(lower, upper)
    slots = np.concatenate([order, np.repeat(order[-1], LEAF_SIZE)])
    nodes = node_build.pack_nodes(levels, lower[order], upper[order])
    facets = node_build.prepare_facets(triangles[slots])
    facets[len(order) :] = 0.0
    return BVH(nodes, triangles[slots], facets), slots.astype(np.int32)


def _empty(dtype: np.dtype) -> BVH:
    """Returns a tree of one empty leaf."""
    point = np.zeros((1, 3), dtype)
    level = Level(np.array([0]), np.array([1]), np.array([-1]))
    nodes = node_build.pack_nodes([level], point, point)
    return BVH(
        nodes,
        np.zeros((LEAF_SIZE, 3, 3), dtype),
        node_build.prepare_facets(np.zeros((LEAF_SIZE, 3, 3), dtype)),
    )


def _split_all(
    lower: Float[np.ndarray, "faces 3"], upper: Float[np.ndarray, "faces 3"]
) -> tuple[list[Level], Int[np.ndarray, " faces"]]:
    """Splits until every node fits in a leaf; returns the levels and the faces in leaf order."""
    centroids = 0.5 * lower + 0.5 * upper
    scene = lower.min(axis=0).astype(np.float64), upper.max(axis=0).astype(np.float64)
    orders = [np.argsort(centroids[:, axis], kind="stable") for axis in range(3)]
    final = np.empty(len(lower), np.int64)
    level = Level(np.array([0]), np.array([len(lower)]), np.array([-1]))
    levels = [level]
    while True:
        counts = level.end - level.start
        positions = node_build.runs(level.start, counts)
        small = np.repeat(counts <= LEAF_SIZE, counts)
        final[positions[small]] = orders[0][small]
        split = np.flatnonzero(counts > LEAF_SIZE)
        if split.size == 0:
            return levels, final
        orders = [order[~small] for order in orders]
        left, axis = best_splits(orders, counts[split], lower, upper, scene)
        orders = _partition(orders, counts[split], left, axis)
        level.child[split] = 2 * np.arange(split.size)
        middle = level.start[split] + left
        start = np.stack([level.start[split], middle], axis=1).ravel()
        end = np.stack([middle, level.end[split]], axis=1).ravel()
        level = Level(start, end, np.full(start.size, -1))
        levels.append(level)


def _partition(
    orders: list[Int[np.ndarray, " faces"]],
    counts: Int[np.ndarray, " nodes"],
    left: Int[np.ndarray, " nodes"],
    axis: Int[np.ndarray, " nodes"],
) -> list[Int[np.ndarray, " faces"]]:
    """Moves the faces of each left child before those of its right sibling, in all three orders.

    Args:
      orders: faces sorted by centroid along each axis, node after node.
      counts: number of faces of each node.
      left: number of faces that go left.
      axis: split axis of each node; the first `left` faces in its order go left.
    """
    first = np.cumsum(counts) - counts
    owner = np.repeat(np.arange(counts.size), counts)
    right_in_order = np.arange(owner.size) - first[owner] >= left[owner]
    goes_right = np.zeros(max(order.max() for order in orders) + 1, bool)
    for direction, order in enumerate(orders):
        chosen = axis[owner] == direction
        goes_right[order[chosen]] = right_in_order[chosen]
    moved = []
    for order in orders:
        right = goes_right[order]
        rank = np.cumsum(~right)
        rank_left = rank - (rank[first] - ~right[first])[owner] - 1
        rank_right = np.arange(owner.size) - first[owner] - rank_left - 1
        place = first[owner] + np.where(right, left[owner] + rank_right, rank_left)
        new = np.empty_like(order)
        new[place] = order
        moved.append(new)
    return moved
