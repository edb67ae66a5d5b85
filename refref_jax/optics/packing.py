"""Packs the paths of many batches into lists of equal length.

A batch keeps its strongest paths, in the order of its rays, the heaviest path of each ray first. If
the batches together exceed the total capacity, the weakest paths of all batches are dropped first,
because the cost of sorting depends on the number of slots.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from refref_jax.optics import path_tree, pools
from refref_jax.optics.path_tree import Ends, PathTree

# Index past the end of any list: writes to it are dropped.
_NOWHERE = 2**31 - 1


def pack(
    tree: PathTree, batches: int, rays: int, capacity: int
) -> tuple[Ends, Float[Array, "all_rays 3"]]:
    """Sorts paths into one list per batch.

    Args:
      tree: paths of all batches.
      batches: number of batches.
      rays: number of rays in each batch.
      capacity: capacity for the paths of each batch.

    Returns:
      The concatenated lists, and the throughput dropped so far for each ray.
    """
    room = min(batches * capacity, tree.ends.items.rays.shape[0])
    pool, lost = pools.shed(tree.ends, tree.lost, room)
    ends = path_tree.listed(tree._replace(ends=pool), room)
    weight = jnp.max(ends.weights, axis=-1)
    # The slots past the last path form a batch of their own.
    lanes = jnp.arange(room, dtype=jnp.int32)
    batch = jnp.where(lanes < pool.count, ends.rays // rays, batches)
    fits = _strongest_of_each(batch, weight, batches, capacity)
    order = jnp.lexsort((-weight, jnp.where(fits, ends.rays, batches * rays))).astype(jnp.int32)
    group = jnp.where(fits, batch, batches)[order]
    target = jnp.where(fits[order], group * capacity + _rank_in_group(group, batches), _NOWHERE)
    source = jnp.full(batches * capacity, room, jnp.int32).at[target].set(order, mode="drop")
    packed = jax.tree.map(lambda x: x[jnp.minimum(source, room - 1)], ends)
    home = jnp.repeat(jnp.arange(batches, dtype=jnp.int32) * rays, capacity)
    lost = pools.lose(lost, ends.rays, ends.weights, ~fits)
    return path_tree.emptied(packed, source == room, home), lost


def _strongest_of_each(
    batch: Int[Array, " paths"], weight: Float[Array, " paths"], batches: int, capacity: int
) -> Bool[Array, " paths"]:
    """Returns which paths are among the strongest of their batch; sorts only if necessary."""

    def choose(batch: Int[Array, " paths"]) -> Bool[Array, " paths"]:
        order = jnp.lexsort((-weight, batch))
        rank = _rank_in_group(batch[order], batches)
        return jnp.zeros_like(batch, bool).at[order].set(rank < capacity)

    real = batch < batches
    counts = jax.ops.segment_sum(jnp.ones_like(batch), batch, num_segments=batches + 1)
    crowded = jnp.any(counts[:batches] > capacity)
    return real & jax.lax.cond(crowded, choose, lambda batch: jnp.ones_like(batch, bool), batch)


def _rank_in_group(group: Int[Array, " n"], groups: int) -> Int[Array, " n"]:
    """Returns the position of each record within its group, for records sorted by group."""
    begin = jnp.searchsorted(group, jnp.arange(groups + 1, dtype=jnp.int32)).astype(jnp.int32)
    return jnp.arange(group.shape[0], dtype=jnp.int32) - begin[group]
