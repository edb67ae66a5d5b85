"""Builds the packed BVH on the host (NumPy only), level by level.

Each level splits all of its large nodes at once, at the minimum of the surface area heuristic over
all positions between two centroids along each of the three axes. The centroids are sorted once;
every split preserves the three orders. The nodes are then packed into the tables of `bvh_nodes`.

A split sends the first `n` faces of a node, in the order of their centroids along an axis, to the
left. Its cost is `area(left) leaves(left) + area(right) leaves(right)`. It counts the leaves that a
side fills instead of its faces, because all triangles of a leaf are tested.

Source: Wald, On fast Construction of SAH-based Bounding Volume Hierarchies (2007), without bins.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from refref_jax.geometry import bvh_nodes
from refref_jax.geometry.bvh import BVH, LEAF_SIZE
from refref_jax.numerics import host_array

# Sign bit of each axis in the number of an octant, as in `bvh_nodes.octant`.
_BACKWARDS = ((np.arange(bvh_nodes.OCTANTS)[:, None] >> np.arange(3)) & 1).astype(bool)


def best_splits(
    orders: list[Int[np.ndarray, " faces"]],
    counts: Int[np.ndarray, " nodes"],
    lower: Float[np.ndarray, "all 3"],
    upper: Float[np.ndarray, "all 3"],
    scene: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]],
) -> tuple[Int[np.ndarray, " nodes"], Int[np.ndarray, " nodes"]]:
    """Finds the cheapest split of each node.

    Args:
      orders: faces sorted by centroid along each axis, node after node.
      counts: number of faces of each node, at least two.
      lower: lower corner of every face's box.
      upper: upper corner of every face's box.
      scene: lower and upper corner of the box around all faces, in double precision.

    Returns:
      The number of faces that go left, and the split axis. Of equally cheap splits along an axis,
      the one nearest to the middle is taken.
    """
    first = np.cumsum(counts) - counts
    owner = np.repeat(np.arange(counts.size), counts)
    taken = np.arange(owner.size) - first[owner] + 1
    remaining = counts[owner] - taken
    leaves_left, leaves_right = -(-taken // LEAF_SIZE), -(-remaining // LEAF_SIZE)
    cheapest = np.full(counts.size, np.inf)
    left, axis = np.zeros_like(counts), np.zeros_like(counts)
    for direction, order in enumerate(orders):
        area_left, area_right = _areas(lower[order], upper[order], owner, scene)
        cost = area_left * leaves_left
        cost[:-1] += area_right[1:] * leaves_right[:-1]
        cost[remaining == 0] = np.inf
        lowest = np.minimum.reduceat(cost, first)
        tied = np.flatnonzero(cost <= lowest[owner] * (1 + 1e-9))
        off_middle = np.abs(taken[tied] - remaining[tied])
        nearest = tied[np.lexsort((off_middle, owner[tied]))]
        _, index = np.unique(owner[nearest], return_index=True)
        better = lowest < cheapest
        cheapest = np.where(better, lowest, cheapest)
        left = np.where(better, taken[nearest[index]], left)
        axis = np.where(better, direction, axis)
    return left, axis


def _areas(
    lower: Float[np.ndarray, "faces 3"],
    upper: Float[np.ndarray, "faces 3"],
    owner: Int[np.ndarray, " faces"],
    scene: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]],
) -> tuple[Float[np.ndarray, " faces"], Float[np.ndarray, " faces"]]:
    """Returns half the areas of two boxes per face: around its node's faces up to it, and from it.

    Both include the face itself.
    """
    before, after = [], []
    for axis in range(3):
        base, top = scene[0][axis], scene[1][axis]
        span = top - base
        high, low = upper[:, axis] - base, top - lower[:, axis]
        before.append(_running(high, owner, span) + _running(low, owner, span) - span)
        back = owner[-1] - owner[::-1]
        from_end = _running(high[::-1], back, span) + _running(low[::-1], back, span) - span
        after.append(from_end[::-1])
    return _half_area(*before), _half_area(*after)


def _running(
    values: Float[np.ndarray, " faces"], owner: Int[np.ndarray, " faces"], span: float
) -> Float[np.ndarray, " faces"]:
    """Returns the running maximum within each owner's range; values are in `[0, span]`.

    Each owner's values are offset above those of the previous owner, so that one accumulation
    serves all. In double precision this costs `owners * span` units in the last place, which is
    negligible.
    """
    storey = owner * (2.0 * span)
    return np.maximum.accumulate(values + storey) - storey


def _half_area(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    return x * y + y * z + z * x


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
    tables = np.zeros((bvh_nodes.OCTANTS, rows, bvh_nodes.WORDS), np.int32)
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
    """Precomputes triangles for `rays.facet_distance`, in the precision of the input."""
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
    """Returns which nodes have a right child that is nearer than the left one in an octant."""
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


def build(
    triangles: Float[np.ndarray, "faces 3 3"],
) -> tuple[BVH, Int[np.ndarray, " primitives"]]:
    """Builds the tree of a triangle soup.

    Args:
      triangles: corners, world units, finite. May be empty, degenerate or duplicate.

    Returns:
      The tree, with triangles in leaf order, and the face of each primitive (the padding repeats
      the last face, and is never hit).

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
    primitive_ids = np.concatenate([order, np.repeat(order[-1], LEAF_SIZE)])
    nodes = pack_nodes(levels, lower[order], upper[order])
    facets = prepare_facets(triangles[primitive_ids])
    facets[len(order) :] = 0.0
    bvh = BVH(host_array(nodes), host_array(triangles[primitive_ids]), host_array(facets))
    return bvh, primitive_ids.astype(np.int32)


def filled_up(bvh: BVH) -> BVH:
    """Returns the same tree with rows that are never read, up to round numbers.

    The trees of a mesh that moves differ in size: with round numbers, programs that were compiled
    for one of them serve all.
    """
    tables, rows = _filled(np.asarray(bvh.nodes), axis=1), bvh.nodes.shape[1]
    octants = np.arange(bvh_nodes.OCTANTS, dtype=np.int32)[:, None]
    # Skip pointers count the rows of all tables. Walks that end at the last row pass the spare
    # ones.
    tables[:, : rows - 1, 6] += octants * (tables.shape[1] - rows)
    tables[:, rows - 1 :, 6] = (octants + 1) * tables.shape[1] - 1
    triangles, facets = (_filled(np.asarray(each)) for each in (bvh.triangles, bvh.facets))
    return BVH(host_array(tables), host_array(triangles), host_array(facets))


def _filled(rows: np.ndarray, axis: int = 0) -> np.ndarray:
    """Repeats the last row up to a round number of rows; that of a node table marks its end."""
    count = rows.shape[axis]
    last = np.take(rows, [count - 1] * spare_rows(count), axis=axis)
    return np.concatenate([rows, last], axis=axis)


def spare_rows(count: int) -> int:
    """Returns how many rows `filled_up` adds to some."""
    return -count % max(256, 1 << max(count.bit_length() - 3, 0))


def _empty(dtype: np.dtype) -> BVH:
    """Returns a tree of one empty leaf."""
    point = np.zeros((1, 3), dtype)
    level = Level(np.array([0]), np.array([1]), np.array([-1]))
    nodes = pack_nodes([level], point, point)
    return BVH(
        host_array(nodes),
        host_array(np.zeros((LEAF_SIZE, 3, 3), dtype)),
        host_array(prepare_facets(np.zeros((LEAF_SIZE, 3, 3), dtype))),
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
        positions = runs(level.start, counts)
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
