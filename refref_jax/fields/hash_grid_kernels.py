"""Trilinear interpolation of a hash table at the vertices of a grid, and its transpose.

A grid of `n` cells per side covers the unit cube. If its `(n + 1)^3` vertices fit into the table,
each vertex has its own row, with x varying fastest; otherwise, vertices are hashed to rows.

This part of a field is memory-bound: every point reads eight rows at random addresses, and adds to
eight rows in the backward pass. Both operations are custom primitives with leading axes, which
`vmap` adds: all points of a batch are one loop, or one gather.

The formulas `_gathered` and `_scattered` are for all devices. On a CPU, XLA's own loop for adding
to rows takes twice as long as one over points that finds each point's rows once, so CPUs run that
native loop, `scatter`; its result is the same.

Source: Mueller et al., Instant NGP (2022), section 3.
"""

import functools
import itertools
import operator
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jax.typing import ArrayLike
from jaxtyping import Array, Float, UInt32

from refref_jax.choices import Precision
from refref_jax.compilation import native_loop

# Primes of Instant NGP's spatial hash.
_PRIMES = (1, 2654435761, 805459861)

_CORNERS = tuple(itertools.product((0, 1), repeat=3))

# Numbers of exponent and mantissa bits of bfloat16.
_BFLOAT16 = (8, 7)


def corners(
    position: Sequence[Float[Array, "*batch"]], resolution: int, entries: int
) -> list[tuple[UInt32[Array, "*batch"], Float[Array, "*batch"]]]:
    """Returns entry and trilinear weight of each of the eight corners of the cell around a point.

    The result is a list instead of an array, so that a CPU loop can hold it in registers. A point
    outside the cube by rounding belongs to the nearest cell.

    Args:
      position: coordinates x, y and z in the unit cube.
      resolution: number of cells per side.
      entries: number of entries of the table.
    """
    strides = _strides(resolution, entries)
    terms, weights = [], []
    for coordinate, stride in zip(position, strides, strict=True):
        scaled = coordinate * resolution
        cell = jnp.clip(jnp.floor(scaled), 0, resolution - 1)
        low = cell.astype(jnp.uint32) * jnp.uint32(stride)
        terms.append((low, low + jnp.uint32(stride)))
        weights.append((1.0 - (scaled - cell), scaled - cell))
    return [
        (
            _entry([terms[axis][corner[axis]] for axis in range(3)], strides, entries),
            functools.reduce(operator.mul, (weights[axis][corner[axis]] for axis in range(3))),
        )
        for corner in _CORNERS
    ]


def _strides(resolution: int, entries: int) -> tuple[int, int, int]:
    """Returns the factor of each coordinate in the dense or hashed index."""
    side = resolution + 1
    return (1, side, side * side) if side**3 <= entries else _PRIMES


def _entry(
    terms: Sequence[UInt32[Array, "*batch"]], strides: tuple[int, int, int], entries: int
) -> UInt32[Array, "*batch"]:
    x, y, z = terms
    # Parenthesised so that the term of two axes is computed once for two corners.
    return (x ^ (y ^ z)) & jnp.uint32(entries - 1) if strides is _PRIMES else x + (y + z)


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


def interpolate(
    table: Float[Array, "entries features"],
    positions: Float[Array, "*batch 3"],
    *,
    resolution: int,
    precision: Precision,
) -> Float[Array, "*batch features"]:
    """Blends the table's rows at the eight corners of each point's cell.

    Args:
      table: one row per vertex, or per hash value; see `corners`.
      positions: points in `[0, 1]^3`.
      resolution: number of cells per side.
      precision: precision in which rows are read. Sums, and the gradient with respect to the table,
        have the type of the table.
    """
    return _gather.bind(table, positions, resolution=resolution, precision=precision)


# Formulas, for all devices.


def _gathered(
    table: Float[Array, "entries features"],
    positions: Float[Array, "*batch 3"],
    *,
    resolution: int,
    precision: Precision,
) -> Float[Array, "*batch features"]:
    # Two barriers: without the first, XLA stores the place of each point in its cell, for all
    # levels; without the second, it fuses the concatenation of levels, and neighbouring threads
    # branch.
    axes = jax.lax.optimization_barrier([positions[..., axis] for axis in range(3)])
    blended = jnp.zeros((*positions.shape[:-1], table.shape[1]), table.dtype)
    for entries, weights in corners(axes, resolution, table.shape[0]):
        # Converting the table would read and write all of it.
        rows = _rounded(table.at[entries].get(mode="promise_in_bounds"), precision)
        blended += weights[..., None] * rows
    return jax.lax.optimization_barrier(blended)


def _scattered(
    slopes: Float[Array, "*batch features"],
    positions: Float[Array, "*batch 3"],
    *,
    resolution: int,
    entries: int,
) -> Float[Array, "entries features"]:
    """Adds each point's gradient to the rows that it reads, multiplied by their weights."""
    # Without the barrier, XLA stores rows and weights of `_gathered` for all points and levels:
    # several times the traffic of computing them again.
    positions = jax.lax.optimization_barrier(positions)
    rows, weights = _stacked_corners(positions, resolution, entries)
    shares = weights[..., None] * slopes[..., None, :]
    zeros = jnp.zeros((entries, slopes.shape[-1]), slopes.dtype)
    return zeros.at[rows].add(shares, mode="promise_in_bounds")


def _stacked_corners(
    positions: Float[Array, "*batch 3"], resolution: int, entries: int
) -> tuple[UInt32[Array, "*batch 8"], Float[Array, "*batch 8"]]:
    found = corners(list(jnp.moveaxis(positions, -1, 0)), resolution, entries)
    rows, weights = zip(*found, strict=True)
    return jnp.stack(rows, axis=-1), jnp.stack(weights, axis=-1)


# Primitives: both are linear in their first argument, and each is the other's transpose.


def _primitive(
    name: str, formula: Callable[..., Array], *, cpu: Callable[..., Array] | None = None
) -> Primitive:
    """Returns a primitive over `(values, positions)`, without batching or derivative rules.

    Args:
      name: name of the operation in printed programs.
      formula: function that it computes.
      cpu: function for CPUs, if they have one of their own.
    """
    primitive = Primitive(name)

    def abstract(*arguments: Any, **options: Any) -> jax.core.ShapedArray:
        result = jax.eval_shape(functools.partial(formula, **options), *arguments)
        return jax.core.ShapedArray(result.shape, result.dtype)

    primitive.def_impl(functools.partial(_evaluate, formula))
    primitive.def_abstract_eval(abstract)
    mlir.register_lowering(primitive, mlir.lower_fun(formula, multiple_results=False))
    if cpu is not None:
        own = mlir.lower_fun(cpu, multiple_results=False)
        mlir.register_lowering(primitive, own, platform="cpu")
    return primitive


def _evaluate(formula: Callable[..., Array], *arguments: ArrayLike, **options: Any) -> Array:
    """Applies the formula to JAX arrays; a primitive may receive constants as NumPy arrays."""
    return formula(*map(jnp.asarray, arguments), **options)


def _derive_by_positions(
    formula: Callable[..., Array],
    tangent: ArrayLike,
    values: ArrayLike,
    positions: ArrayLike,
    **options: Any,
) -> Array:
    moved = functools.partial(_evaluate, formula, values, **options)
    return jax.jvp(moved, (positions,), (tangent,))[1]


def _map(
    formula: Callable[..., Array],
    arguments: Sequence[ArrayLike],
    axes: Sequence[Any],
    **options: Any,
) -> tuple[Array, int]:
    return jax.vmap(functools.partial(formula, **options), in_axes=tuple(axes))(*arguments), 0


def _map_gather(
    arguments: Sequence[ArrayLike], axes: Sequence[Any], **options: Any
) -> tuple[Array, int]:
    """Converts a mapped axis of points to a leading axis."""
    table, positions = arguments
    if axes[0] is None:
        return _gather.bind(table, jnp.moveaxis(positions, axes[1], 0), **options), 0
    return _map(_gathered, arguments, axes, **options)


def _derive_gather(
    tangent: ArrayLike,
    table: ArrayLike,
    positions: ArrayLike,
    *,
    resolution: int,
    precision: Precision,
) -> Array:
    del precision  # rounding is not linear; its derivative is defined as 1
    return _gather.bind(tangent, positions, resolution=resolution, precision="float32")


def _transpose_gather(
    slopes: Any, table: Any, positions: ArrayLike, *, resolution: int, precision: Precision
) -> tuple[Any, None]:
    del precision
    if isinstance(slopes, ad.Zero):
        return ad.Zero(table.aval), None
    entries = table.aval.shape[0]
    return _scatter.bind(slopes, positions, resolution=resolution, entries=entries), None


def _derive_scatter(
    tangent: ArrayLike, slopes: ArrayLike, positions: ArrayLike, **options: Any
) -> Array:
    del slopes
    return _scatter.bind(tangent, positions, **options)


def _transpose_scatter(
    table: Any, slopes: Any, positions: ArrayLike, *, resolution: int, entries: int
) -> tuple[Any, None]:
    del entries
    if isinstance(table, ad.Zero):
        return ad.Zero(slopes.aval), None
    return _gather.bind(table, positions, resolution=resolution, precision="float32"), None


_gather = _primitive("gather_vertices", _gathered)
batching.primitive_batchers[_gather] = _map_gather
ad.defjvp(_gather, _derive_gather, functools.partial(_derive_by_positions, _gathered))
ad.primitive_transposes[_gather] = _transpose_gather

_scatter = _primitive("scatter_vertices", _scattered, cpu=scatter)
batching.primitive_batchers[_scatter] = functools.partial(_map, _scattered)
ad.defjvp(_scatter, _derive_scatter, functools.partial(_derive_by_positions, _scattered))
ad.primitive_transposes[_scatter] = _transpose_scatter
