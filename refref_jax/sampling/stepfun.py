"""Operations on step functions over an interval.

Notation: `edges` are `n + 1` increasing endpoints; `weights` are `n` non-negative bin masses that
sum to at most 1; `heights` are bin values, a density if `heights * widths` are masses; `cdf` is a
cumulative function at the edges, from 0 to 1. All functions take leading batch axes.

Source: Barron et al., Mip-NeRF 360 (2022), section 3 and Zip-NeRF (2023), section 3.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from refref_jax import numerics

# Values that a search on a GPU compares at once.
_BLOCK = 16


def weight_to_pdf(
    edges: Float[Array, "*batch edges"], weights: Float[Array, "*batch edges-1"]
) -> Float[Array, "*batch edges-1"]:
    """Returns `weights / widths`, 0 in bins of width 0."""
    return numerics.safe_divide(weights, jnp.diff(edges))


def integrate_weights(weights: Float[Array, "*batch n"]) -> Float[Array, "*batch n+1"]:
    """Returns the normalised cumulative sum, non-decreasing from exactly 0 to exactly 1.

    If all weights are zero, the distribution is uniform.
    """
    total = jnp.broadcast_to(jnp.sum(weights, axis=-1, keepdims=True), weights.shape)
    share = jnp.where(total > 0, numerics.safe_divide(weights, total), 1.0 / weights.shape[-1])
    inner = jnp.minimum(jnp.cumsum(share[..., :-1], axis=-1), 1.0)
    ends = jnp.zeros_like(weights[..., :1])
    return jnp.concatenate([ends, inner, ends + 1.0], axis=-1)


def invert_cdf(
    u: Float[Array, "*batch m"],
    edges: Float[Array, "*batch edges"],
    cdf: Float[Array, "*batch edges"],
) -> Float[Array, "*batch m"]:
    """Inverts a piecewise linear cumulative function at values `u` in `[0, 1]`."""
    bin_ = count_below(cdf[..., 1:-1], u)
    low, high = take(cdf, bin_), take(cdf, bin_ + 1)
    left, right = take(edges, bin_), take(edges, bin_ + 1)
    return left + numerics.safe_divide(u - low, high - low) * (right - left)


def sample_intervals(
    u: Float[Array, "*batch m"],
    edges: Float[Array, "*batch edges"],
    weights: Float[Array, "*batch edges-1"],
) -> Float[Array, "*batch m+1"]:
    """Draws `m` intervals whose density follows a step function.

    Inner edges of the new intervals lie half-way between the samples at `u`. Each outermost edge is
    the mirror image of its neighbour at the outermost sample, but stays within the old domain.

    Args:
      u: increasing quantiles in `[0, 1]`.
      edges: edges of the step function.
      weights: weights of the step function, in any scale.
    """
    samples = invert_cdf(u, edges, integrate_weights(weights))
    middles = 0.5 * (samples[..., 1:] + samples[..., :-1])
    first = jnp.maximum(2.0 * samples[..., :1] - middles[..., :1], edges[..., :1])
    last = jnp.minimum(2.0 * samples[..., -1:] - middles[..., -1:], edges[..., -1:])
    return jnp.concatenate([first, middles, last], axis=-1)


def snap(
    edges: Float[Array, "*batch edges"], knots: Float[Array, "*batch knots"]
) -> Float[Array, "*batch edges"]:
    """Moves edges onto knots, so that no interval contains a knot.

    Every knot attracts its nearest inner edge; if two knots attract the same edge, it moves to the
    first. Edges stay in order, and the outermost two do not move. Knots at or beyond these have no
    effect.

    Args:
      edges: edges in order.
      knots: knots in any order, finite.
    """
    inner = edges.shape[-1] - 2
    if inner < 1 or knots.shape[-1] == 0:
        return edges
    # Among equal edges, a knot attracts the one on its own side, so that they stay in order.
    right = count_below(edges[..., 1:-1], knots)
    nearer = knots - take(edges, right) < take(edges, right + 1) - knots
    drawn = jnp.where((right == inner) | (nearer & (right > 0)), right - 1, right)
    within = (knots > edges[..., :1]) & (knots < edges[..., -1:])
    lanes = jnp.arange(inner, dtype=drawn.dtype).reshape(*(1,) * (knots.ndim - 1), inner, 1)
    draws = (drawn[..., None, :] == lanes) & within[..., None, :]
    first = jnp.argmax(draws, axis=-1)
    moved = jnp.where(jnp.any(draws, axis=-1), take(knots, first), edges[..., 1:-1])
    return jnp.concatenate([edges[..., :1], moved, edges[..., -1:]], axis=-1)


def dilate(
    edges: Float[Array, "*batch edges"], weights: Float[Array, "*batch edges-1"], amount: float
) -> tuple[Float[Array, "*batch k"], Float[Array, "*batch k-1"]]:
    """Widens every bin by `amount` on both sides and keeps the maximum height.

    This protects proposals from aliasing, because content may lie slightly beside the bins that
    found it. The domain is unchanged, and the result has `3 n + 1` edges.

    Returns:
      The new edges and weights, which sum to 1.
    """
    left, right = edges[..., :-1] - amount, edges[..., 1:] + amount
    grid = jnp.sort(jnp.concatenate([edges, left, right], axis=-1), axis=-1)
    grid = jnp.clip(grid, edges[..., :1], edges[..., -1:])
    start = grid[..., :-1, None]
    covered = (left[..., None, :] <= start) & (start < right[..., None, :])
    tops = jnp.where(covered, weight_to_pdf(edges, weights)[..., None, :], 0.0)
    mass = jnp.max(tops, axis=-1) * jnp.diff(grid)
    total = jnp.sum(mass, axis=-1, keepdims=True)
    return grid, numerics.safe_divide(mass, jnp.broadcast_to(total, mass.shape))


def blurred_mass_below(
    at: Float[Array, "*batch m"],
    edges: Float[Array, "*batch edges"],
    weights: Float[Array, "*batch edges-1"],
    radius: float,
) -> Float[Array, "*batch m"]:
    """Returns the mass below each of `at` after blurring by a box of half-width `radius`.

    A point blurred by the box lies below `x` with probability `clip(x', 0, 1)` for
    `x' = (x - point + radius) / (2 radius)`; the contribution of a bin is the mean of this
    probability over the bin. It is in `[0, 1]` for bins of any width. The usual implementation,
    which integrates the blurred step function by cumulative sums, multiplies rounding errors by the
    heights of thin bins and produces mass in empty regions.

    Source: Zip-NeRF, section 3 (anti-aliased interlevel loss), in closed form.
    """
    ends = (at[..., :, None] - edges[..., None, :] + radius) / (2.0 * radius)
    low, high = ends[..., 1:], ends[..., :-1]
    inner_low, inner_high = jnp.clip(low, 0.0, 1.0), jnp.clip(high, 0.0, 1.0)
    rising = 0.5 * (inner_low + inner_high) * (inner_high - inner_low)
    full = jnp.maximum(high, 1.0) - jnp.maximum(low, 1.0)
    share = jnp.where(high > low, numerics.safe_divide(rising + full, high - low), inner_low)
    return jnp.sum(weights[..., None, :] * share, axis=-1)


def count_below(
    sorted_values: Float[Array, "*batch n"], queries: Float[Array, "*batch m"]
) -> Int[Array, "*batch m"]:
    """Returns the number of values <= each query: a right-sided search.

    On CPUs all values are compared, which for the few dozen bins of a path is faster than a binary
    search, whose steps are sequential. Elsewhere there are two steps, among the ends of blocks and
    in a block: otherwise XLA keeps every comparison in registers, more than a GPU has, and takes a
    minute to compile that.
    """
    return jax.lax.platform_dependent(
        sorted_values, queries, cpu=_count_at_once, default=_count_in_blocks
    )


def _count_at_once(values: Array, queries: Array) -> Int[Array, "*batch m"]:
    return jnp.sum(values[..., None, :] <= queries[..., :, None], axis=-1, dtype=jnp.int32)


def _count_in_blocks(values: Array, queries: Array) -> Int[Array, "*batch m"]:
    count = values.shape[-1]
    ends = values[..., _BLOCK - 1 :: _BLOCK]
    first = _BLOCK * _count_at_once(ends, queries)
    offsets = jax.lax.broadcasted_iota(jnp.int32, (*first.shape, _BLOCK), first.ndim)
    index = first[..., None] + offsets
    found = jnp.take_along_axis(values[..., None, :], jnp.minimum(index, count - 1), axis=-1)
    below = (index < count) & (found <= queries[..., None])
    return first + jnp.sum(below, axis=-1, dtype=jnp.int32)


def take(values: Array, index: Int[Array, "*batch m"]) -> Array:
    """Returns `values[..., index]`, separately for each batch element."""
    return jnp.take_along_axis(values, index, axis=-1)
