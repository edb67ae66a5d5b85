"""Surface area heuristic for all splits of all nodes of a level (NumPy only).

A split sends the first `n` faces of a node, in the order of their centroids along an axis, to the
left. Its cost is `area(left) leaves(left) + area(right) leaves(right)`. It counts the leaves that a
side fills instead of its faces, because all slots of a leaf are tested.
"""

import numpy as np
from jaxtyping import Float, Int

from refref_jax.geometry.bvh import LEAF_SIZE


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
    """Returns half the areas of the boxes around each node's faces up to, and from, every face."""
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
