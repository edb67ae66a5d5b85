"""Order of many small numbers: by counting on a CPU, where it is five times faster than a sort.

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
        digits = ((keys >> low) & (2**width - 1)).astype(jnp.uint32)
        if low > 0:
            digits = digits.at[order].get(mode="promise_in_bounds", unique_indices=True)
        totals = _count(digits, jnp.zeros(2**width, jnp.int32))
        order = _place(digits, order, jnp.cumsum(totals) - totals)
    return order


@native_loop
def _count(
    digits: UInt32[Array, " numbers"], zeros: Int[Array, " values"]
) -> Int[Array, " values"]:
    """Returns how often each digit occurs."""

    def count(index: Array, totals: Array) -> Array:
        return _increase(totals, _read(digits, index.astype(jnp.uint32)))

    return jax.lax.fori_loop(0, digits.shape[0], count, zeros)


@native_loop
def _place(
    digits: UInt32[Array, " numbers"],
    values: Int[Array, " numbers"],
    starts: Int[Array, " values"],
) -> Int[Array, " numbers"]:
    """Returns the values in order of their digits; those of one digit go from its start on."""

    def place(index: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        ends, placed = state
        index = index.astype(jnp.uint32)
        digit = _read(digits, index)
        # The place is read from the counters after their update: if the old ones were still in
        # use, XLA would copy all of them for every number.
        ends = _increase(ends, digit)
        target = (_read(ends, digit) - 1).astype(jnp.uint32)
        return ends, _write(placed, target, _read(values, index))

    start = (starts, jnp.zeros_like(values))
    return jax.lax.fori_loop(0, digits.shape[0], place, start)[1]


def _increase(counters: Int[Array, " values"], which: UInt32[Array, ""]) -> Int[Array, " values"]:
    return _write(counters, which, _read(counters, which) + 1)


def _read(values: Array, index: UInt32[Array, ""]) -> Array:
    return jax.lax.dynamic_slice(values, (index,), (1,), allow_negative_indices=False)[0]


def _write(values: Array, index: UInt32[Array, ""], value: Array) -> Array:
    return jax.lax.dynamic_update_slice(values, value[None], (index,), allow_negative_indices=False)
