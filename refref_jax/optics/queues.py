"""Work queues of rays and paths with static capacity.

A pool is an array of records with a count; records past the count are meaningless. Appending writes
a full block, so a pool has one block of slots beyond its capacity. After appending, callers reduce
the pool to its capacity with `shed`, which drops the records of least throughput.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

Records = Any
"""NamedTuple of arrays with one leading axis; `shed` requires the fields `weights` and `rays`."""


class Pool(NamedTuple):
    """A list of records.

    Attributes:
      items: records, along the leading axis of each field.
      count: number of valid records.
    """

    items: Records
    count: Int[Array, ""]  # type: ignore[assignment]  # hides tuple.count


def fill(items: Records, count: int, slots: int) -> Pool:
    """Returns a pool of `slots` slots, whose first `count` hold the given records."""

    def pad(x: Array) -> Array:
        return jnp.concatenate([x, jnp.zeros((slots - x.shape[0], *x.shape[1:]), x.dtype)])

    return Pool(jax.tree.map(pad, items), jnp.int32(count))


def join(first: Records, second: Records) -> Records:
    """Concatenates two blocks of records."""
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), first, second)


def append(pool: Pool, block: Records, keep: Bool[Array, " block"]) -> Pool:
    """Appends the selected records of a block, in order.

    Args:
      pool: pool with at least one block of slots beyond its count.
      block: records of the same type.
      keep: mask of the records to append.
    """
    order = front_first(keep)
    items = jax.tree.map(
        lambda old, new: jax.lax.dynamic_update_slice_in_dim(old, new[order], pool.count, 0),
        pool.items,
        block,
    )
    return Pool(items, pool.count + jnp.sum(keep, dtype=jnp.int32))


def pop(pool: Pool, size: int) -> tuple[Pool, Pool]:
    """Removes up to `size` records from the end; returns the remaining and the removed records."""
    start = jnp.maximum(pool.count - size, 0)
    taken = jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, start, size, 0), pool.items)
    return Pool(pool.items, start), Pool(taken, pool.count - start)


def shed(
    pool: Pool, lost: Float[Array, "rays 3"], capacity: int
) -> tuple[Pool, Float[Array, "rays 3"]]:
    """Drops the weakest records beyond a capacity. Its cost is negligible if there are none.

    Args:
      pool: records with fields `weights` (linear RGB) and `rays` (index of the camera ray).
      lost: throughput dropped so far for each ray.
      capacity: maximum number of records to keep.

    Returns:
      The pool, in its order, and the updated dropped throughput.
    """

    def drop(pool: Pool, lost: Float[Array, "rays 3"]) -> tuple[Pool, Float[Array, "rays 3"]]:
        weights, rays = pool.items.weights, pool.items.rays
        filled = jnp.arange(rays.shape[0], dtype=jnp.int32) < pool.count
        kept = strongest(filled, jnp.max(weights, axis=-1), jnp.int32(capacity))
        order = front_first(kept)
        items = jax.tree.map(lambda x: x[order], pool.items)
        lost = lose(lost, rays, weights, filled & ~kept)
        return Pool(items, jnp.sum(kept, dtype=jnp.int32)), lost

    return jax.lax.cond(pool.count > capacity, drop, lambda *same: same, pool, lost)


def lose(
    lost: Float[Array, "rays 3"],
    rays: Int[Array, " n"],
    weights: Float[Array, "n 3"],
    dropped: Bool[Array, " n"],
) -> Float[Array, "rays 3"]:
    """Adds the weights of dropped records to the dropped throughput of their rays."""
    return lost.at[rays].add(jnp.where(dropped[:, None], weights, 0.0))


def strongest(
    mask: Bool[Array, " n"], strength: Float[Array, " n"], capacity: Int[Array, ""]
) -> Bool[Array, " n"]:
    """Returns the `capacity` strongest of the marked records; all of them if there are fewer.

    Among equally strong records, the first are kept. Sorts only if there are more than
    `capacity`.
    """

    def choose(mask: Bool[Array, " n"]) -> Bool[Array, " n"]:
        order = jnp.argsort(jnp.where(mask, -strength, jnp.inf), stable=True).astype(jnp.int32)
        places = jnp.arange(mask.shape[0], dtype=jnp.int32)
        rank = jnp.zeros_like(order).at[order].set(places)
        return mask & (rank < capacity)

    fits = jnp.sum(mask, dtype=jnp.int32) <= capacity
    return jax.lax.cond(fits, lambda mask: mask, choose, mask)


def front_first(keep: Bool[Array, " n"]) -> Int[Array, " n"]:
    """Returns indices that move the marked records to the front, in order.

    The remaining indices are valid but arbitrary.
    """
    count = keep.shape[0]
    target = jnp.where(keep, jnp.cumsum(keep, dtype=jnp.int32) - 1, count)
    lanes = jnp.arange(count, dtype=jnp.int32)
    return jnp.zeros(count, jnp.int32).at[target].set(lanes, mode="drop")
