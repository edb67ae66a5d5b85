"""Order of many small numbers: by counting on a CPU, where it is four times faster than a sort.

Each pass puts the numbers in order of one digit and keeps the order of those that share it, from
the lowest digit up. A pass takes two loops over the numbers, one that counts each digit and one
that puts every number in its place.

Source: Seward, Information Sorting in the Application of Electronic Digital Computers (1954).
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, UInt32

from refref_jax.geometry.native_loop import native_loop

_DIGIT_BITS = 11
"""Most bits of a digit: the counters of one pass are 8 KiB, and two passes serve 22 bits."""


def stable_order(keys: UInt32[Array, " numbers"], *, bits: int) -> Int[Array, " numbers"]:
    """Returns the places of the keys from the lowest to the highest; equal keys keep their order.

    Args:
      keys: below `2**bits`.
      bits: fixed when compiled.
    """
    if keys.shape[0] == 0:
        return jnp.zeros(0, jnp.int32)
    return jax.lax.platform_dependent(
        keys,
        cpu=partial(_order_by_digits, bits=bits),
        default=lambda keys: jnp.argsort(keys, stable=True).astype(jnp.int32),
    )


def _order_by_digits(keys: UInt32[Array, " numbers"], bits: int) -> Int[Array, " numbers"]:
    order = jnp.arange(keys.shape[0], dtype=jnp.int32)
    passes = -(-bits // _DIGIT_BITS)
    width = -(-bits // passes)
    for low in range(0, bits, width):
        shift = jnp.uint32(low)
        totals = _count(keys, shift, jnp.zeros(2**width, jnp.int32))
        order = _place(keys, shift, order, jnp.cumsum(totals) - totals)
    return order


@native_loop
def _count(
    keys: UInt32[Array, " numbers"], shift: UInt32[Array, ""], zeros: Int[Array, " digits"]
) -> Int[Array, " digits"]:
    """Returns how often each digit occurs."""

    def count(index: Array, totals: Array) -> Array:
        return _increase(totals, _digit(_read(keys, index), shift, totals))

    return jax.lax.fori_loop(0, keys.shape[0], count, zeros)


@native_loop
def _place(
    keys: UInt32[Array, " numbers"],
    shift: UInt32[Array, ""],
    order: Int[Array, " numbers"],
    starts: Int[Array, " digits"],
) -> Int[Array, " numbers"]:
    """Returns the numbers of the keys by digit; those of one digit go from its start on."""

    def place(index: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        ends, placed = state
        number = _read(order, index)
        digit = _digit(_read(keys, number), shift, ends)
        # The place is read from the counters after their update: if the old ones were still in
        # use, XLA would copy all of them for every number.
        ends = _increase(ends, digit)
        return ends, _write(placed, _read(ends, digit) - 1, number)

    start = (starts, jnp.zeros_like(order))
    return jax.lax.fori_loop(0, keys.shape[0], place, start)[1]


def _digit(
    key: UInt32[Array, ""], shift: UInt32[Array, ""], counters: Int[Array, " digits"]
) -> Int[Array, ""]:
    """Returns the digit of a key that begins at the bit `shift`."""
    # Cut out before the loops, XLA would compute the keys anew for every pass.
    return ((key >> shift) & (counters.shape[0] - 1)).astype(jnp.int32)


def _increase(counters: Int[Array, " digits"], digit: Int[Array, ""]) -> Int[Array, " digits"]:
    return _write(counters, digit, _read(counters, digit) + 1)


def _read(values: Array, index: Int[Array, ""]) -> Array:
    start = (index.astype(jnp.uint32),)
    return jax.lax.dynamic_slice(values, start, (1,), allow_negative_indices=False)[0]


def _write(values: Array, index: Int[Array, ""], value: Array) -> Array:
    start = (index.astype(jnp.uint32),)
    return jax.lax.dynamic_update_slice(values, value[None], start, allow_negative_indices=False)
