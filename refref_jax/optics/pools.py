"""Lists of rays and paths of static capacity, for many of them at once.

A pool is an array of records with a count; records past the count have no meaning. Appending
writes one block, so a pool holds as many slots beyond its capacity as a block is long. Whoever
appends then sheds what is too much: the least light.
"""

from typing import Generic, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

_Items = TypeVar("_Items")


class Pool(NamedTuple, Generic[_Items]):
    """Records in a row.

    Attributes:
      items: records, along the leading axis of each field.
      count: how many of them are there.
    """

    items: _Items
    count: Int[Array, ""]


class Shedding(NamedTuple, Generic[_Items]):
    """What shedding leaves.

    Attributes:
      pool: the records that stay, in their order.
      dropped: which slots of the pool before held a record that has gone.
    """

    pool: Pool[_Items]
    dropped: Bool[Array, " slots"]


def append(pool: Pool[_Items], block: _Items, keep: Bool[Array, " block"]) -> Pool[_Items]:
    """Appends those records of a block that are to be kept, in their order.

    Args:
      pool: has room for a whole block beyond its count.
      block: records of the same kind.
      keep: which to append.
    """
    order = front_first(keep)
    items = jax.tree.map(
        lambda old, new: jax.lax.dynamic_update_slice_in_dim(old, new[order], pool.count, 0),
        pool.items,
        block,
    )
    return Pool(items, pool.count + jnp.sum(keep, dtype=jnp.int32))


def shed(pool: Pool[_Items], strength: Float[Array, " slots"], capacity: int) -> Shedding[_Items]:
    """Drops the weakest records until a capacity is kept. Costs next to nothing if it is.

    Args:
      pool: the records.
      strength: of each slot.
      capacity: most records to keep.
    """

    def drop(pool: Pool[_Items]) -> Shedding[_Items]:
        filled = jnp.arange(strength.shape[0]) < pool.count
        kept = strongest(filled, strength, jnp.int32(capacity))
        order = front_first(kept)
        items = jax.tree.map(lambda x: x[order], pool.items)
        return Shedding(Pool(items, jnp.sum(kept, dtype=jnp.int32)), filled & ~kept)

    def leave(pool: Pool[_Items]) -> Shedding[_Items]:
        return Shedding(pool, jnp.zeros(strength.shape, bool))

    return jax.lax.cond(pool.count > capacity, drop, leave, pool)


def strongest(
    mask: Bool[Array, " n"], strength: Float[Array, " n"], room: Int[Array, ""]
) -> Bool[Array, " n"]:
    """Returns the strongest `room` of the marked records; all of them if there are fewer.

    Of equally strong ones the first stay. Sorts only if there is too little room.
    """

    def choose(mask: Bool[Array, " n"]) -> Bool[Array, " n"]:
        order = jnp.argsort(jnp.where(mask, -strength, jnp.inf), stable=True)
        rank = jnp.zeros_like(order).at[order].set(jnp.arange(mask.shape[0], dtype=order.dtype))
        return mask & (rank < room)

    fits = jnp.sum(mask, dtype=jnp.int32) <= room
    return jax.lax.cond(fits, lambda mask: mask, choose, mask)


def front_first(keep: Bool[Array, " n"]) -> Int[Array, " n"]:
    """Returns the order that brings the marked records to the front, in their order.

    What follows them is arbitrary: a valid index, without meaning.
    """
    count = keep.shape[0]
    target = jnp.where(keep, jnp.cumsum(keep, dtype=jnp.int32) - 1, count)
    lanes = jnp.arange(count, dtype=jnp.int32)
    return jnp.zeros(count, jnp.int32).at[target].set(lanes, mode="drop")
