"""Volume rendering of one path from its samples.

Letters, as in the paper (arXiv 2505.05848, section 4.1): interval `i` has density `sigma_i` and
length `delta_i`; `T_i = exp(-sum_{j<i} sigma_j delta_j)` is the light that reaches it and
`w_i = T_i (1 - exp(-sigma_i delta_i))` its weight in the colour.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from refref_jax import numerics
from refref_jax.sampling import stepfun


class Composite(NamedTuple):
    """Colour and distance of a path.

    Attributes:
      rgb: linear colour.
      accumulation: sum of the weights, in `[0, 1]`.
      median: distance at which the cumulative weight is 0.5; `inf` if the accumulation is lower.
        This is the paper's distance: the nearest relevant surface, even if it is translucent.
      mean: weighted mean distance; `inf` if the accumulation is 0.
    """

    rgb: Float[Array, "3"]
    accumulation: Float[Array, ""]
    median: Float[Array, ""]
    mean: Float[Array, ""]


def alpha_weights(
    density: Float[Array, " samples"], lengths: Float[Array, " samples"]
) -> Float[Array, " samples"]:
    """Returns the weights `w_i`, which sum to at most 1.

    Value and gradient are finite for any density and length in `[0, inf)` whose product does not
    overflow; the product may be infinite if it is not `0 * inf`. Edges that differ by a rounding
    error may be out of order: lengths below 0 count as 0, because an opaque sample would otherwise
    have a weight of minus infinity.

    Source: paper, volume rendering equation.
    """
    depth = density * jnp.where(lengths < 0.0, 0.0, lengths)
    before = jnp.concatenate([jnp.zeros_like(depth[:1]), jnp.cumsum(depth[:-1])])
    return jnp.exp(-before) * -jnp.expm1(-depth)


def opaque_end(weights: Float[Array, " samples"]) -> Float[Array, " samples"]:
    """Adds the remaining transmittance to the last sample, as if it were opaque.

    The weights then sum to 1 for any density.
    """
    return weights.at[-1].set(jnp.maximum(1.0 - jnp.sum(weights[:-1]), 0.0))


def composite(
    weights: Float[Array, " samples"],
    rgb: Float[Array, "samples 3"],
    edges: Float[Array, " samples+1"],
) -> Composite:
    """Sums the samples of a path.

    Args:
      weights: weights `w_i`.
      rgb: linear colours.
      edges: distances of the edges of the intervals.
    """
    accumulation = jnp.sum(weights)
    middles = 0.5 * (edges[1:] + edges[:-1])
    mean = numerics.safe_divide(jnp.sum(weights * middles), accumulation)
    half = jnp.full((1,), 0.5, weights.dtype)
    level = numerics.safe_divide(half, accumulation[None])
    median = stepfun.invert_cumulative(level, edges, stepfun.cumulative(weights))[0]
    return Composite(
        rgb=jnp.sum(weights[:, None] * rgb, axis=0),
        accumulation=accumulation,
        median=jnp.where(accumulation >= 0.5, median, jnp.inf),
        mean=jnp.where(accumulation > 0.0, mean, jnp.inf),
    )
