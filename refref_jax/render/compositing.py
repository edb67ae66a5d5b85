"""Volume rendering of one path from its samples.

Letters, as in the paper (arXiv 2505.05848, section 4.1): interval `i` has density `sigma_i` and
length `delta_i`; `T_i = exp(-sum_{j<i} sigma_j delta_j)` is the light that reaches it and
`w_i = T_i (1 - exp(-sigma_i delta_i))` its share in the colour.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from refref_jax import numerics
from refref_jax.sampling import stepfun


class Composite(NamedTuple):
    """What a path sees.

    Attributes:
      rgb: linear colour.
      accumulation: share of light that the samples account for, in `[0, 1]`.
      median: distance that half of the light has come from; `inf` when less than half is
        accounted for. The paper's distance: it finds the nearest surface that matters, be it
        translucent.
      mean: mean distance of the light that is accounted for; `inf` when there is none.
    """

    rgb: Float[Array, "3"]
    accumulation: Float[Array, ""]
    median: Float[Array, ""]
    mean: Float[Array, ""]


def alpha_weights(
    density: Float[Array, " samples"], lengths: Float[Array, " samples"]
) -> Float[Array, " samples"]:
    """Returns the weights `w_i`, which sum to at most 1.

    Finite in value and gradient for any density and length in `[0, inf)` whose product does
    not overflow; the product may be infinite as long as it is not `0 * inf`. Edges that are a
    rounding error apart may come out of order: a length below 0 counts as 0, since a solid would
    make a weight of minus infinity of it.

    Source: paper, volume rendering equation.
    """
    depth = density * jnp.where(lengths < 0.0, 0.0, lengths)
    before = jnp.concatenate([jnp.zeros_like(depth[:1]), jnp.cumsum(depth[:-1])])
    return jnp.exp(-before) * -jnp.expm1(-depth)


def opaque_end(weights: Float[Array, " samples"]) -> Float[Array, " samples"]:
    """Gives the light that is left over to the last sample, as if it were opaque.

    The weights then sum to 1, however thin the field.
    """
    return weights.at[-1].set(jnp.maximum(1.0 - jnp.sum(weights[:-1]), 0.0))


def composite(
    weights: Float[Array, " samples"],
    rgb: Float[Array, "samples 3"],
    edges: Float[Array, " samples+1"],
) -> Composite:
    """Sums the samples of a path.

    Args:
      weights: `w_i`.
      rgb: linear colours.
      edges: distances at which the intervals begin and end.
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
