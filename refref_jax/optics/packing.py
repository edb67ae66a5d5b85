"""Packs the paths of many batches into lists of equal length.

A batch keeps its strongest paths, in the order of its rays, each ray's heaviest first.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from refref_jax.optics import path_tree
from refref_jax.optics.path_tree import Ends, PathTree


def pack(
    tree: PathTree, batches: int, rays: int, capacity: int
) -> tuple[Ends, Float[Array, "all_rays 3"]]:
    """Sorts paths into one list a batch.

    Args:
      tree: the paths of all batches.
      batches: how many there are.
      rays: in each.
      capacity: room for the paths of each.

    Returns:
      The lists, joined end to end, and the light that each ray has lost by now.
    """
    slots = tree.ends.items.rays.shape[0]
    ends = path_tree.listed(tree, slots)
    weight = jnp.max(ends.weights, axis=-1)
    # The slots past the last path form a batch of their own.
    lanes = jnp.arange(slots, dtype=jnp.int32)
    batch = jnp.where(lanes < tree.ends.count, ends.rays // rays, batches)
    strongest_first = jnp.lexsort((-weight, batch))
    rank = _rank_in_group(batch[strongest_first], batches)
    fits = jnp.zeros(slots, bool).at[strongest_first].set(rank < capacity) & (batch < batches)
    group = jnp.where(fits, batch, batches)
    order = jnp.lexsort((-weight, ends.rays, group)).astype(jnp.int32)
    place = group[order] * capacity + _rank_in_group(group[order], batches)
    target = jnp.where(fits[order], place, batches * capacity)
    source = jnp.full(batches * capacity, slots, jnp.int32).at[target].set(order, mode="drop")
    packed = jax.tree.map(lambda x: x[jnp.minimum(source, slots - 1)], ends)
    home = jnp.repeat(jnp.arange(batches, dtype=jnp.int32) * rays, capacity)
    left_over = jnp.where(fits[:, None], 0.0, ends.weights)
    lost = tree.lost.at[ends.rays].add(left_over)
    return path_tree.emptied(packed, source == slots, home), lost


def _rank_in_group(group: Int[Array, " n"], groups: int) -> Int[Array, " n"]:
    """Returns the place of each record among its group's, for records sorted by group."""
    begin = jnp.searchsorted(group, jnp.arange(groups + 1, dtype=jnp.int32)).astype(jnp.int32)
    return jnp.arange(group.shape[0], dtype=jnp.int32) - begin[group]
