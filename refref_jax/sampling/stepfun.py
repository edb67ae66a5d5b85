"""The algebra of step functions on an interval.

Vocabulary: `edges` are `n + 1` increasing endpoints; `weights` are `n` bin masses, not negative,
that sum to at most 1; `heights` are bin values, a density when `heights * widths` are masses;
`cdf` is a cumulative function at the edges, from 0 to 1. All functions take leading batch axes.

Source: Barron et al., Mip-NeRF 360 (2022), section 3 and Zip-NeRF (2023), section 3.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from refref_jax import numerics


def heights(
    edges: Float[Array, "*batch edges"], weights: Float[Array, "*batch edges-1"]
) -> Float[Array, "*batch edges-1"]:
    """Returns `weights / widths`, 0 in bins of no width."""
    return numerics.safe_divide(weights, jnp.diff(edges))


def cumulative(weights: Float[Array, "*batch n"]) -> Float[Array, "*batch n+1"]:
    """Returns the normalised cumulative sum: exactly 0 first, exactly 1 last, not decreasing.

    Weights that are all zero give the uniform distribution.
    """
    total = jnp.sum(weights, axis=-1, keepdims=True)
    share = jnp.where(
        total > 0, weights / jnp.where(total > 0, total, 1.0), 1.0 / weights.shape[-1]
    )
    inner = jnp.minimum(jnp.cumsum(share[..., :-1], axis=-1), 1.0)
    ends = jnp.zeros_like(total)
    return jnp.concatenate([ends, inner, ends + 1.0], axis=-1)


def invert_cumulative(
    u: Float[Array, "*batch m"],
    edges: Float[Array, "*batch edges"],
    cdf: Float[Array, "*batch edges"],
) -> Float[Array, "*batch m"]:
    """Returns where a piecewise linear cumulative function takes the values `u` in `[0, 1]`."""
    bin_ = count_below(cdf[..., 1:-1], u)
    low, high = take(cdf, bin_), take(cdf, bin_ + 1)
    left, right = take(edges, bin_), take(edges, bin_ + 1)
    return left + numerics.safe_divide(u - low, high - low) * (right - left)


def sample_edges(
    u: Float[Array, "*batch m"],
    edges: Float[Array, "*batch edges"],
    weights: Float[Array, "*batch edges-1"],
) -> Float[Array, "*batch m+1"]:
    """Draws `m` intervals whose density follows a step function.

    The samples at `u` become the middles of the new intervals: an edge lies half-way between
    two samples, and the outermost two mirror theirs, within the old interval.

    Args:
      u: increasing quantiles in `[0, 1]`.
      edges: of the step function.
      weights: of the step function, in any scale.
    """
    samples = invert_cumulative(u, edges, cumulative(weights))
    middles = 0.5 * (samples[..., 1:] + samples[..., :-1])
    first = jnp.maximum(2.0 * samples[..., :1] - middles[..., :1], edges[..., :1])
    last = jnp.minimum(2.0 * samples[..., -1:] - middles[..., -1:], edges[..., -1:])
    return jnp.concatenate([first, middles, last], axis=-1)


def dilate(
    edges: Float[Array, "*batch edges"], weights: Float[Array, "*batch edges-1"], amount: float
) -> tuple[Float[Array, "*batch k"], Float[Array, "*batch k-1"]]:
    """Widens every bin by `amount` on both sides and keeps the maximum height.

    Guards a proposal against aliasing: what it found may lie a little to the side. The domain
    stays the same, and the result has `3 n + 1` edges.

    Returns:
      The new edges and weights, which sum to 1.
    """
    left, right = edges[..., :-1] - amount, edges[..., 1:] + amount
    grid = jnp.sort(jnp.concatenate([edges, left, right], axis=-1), axis=-1)
    grid = jnp.clip(grid, edges[..., :1], edges[..., -1:])
    start = grid[..., :-1, None]
    covered = (left[..., None, :] <= start) & (start < right[..., None, :])
    tops = jnp.where(covered, heights(edges, weights)[..., None, :], 0.0)
    mass = jnp.max(tops, axis=-1) * jnp.diff(grid)
    total = jnp.sum(mass, axis=-1, keepdims=True)
    return grid, numerics.safe_divide(mass, jnp.broadcast_to(total, mass.shape))


def blur(
    edges: Float[Array, "*batch edges"], values: Float[Array, "*batch edges-1"], radius: float
) -> tuple[Float[Array, "*batch k"], Float[Array, "*batch k"]]:
    """Convolves a step function with a box of half-width `radius`.

    The result is piecewise linear: it is returned as `k = 2 n + 2` points and the values there.

    Source: Zip-NeRF, section 3 (anti-aliased interlevel loss).
    """
    zero = jnp.zeros_like(values[..., :1])
    jumps = jnp.diff(jnp.concatenate([zero, values, zero], axis=-1)) / (2.0 * radius)
    points = jnp.concatenate([edges - radius, edges + radius], axis=-1)
    order = jnp.argsort(points, axis=-1)
    points = take(points, order)
    slopes = jnp.cumsum(take(jnp.concatenate([jumps, -jumps], axis=-1), order), axis=-1)
    rises = slopes[..., :-1] * jnp.diff(points)
    heights_ = jnp.concatenate([zero, jnp.cumsum(rises, axis=-1)], axis=-1)
    return points, jnp.maximum(heights_, 0.0)


def integrate_linear(
    at: Float[Array, "*batch m"],
    points: Float[Array, "*batch k"],
    values: Float[Array, "*batch k"],
) -> Float[Array, "*batch m"]:
    """Integrates a piecewise linear function from its first point up to each of `at`.

    The function is 0 outside its points.
    """
    widths = jnp.diff(points)
    areas = 0.5 * (values[..., 1:] + values[..., :-1]) * widths
    start = jnp.concatenate([jnp.zeros_like(areas[..., :1]), jnp.cumsum(areas, axis=-1)], axis=-1)
    held = jnp.clip(at, points[..., :1], points[..., -1:])
    bin_ = count_below(points[..., 1:-1], held)
    x = held - take(points, bin_)
    low, high = take(values, bin_), take(values, bin_ + 1)
    slope = numerics.safe_divide(high - low, take(widths, bin_))
    return take(start, bin_) + x * (low + 0.5 * slope * x)


def count_below(
    sorted_values: Float[Array, "*batch n"], queries: Float[Array, "*batch m"]
) -> Int[Array, "*batch m"]:
    """Returns how many values are at most each query: a right-sided search, by comparing all.

    For the few dozen bins of a path this beats a binary search, whose steps depend on each
    other.
    """
    return jnp.sum(sorted_values[..., None, :] <= queries[..., :, None], axis=-1, dtype=jnp.int32)


def take(values: Array, index: Int[Array, "*batch m"]) -> Array:
    """Returns `values[..., index]`, batch by batch."""
    return jnp.take_along_axis(values, index, axis=-1)
