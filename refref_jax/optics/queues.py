"""Work queues of rays and paths with static capacity.

A queue is an array of records with a count; records past the count are meaningless. Appending
writes a full block, so a queue has one block of space beyond its capacity. After appending, callers
reduce the queue to its capacity with `drop_weakest`, which drops the records of least throughput.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

Records = Any
"""NamedTuple of arrays with one leading axis.

`drop_weakest` requires the fields `throughput` and `rays`.
"""


class Queue(NamedTuple):
    """A list of records.

    Attributes:
      items: records, along the leading axis of each field.
      count: number of valid records.
    """

    items: Records
    count: Int[Array, ""]  # type: ignore[assignment]  # hides tuple.count


def fill(items: Records, count: int, size: int) -> Queue:
    """Returns a queue of `size` records, whose first `count` hold the given records."""

    def pad(x: Array) -> Array:
        return jnp.concatenate([x, jnp.zeros((size - x.shape[0], *x.shape[1:]), x.dtype)])

    return Queue(jax.tree.map(pad, items), jnp.int32(count))


def join(first: Records, second: Records) -> Records:
    """Concatenates two blocks of records."""
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), first, second)


def append(queue: Queue, block: Records, keep: Bool[Array, " block"]) -> Queue:
    """Appends the selected records of a block, in order.

    Args:
      queue: queue with space for at least one block beyond its count.
      block: records of the same type.
      keep: mask of the records to append.
    """
    order = front_first(keep)
    items = jax.tree.map(
        lambda old, new: jax.lax.dynamic_update_slice_in_dim(old, new[order], queue.count, 0),
        queue.items,
        block,
    )
    return Queue(items, queue.count + jnp.sum(keep, dtype=jnp.int32))


def pop(queue: Queue, size: int) -> tuple[Queue, Queue]:
    """Removes up to `size` records from the end; returns the remaining and the removed records."""
    start = jnp.maximum(queue.count - size, 0)
    taken = jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, start, size, 0), queue.items)
    return Queue(queue.items, start), Queue(taken, queue.count - start)


def drop_weakest(
    queue: Queue, dropped: Float[Array, "rays 3"], capacity: int
) -> tuple[Queue, Float[Array, "rays 3"]]:
    """Drops the weakest records beyond a capacity. Its cost is negligible if there are none.

    Args:
      queue: records with fields `throughput` (linear RGB) and `rays` (index of the camera ray).
      dropped: throughput dropped so far for each ray.
      capacity: maximum number of records to keep.

    Returns:
      The queue, in its original order, and the updated dropped throughput.
    """

    def drop(queue: Queue, dropped: Float[Array, "rays 3"]) -> tuple[Queue, Float[Array, "rays 3"]]:
        throughput, rays = queue.items.throughput, queue.items.rays
        filled = jnp.arange(rays.shape[0], dtype=jnp.int32) < queue.count
        kept = strongest(filled, jnp.max(throughput, axis=-1), jnp.int32(capacity))
        order = front_first(kept)
        items = jax.tree.map(lambda x: x[order], queue.items)
        dropped = add_dropped(dropped, rays, throughput, filled & ~kept)
        return Queue(items, jnp.sum(kept, dtype=jnp.int32)), dropped

    return jax.lax.cond(queue.count > capacity, drop, lambda *same: same, queue, dropped)


def add_dropped(
    dropped: Float[Array, "rays 3"],
    rays: Int[Array, " n"],
    throughput: Float[Array, "n 3"],
    which: Bool[Array, " n"],
) -> Float[Array, "rays 3"]:
    """Adds the throughput of the marked records to the dropped throughput of their rays."""
    return dropped.at[rays].add(jnp.where(which[:, None], throughput, 0.0))


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
