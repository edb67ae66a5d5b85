"""Builds the packed tree on the host (NumPy only), level by level.

Each level splits all of its large nodes at once by the binned surface area heuristic along the
longest axis of their centroids. At the end the nodes are numbered depth first, which gives the
skip pointers: a node's subtree is a contiguous run.

Source: Wald, On fast Construction of SAH-based Bounding Volume Hierarchies (2007); pbrt-v4,
flattened trees.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from refref_jax.geometry.bvh import BVH, LEAF_SIZE

_BINS = 16


class _Level(NamedTuple):
    """Nodes of one depth. Each covers `order[start:end]`; children index the next level."""

    start: Int[np.ndarray, " nodes"]
    end: Int[np.ndarray, " nodes"]
    child: Int[np.ndarray, " nodes"]
    """Index of the left child in the next level (the right one follows), -1 at leaves."""


def build(
    triangles: Float[np.ndarray, "faces 3 3"],
) -> tuple[BVH, Int[np.ndarray, " slots"]]:
    """Builds the tree of a triangle soup.

    Args:
      triangles: corners, world units, finite. May be empty, degenerate or duplicate.

    Returns:
      The tree, with triangles in leaf order, and for each slot the face it came from (padding
      slots repeat the last face; they belong to no leaf).

    Raises:
      ValueError: if a coordinate is not finite.
    """
    if not np.all(np.isfinite(triangles)):
        raise ValueError(
            "A triangle has a coordinate that is not finite. Clean the mesh before building its "
            "tree."
        )
    faces = len(triangles)
    if faces == 0:
        return _empty(triangles.dtype), np.zeros(LEAF_SIZE, np.int32)
    lower, upper = triangles.min(axis=1), triangles.max(axis=1)
    centroids = 0.5 * lower + 0.5 * upper
    order = np.arange(faces)
    levels = [_Level(np.array([0]), np.array([faces]), np.array([-1]))]
    while (split := np.flatnonzero(levels[-1].end - levels[-1].start > LEAF_SIZE)).size:
        level = levels[-1]
        middle = _split(order, level.start[split], level.end[split], lower, upper, centroids)
        level.child[split] = 2 * np.arange(split.size)
        start = np.stack([level.start[split], middle], axis=1).ravel()
        end = np.stack([middle, level.end[split]], axis=1).ravel()
        levels.append(_Level(start, end, np.full(start.size, -1)))
    slots = np.concatenate([order, np.repeat(order[-1], LEAF_SIZE)])
    return _flatten(levels, lower[order], upper[order], triangles[slots]), slots.astype(np.int32)


def _empty(dtype: np.dtype) -> BVH:
    """Returns a tree of one leaf that holds nothing."""
    return BVH(
        np.zeros((1, 2, 3), dtype),
        np.ones(1, np.int32),
        np.zeros((1, 2), np.int32),
        np.zeros((LEAF_SIZE, 3, 3), dtype),
    )


def _split(
    order: Int[np.ndarray, " faces"],
    start: Int[np.ndarray, " nodes"],
    end: Int[np.ndarray, " nodes"],
    lower: Float[np.ndarray, "faces 3"],
    upper: Float[np.ndarray, "faces 3"],
    centroids: Float[np.ndarray, "faces 3"],
) -> Int[np.ndarray, " nodes"]:
    """Sorts each node's run of `order` by bin, in place; returns where each run splits."""
    counts = end - start
    owner = np.repeat(np.arange(start.size), counts)
    first = np.cumsum(counts) - counts
    positions = np.arange(counts.sum()) - first[owner] + start[owner]
    faces = order[positions]

    centre = centroids[faces]
    low = np.minimum.reduceat(centre, first)
    extent = np.maximum.reduceat(centre, first) - low
    axis = np.argmax(extent, axis=1)
    nodes = np.arange(start.size)
    width = extent[nodes, axis]
    along = centre[np.arange(faces.size), axis[owner]] - low[nodes, axis][owner]
    scaled = along / np.where(width > 0, width, 1.0)[owner]
    bins = np.minimum((scaled * _BINS).astype(np.int64), _BINS - 1)

    key = owner * _BINS + bins
    by_bin = np.argsort(key, kind="stable")
    order[positions] = faces[by_bin]
    left = _best_split(key[by_bin], faces[by_bin], lower, upper, start.size)
    # All centroids in one point: nothing tells the triangles apart, so halve the run.
    return start + np.where(width > 0, left, counts // 2)


def _best_split(
    key: Int[np.ndarray, " sorted"],
    faces: Int[np.ndarray, " sorted"],
    lower: Float[np.ndarray, "faces 3"],
    upper: Float[np.ndarray, "faces 3"],
    nodes: int,
) -> Int[np.ndarray, " nodes"]:
    """Returns how many triangles go left of the cheapest plane between bins.

    The cost of a plane is `area(left) count(left) + area(right) count(right)`. In a node with
    extent the first and the last bin are never empty, so every plane has triangles on both
    sides; in one without, all triangles are in the first bin and the result has no meaning.
    """
    counts = np.bincount(key, minlength=nodes * _BINS)
    filled = np.flatnonzero(counts)
    first = np.cumsum(counts[filled]) - counts[filled]
    low = np.full((nodes * _BINS, 3), np.inf)
    high = np.full((nodes * _BINS, 3), -np.inf)
    low[filled] = np.minimum.reduceat(lower[faces], first)
    high[filled] = np.maximum.reduceat(upper[faces], first)
    low, high = low.reshape(nodes, _BINS, 3), high.reshape(nodes, _BINS, 3)
    counts = counts.reshape(nodes, _BINS)

    area_left = _sweep_areas(low, high)[:, :-1]
    area_right = _sweep_areas(low[:, ::-1], high[:, ::-1])[:, -2::-1]
    count_left = np.cumsum(counts, axis=1)[:, :-1]
    count_right = counts.sum(axis=1, keepdims=True) - count_left
    cost = area_left * count_left + area_right * count_right
    return count_left[np.arange(nodes), np.argmin(cost, axis=1)]


def _sweep_areas(
    low: Float[np.ndarray, "nodes bins 3"], high: Float[np.ndarray, "nodes bins 3"]
) -> Float[np.ndarray, "nodes bins"]:
    """Returns half the surface area of the box around bins `0..i`, for every `i`; 0 if empty."""
    extent = np.maximum.accumulate(high, axis=1) - np.minimum.accumulate(low, axis=1)
    x, y, z = np.moveaxis(np.maximum(extent, 0.0), -1, 0)
    return x * y + y * z + z * x


def _flatten(
    levels: list[_Level],
    lower: Float[np.ndarray, "faces 3"],
    upper: Float[np.ndarray, "faces 3"],
    triangles: Float[np.ndarray, "slots 3 3"],
) -> BVH:
    """Numbers the nodes depth first and packs them; bounds are given in leaf order."""
    sizes = _subtree_sizes(levels)
    nodes = sizes[0][0]
    boxes = np.empty((nodes, 2, 3), triangles.dtype)
    skips = np.empty(nodes, np.int32)
    leaves = np.zeros((nodes, 2), np.int32)
    index = np.zeros(1, np.int64)
    for level, size, next_size in zip(levels, sizes, [*sizes[1:], None], strict=True):
        boxes[index, 0] = _reduce_runs(np.minimum, lower, level)
        boxes[index, 1] = _reduce_runs(np.maximum, upper, level)
        skips[index] = index + size
        is_leaf = level.child < 0
        leaves[index[is_leaf], 0] = level.start[is_leaf]
        leaves[index[is_leaf], 1] = (level.end - level.start)[is_leaf]
        if next_size is not None:
            left = index[~is_leaf] + 1
            right = left + next_size[level.child[~is_leaf]]
            index = np.stack([left, right], axis=1).ravel()
    return BVH(boxes, skips, leaves, triangles)


def _subtree_sizes(levels: list[_Level]) -> list[Int[np.ndarray, " nodes"]]:
    """Returns the number of nodes in each node's subtree, itself included."""
    sizes = [np.ones(levels[-1].start.size, np.int64)]
    for level in reversed(levels[:-1]):
        size = np.ones(level.start.size, np.int64)
        inner = level.child >= 0
        size[inner] += sizes[0][level.child[inner]] + sizes[0][level.child[inner] + 1]
        sizes.insert(0, size)
    return sizes


def _reduce_runs(
    function: np.ufunc, values: Float[np.ndarray, "faces 3"], level: _Level
) -> Float[np.ndarray, "nodes 3"]:
    """Reduces the rows of each node's run; runs are not empty and do not overlap."""
    # reduceat takes pairs (start, end); a sentinel row keeps the last end in range.
    padded = np.concatenate([values, values[-1:]])
    edges = np.stack([level.start, level.end], axis=1).ravel()
    return function.reduceat(padded, edges)[::2]
