"""Trilinear interpolation of a table at the vertices of a grid, and its transpose.

This part of a field is memory-bound: every point reads eight rows at random addresses, and adds to
eight rows in the backward pass. Both operations are custom primitives, because XLA's loops for them
on a CPU take about twice as long as one loop over points that computes the rows once. CPUs run
`vertex_loops`; other devices use the formulas `_gathered` and `_scattered`, as do rare operations
(derivatives with respect to the position, several tables at once).

Both primitives take leading axes, which `vmap` adds: all points of a batch are one loop, or one
gather.

Source: Mueller et al., Instant NGP (2022), section 3.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jax.typing import ArrayLike
from jaxtyping import Array, Float, UInt32

from refref_jax.choices import Precision
from refref_jax.fields import vertex_loops
from refref_jax.fields.vertices import corners


def interpolate(
    table: Float[Array, "entries features"],
    positions: Float[Array, "*batch 3"],
    *,
    resolution: int,
    precision: Precision,
) -> Float[Array, "*batch features"]:
    """Blends the table's rows at the eight corners of each point's cell.

    Args:
      table: one row per vertex, or per hash value; see `vertices`.
      positions: points in `[0, 1]^3`.
      resolution: number of cells per side.
      precision: precision in which rows are read. Sums, and the gradient with respect to the table,
        have the type of the table.
    """
    return _gather.bind(table, positions, resolution=resolution, precision=precision)


# --- as formulas ---


def _gathered(
    table: Float[Array, "entries features"],
    positions: Float[Array, "*batch 3"],
    *,
    resolution: int,
    precision: Precision,
) -> Float[Array, "*batch features"]:
    entries, weights = _stacked_corners(positions, resolution, table.shape[0])
    stored = table.astype(jnp.bfloat16) if precision == "bfloat16" else table
    rows = stored.at[entries].get(mode="promise_in_bounds").astype(table.dtype)
    return jnp.einsum("...c,...cf->...f", weights, rows)


def _scattered(
    slopes: Float[Array, "*batch features"],
    positions: Float[Array, "*batch 3"],
    *,
    resolution: int,
    entries: int,
) -> Float[Array, "entries features"]:
    """Adds each point's gradient to the rows that it reads, multiplied by their weights."""
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


# --- as primitives: both are linear in their first argument, and each is the other's transpose ---


def _primitive(name: str, formula: Callable[..., Array], loop: Callable[..., Array]) -> Primitive:
    """Returns a primitive over `(values, positions)`, without batching or derivative rules."""
    primitive = Primitive(name)

    def abstract(*arguments: Any, **options: Any) -> jax.core.ShapedArray:
        result = jax.eval_shape(functools.partial(formula, **options), *arguments)
        return jax.core.ShapedArray(result.shape, result.dtype)

    primitive.def_impl(functools.partial(_evaluate, formula))
    primitive.def_abstract_eval(abstract)
    mlir.register_lowering(primitive, mlir.lower_fun(formula, multiple_results=False))
    mlir.register_lowering(primitive, mlir.lower_fun(loop, multiple_results=False), platform="cpu")
    return primitive


def _evaluate(formula: Callable[..., Array], *arguments: ArrayLike, **options: Any) -> Array:
    """Returns the value of the formula; JAX passes constants to primitives as NumPy arrays."""
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


_gather = _primitive("gather_vertices", _gathered, vertex_loops.gather)
batching.primitive_batchers[_gather] = _map_gather
ad.defjvp(_gather, _derive_gather, functools.partial(_derive_by_positions, _gathered))
ad.primitive_transposes[_gather] = _transpose_gather

_scatter = _primitive("scatter_vertices", _scattered, vertex_loops.scatter)
batching.primitive_batchers[_scatter] = functools.partial(_map, _scattered)
ad.defjvp(_scatter, _derive_scatter, functools.partial(_derive_by_positions, _scattered))
ad.primitive_transposes[_scatter] = _transpose_scatter
