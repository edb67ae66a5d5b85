"""Training losses. Each takes one path or one batch of colours and returns a scalar.

Rendered colours are compared without clipping: colours below black or above white have gradients
that move them back, and black pixels have the slope 12.92 of the transfer function (see
`render.colour`). Fields return colours in `[-0.001, 1.001]`, so that their sigmoid has a non-zero
slope at black and white.

Letters: `s` is the normalised distance along a path, `w` its weights (see `sampling.stepfun`).
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from refref_jax.render.transport import Histogram
from refref_jax.sampling import stepfun

_CHARBONNIER_PADDING = 0.001

# Keeps the loss finite if a proposal is empty where the final histogram is not (Zip-NeRF).
_INTERLEVEL_PADDING = 1e-5


def mean_squared_error(
    rendered: Float[Array, "rays 3"], target: Float[Array, "rays 3"]
) -> Float[Array, ""]:
    """Returns the mean squared error over pixels and channels (paper, photometric loss)."""
    return jnp.mean(jnp.square(rendered - target))


def charbonnier(
    rendered: Float[Array, "rays 3"], target: Float[Array, "rays 3"]
) -> Float[Array, ""]:
    """Returns the mean of `sqrt(e^2 + 0.001^2)`, which is robust to outliers (Zip-NeRF)."""
    return jnp.mean(jnp.sqrt(jnp.square(rendered - target) + _CHARBONNIER_PADDING**2))


def interlevel(final: Histogram, proposal: Histogram, *, blur: float) -> Float[Array, ""]:
    """Penalises a proposal that is lower than the final histogram of a path.

    The final histogram is blurred by a box of half-width `blur` before the comparison, so that the
    loss is smooth when a surface moves past the proposal's edges. Only the proposal receives
    gradients.

    Source: Barron et al., Zip-NeRF (2023), section 3 (anti-aliased interlevel loss).
    """
    edges, weights = jax.lax.stop_gradient(final)
    below = stepfun.blurred_mass_below(proposal.edges, edges, weights, blur)
    target = jax.lax.stop_gradient(jnp.diff(below))
    shortfall = jnp.maximum(target - proposal.weights, 0.0)
    return jnp.sum(jnp.square(shortfall) / (proposal.weights + _INTERLEVEL_PADDING))


def distortion(final: Histogram, outside: Bool[Array, " samples"]) -> Float[Array, ""]:
    """Concentrates the weights of a path, over the samples outside the objects only.

    The loss is `sum_ij w_i w_j |m_i - m_j| + 1/3 sum_i w_i^2 delta_i`, over intervals with middle
    `m` and width `delta` for which `outside` holds. Inside a translucent object, light may come
    from everywhere, and the original loss would empty it.

    Source: paper (arXiv 2505.05848), corrected distortion loss; Mip-NeRF 360 (2022), Eq 15.
    """
    weights = jnp.where(outside, final.weights, 0.0)
    middles = 0.5 * (final.edges[1:] + final.edges[:-1])
    apart = jnp.abs(middles[:, None] - middles[None, :])
    between = jnp.sum(weights * jnp.sum(weights[None, :] * apart, axis=-1))
    within = jnp.sum(jnp.square(weights) * jnp.diff(final.edges)) / 3.0
    return between + within


def hash_decay(tables: Sequence[Float[Array, "_ _"]]) -> Float[Array, ""]:
    """Returns the sum over levels of the mean squared entry.

    The mean per level gives more weight to the entries of coarse levels, which have few.

    Source: Barron et al., Zip-NeRF (2023), section 2 (normalised weight decay).
    """
    return sum((jnp.mean(jnp.square(table)) for table in tables), jnp.zeros(()))
