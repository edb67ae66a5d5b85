"""Interpolation of a table, and its transpose, as native CPU loops over points.

The results are those of the formulas in `interpolation`. The rows of a point are computed once and
stay in registers for all of its features.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, UInt32

from refref_jax.choices import Precision
from refref_jax.fields.vertices import corners
from refref_jax.geometry.native_loop import native_loop

# Numbers of exponent and mantissa bits of bfloat16.
_BFLOAT16 = (8, 7)


def gather(
    table: Float[Array, "entries features"],
    positions: Float[Array, "*batch 3"],
    *,
    resolution: int,
    precision: Precision,
) -> Float[Array, "*batch features"]:
    """Blends the rows at the eight corners of each point's cell; see `interpolate`."""
    features = table.shape[1]

    @native_loop
    def blend_all(table: Array, points: Array) -> Array:
        def blend(index: Array, blended: Array) -> Array:
            index = index.astype(jnp.uint32)
            total = jnp.zeros((1, features), table.dtype)
            for entry, weight in corners(list(_row(points, index)[0]), resolution, table.shape[0]):
                total += weight * _rounded(_row(table, entry), precision)
            return _with_row(blended, index, total)

        start = jnp.zeros((points.shape[0], features), table.dtype)
        return jax.lax.fori_loop(0, points.shape[0], blend, start)

    return blend_all(table, positions.reshape(-1, 3)).reshape(*positions.shape[:-1], features)


def scatter(
    slopes: Float[Array, "*batch features"],
    positions: Float[Array, "*batch 3"],
    *,
    resolution: int,
    entries: int,
) -> Float[Array, "entries features"]:
    """Adds each point's gradient to the rows that it reads, multiplied by their weights."""
    features = slopes.shape[-1]

    @native_loop
    def add_all(slopes: Array, points: Array) -> Array:
        def add(index: Array, table: Array) -> Array:
            index = index.astype(jnp.uint32)
            slope = _row(slopes, index)
            for entry, weight in corners(list(_row(points, index)[0]), resolution, entries):
                table = _with_row(table, entry, _row(table, entry) + weight * slope)
            return table

        start = jnp.zeros((entries, features), slopes.dtype)
        return jax.lax.fori_loop(0, points.shape[0], add, start)

    return add_all(slopes.reshape(-1, features), positions.reshape(-1, 3))


def _rounded(row: Array, precision: Precision) -> Array:
    """Returns a row rounded to a precision."""
    # XLA would remove a conversion to the precision and back.
    return jax.lax.reduce_precision(row, *_BFLOAT16) if precision == "bfloat16" else row


def _row(values: Array, index: UInt32[Array, ""]) -> Array:
    start, size = (index, jnp.uint32(0)), (1, values.shape[1])
    return jax.lax.dynamic_slice(values, start, size, allow_negative_indices=False)


def _with_row(values: Array, index: UInt32[Array, ""], row: Array) -> Array:
    start = (index, jnp.uint32(0))
    return jax.lax.dynamic_update_slice(values, row, start, allow_negative_indices=False)
