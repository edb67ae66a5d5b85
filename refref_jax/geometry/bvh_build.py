"""Builds the packed BVH on the host (NumPy only), level by level.

Each level splits all of its large nodes at once, at the minimum of the surface area heuristic over
all positions between two centroids along each of the three axes. The centroids are sorted once;
every split preserves the three orders. The nodes are then packed into the tables of `bvh`.

A split sends the first `n` faces of a node, in the order of their centroids along an axis, to the
left. Its cost is `area(left) leaves(left) + area(right) leaves(right)`. It counts the leaves that a
side fills instead of its faces, because all triangles of a leaf are tested.

Source: Wald, On fast Construction of SAH-based Bounding Volume Hierarchies (2007), without bins.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from refref_jax.geometry.bvh import BVH, LEAF_SIZE, OCTANTS, WORDS
from refref_jax.numerics import host_array

# Sign bit of each axis in the number of an octant, as in `bvh.octant`.
_BACKWARDS = ((np.arange(OCTANTS)[:, None] >> np.arange(3)) & 1).astype(bool)

# Relative difference of costs that count as equal: rounding must not choose between them.
_TIE = 1e-9

# Rows of the tables of small meshes after they are filled up, and the fewest of larger meshes.
_FEW_ROWS, _MANY_ROWS = 4096, 1 << 17


class _Grid(NamedTuple):
    """Places of a level's faces, in columns of equal length; a node fills as many as it needs.

    Running bounds are then computed for all columns at once. What a node does not fill repeats its
    last face.

    Attributes:
      places: place of each face in the orders.
      taken: number of the node's faces up to and including this one, more than it has in the rest.
      owner: node of each column.
      first: first column of each node.
    """

    places: Int[np.ndarray, "rows columns"]
    taken: Int[np.ndarray, "rows columns"]
    owner: Int[np.ndarray, " columns"]
    first: Int[np.ndarray, " nodes"]


def _grid(counts: Int[np.ndarray, " nodes"]) -> _Grid:
    """Returns columns of 8 to 64 places for nodes of some numbers of faces."""
    rows = int(np.clip(1 << int(np.mean(counts) / 2).bit_length(), 8, 64))
    columns = -(-counts // rows)
    owner = np.repeat(np.arange(counts.size, dtype=np.int32), columns)
    first = np.cumsum(columns, dtype=np.int32) - columns
    above = rows * (np.arange(owner.size, dtype=np.int32) - first[owner])
    taken = np.arange(1, rows + 1, dtype=np.int32)[:, None] + above
    start = np.cumsum(counts, dtype=np.int32) - counts
    return _Grid(np.minimum(taken, counts[owner]) + (start[owner] - 1), taken, owner, first)


def best_splits(
    orders: list[Int[np.ndarray, " faces"]],
    counts: Int[np.ndarray, " nodes"],
    reach: Float[np.ndarray, "6 all"],
) -> tuple[Int[np.ndarray, " nodes"], Int[np.ndarray, " nodes"]]:
    """Finds the cheapest split of each node.

    Args:
      orders: faces sorted by centroid along each axis, node after node.
      counts: number of faces of each node, at least two.
      reach: upper corner of every face's box, then its lower corner with the sign changed.

    Returns:
      The number of faces that go left, and the split axis. Of equally cheap splits along an axis,
      the one nearest to the middle is taken; of equally cheap axes, the first.
    """
    grid = _grid(counts)
    of_node = counts[grid.owner]
    remaining = of_node - grid.taken
    leaves_left = (-(-grid.taken // LEAF_SIZE)).astype(np.float64)
    leaves_right = (-(-remaining // LEAF_SIZE)).astype(np.float64)
    is_last = remaining <= 0
    cheapest = np.full(counts.size, np.inf)
    axis = np.zeros_like(counts)
    best = np.full(grid.places.shape, np.inf)
    space = _Space.of(grid.places.shape, reach.dtype)
    for direction, order in enumerate(orders):
        np.take(reach, order[grid.places], axis=1, out=space.before, mode="clip")
        left, right = _areas(space, grid.owner)
        left *= leaves_left
        right *= leaves_right
        cost = np.add(left, right, out=left)
        cost[is_last] = np.inf
        lowest = np.minimum.reduceat(cost.min(axis=0), grid.first)
        better = lowest < cheapest * (1 - _TIE)
        cheapest = np.where(better, lowest, cheapest)
        axis = np.where(better, direction, axis)
        np.copyto(best, cost, where=better[grid.owner])
    off_middle = grid.taken - remaining
    rank = 2 * np.abs(off_middle) + (off_middle > 0)
    tied = best <= (cheapest * (1 + _TIE))[grid.owner]
    nearest = np.where(tied, rank, np.iinfo(rank.dtype).max).min(axis=0)
    nearest = np.minimum.reduceat(nearest, grid.first)
    off_middle = np.where(nearest & 1, nearest >> 1, -(nearest >> 1))
    return (counts + off_middle) >> 1, axis


class _Space(NamedTuple):
    """Memory for the bounds of a level, since fresh pages would cost half of its time.

    Attributes:
      before: `reach` of the faces at the grid's places, then of all up to each.
      after: `reach` of all faces after each.
      sizes: extents of the boxes along the axes.
      areas: half the areas of the boxes, of `before` and of `after`.
    """

    before: Float[np.ndarray, "6 rows columns"]
    after: Float[np.ndarray, "6 rows columns"]
    sizes: Float[np.ndarray, "3 rows columns"]
    areas: Float[np.ndarray, "2 rows columns"]

    @classmethod
    def of(cls, shape: tuple[int, int], kind: np.dtype) -> "_Space":
        """Returns memory for a grid of some rows and columns."""
        before, after = np.empty((2, 6, *shape), kind)
        return cls(before, after, np.empty((3, *shape)), np.empty((2, *shape)))


def _areas(
    space: _Space, owner: Int[np.ndarray, " columns"]
) -> Float[np.ndarray, "2 rows columns"]:
    """Returns half the areas of two boxes per face, in double precision.

    The first is around its node's faces up to it, and the second around those after it.
    """
    before, after, sizes, areas = space
    most, rows = before.max(axis=1), before.shape[1]
    after[:, -1] = _most_before(most[:, ::-1], owner[::-1], before[:, -1, ::-1])[:, ::-1]
    for row in range(rows - 2, -1, -1):
        np.maximum(before[:, row + 1], after[:, row + 1], out=after[:, row])
    before[:, 0] = np.maximum(before[:, 0], _most_before(most, owner, before[:, 0]))
    for row in range(1, rows):
        np.maximum(before[:, row - 1], before[:, row], out=before[:, row])
    for reach, area in zip((before, after), areas, strict=True):
        x, y, z = np.add(reach[:3], reach[3:], out=sizes, dtype=np.float64)
        np.add(y, z, out=area)
        area *= x
        y *= z
        area += y
    return areas


def _most_before(
    most: Float[np.ndarray, "6 columns"],
    owner: Int[np.ndarray, " columns"],
    otherwise: Float[np.ndarray, "6 columns"],
) -> Float[np.ndarray, "6 columns"]:
    """Returns the maximum over all previous columns of the same node, or a value if there are none.

    The distance over which maxima are combined doubles until it exceeds the largest node.
    """
    found = np.where(np.append(False, owner[1:] == owner[:-1]), np.roll(most, 1, axis=1), otherwise)
    distance = 1
    while distance < owner.size:
        same = owner[distance:] == owner[:-distance]
        if not same.any():
            break
        earlier = np.where(same, found[:, :-distance], found[:, distance:])
        found[:, distance:] = np.maximum(found[:, distance:], earlier)
        distance *= 2
    return found


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
    tables = np.zeros((OCTANTS, rows, WORDS), np.int32)
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


class Division(NamedTuple):
    """How faces are divided among the nodes of a tree.

    Attributes:
      levels: levels of the tree, from the root down.
      order: faces in leaf order.
    """

    levels: list[Level]
    order: Int[np.ndarray, " faces"]


def divide(triangles: Float[np.ndarray, "faces 3 3"]) -> Division:
    """Divides the faces of a triangle soup, of at least one, among the nodes of a tree."""
    return Division(*_split_all(triangles.min(axis=1), triangles.max(axis=1)))


def build(
    triangles: Float[np.ndarray, "faces 3 3"], *, division: Division | None = None
) -> tuple[BVH, Int[np.ndarray, " primitives"]]:
    """Builds the tree of a triangle soup.

    Args:
      triangles: corners, world units, finite. May be empty, degenerate or duplicate.
      division: division of the same faces at other places, such as those of a mesh that has moved
        a little since. It takes most of the time, and is found by default.

    Returns:
      The tree, with triangles in leaf order, and the face of each primitive (the padding repeats
      the last face, and is never hit).

    Raises:
      ValueError: if a coordinate is not finite, or the division is one of more or fewer faces.
    """
    if not np.all(np.isfinite(triangles)):
        raise ValueError(
            "A triangle has a coordinate that is not finite. Clean the mesh before building its "
            "tree."
        )
    if len(triangles) == 0:
        return _empty(triangles.dtype), np.zeros(LEAF_SIZE, np.int32)
    lower, upper = triangles.min(axis=1), triangles.max(axis=1)
    levels, order = division or divide(triangles)
    if len(order) != len(triangles):
        raise ValueError(
            f"The division has {len(order)} faces, the mesh {len(triangles)}. Pass the division of "
            "the same faces, or none."
        )
    primitive_ids = np.concatenate([order, np.repeat(order[-1], LEAF_SIZE)])
    nodes = pack_nodes(levels, lower[order], upper[order])
    facets = prepare_facets(triangles[primitive_ids])
    facets[len(order) :] = 0.0
    bvh = BVH(host_array(nodes), host_array(triangles[primitive_ids]), host_array(facets))
    return bvh, primitive_ids.astype(np.int32)


def filled_up(bvh: BVH) -> BVH:
    """Returns the same tree with rows that are never read, up to a few sizes (`spare_rows`).

    Trees of similar meshes differ in size. With few sizes, a program that was compiled for one of
    them serves the others; compiling takes longer than several steps of a fit.
    """
    tables, rows = _filled(np.asarray(bvh.nodes), axis=1), bvh.nodes.shape[1]
    octants = np.arange(OCTANTS, dtype=np.int32)[:, None]
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
    """Returns how many rows `filled_up` adds, to reach 4096, 131,072 or a power of two above.

    The families and vessels that are fitted to an object have tens of thousands of faces, as its
    mesh from masks has: one program serves them all.
    """
    few = count <= _FEW_ROWS
    return (_FEW_ROWS if few else max(_MANY_ROWS, 1 << (count - 1).bit_length())) - count


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
    lower: Float[np.ndarray, "faces 3"],
    upper: Float[np.ndarray, "faces 3"],
) -> tuple[list[Level], Int[np.ndarray, " faces"]]:
    """Splits until every node fits in a leaf; returns the levels and the faces in leaf order."""
    centroids = 0.5 * lower + 0.5 * upper
    reach = np.ascontiguousarray(np.concatenate([upper, -lower], axis=1).T)
    orders = [np.argsort(along, kind="stable").astype(np.int32) for along in centroids.T]
    final = np.empty(len(lower), np.int32)
    level = Level(*np.array([[0], [len(lower)], [-1]], np.int32))
    levels = [level]
    while True:
        counts = level.end - level.start
        large = counts > LEAF_SIZE
        if not large.all():
            kept = np.repeat(large, counts)
            final[runs(level.start[~large], counts[~large])] = orders[0][~kept]
            orders = [order[kept] for order in orders]
        if not large.any():
            return levels, final
        split = np.flatnonzero(large)
        left, axis = best_splits(orders, counts[split], reach)
        orders = _partition(orders, counts[split], left, axis)
        level.child[split] = 2 * np.arange(split.size)
        middle = level.start[split] + left
        start = np.stack([level.start[split], middle], axis=1).ravel()
        end = np.stack([middle, level.end[split]], axis=1).ravel()
        level = Level(start, end, np.full_like(start, -1))
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
    sides = np.tile(np.array([False, True]), counts.size)
    is_right = np.repeat(sides, np.stack([left, counts - left], axis=1).ravel())
    goes_right = np.zeros(max(order.max() for order in orders) + 1, bool)
    goes_right[np.choose(np.repeat(axis, counts), orders)] = is_right
    lefts, rights = np.flatnonzero(~is_right), np.flatnonzero(is_right)
    moved = []
    for order in orders:
        right = goes_right[order]
        new = np.empty_like(order)
        new[lefts], new[rights] = order[~right], order[right]
        moved.append(new)
    return moved
