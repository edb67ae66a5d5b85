"""Distance metrics over the pixels of a mask: DMAE and DRMSE.

Distances are arc lengths along each pixel's ray, in world units. Values outside the mask may be
infinite or NaN. For several images, DMAE and DRMSE are means of the values per image.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from refref_jax.numerics import safe_divide, safe_sqrt


def mean_absolute_error(
    rendered: Float[Array, "h w"], target: Float[Array, "h w"], mask: Bool[Array, "h w"]
) -> Float[Array, ""]:
    """Returns the mean of `|rendered - target|` over a mask, in world units.

    At least 0, lower is better; NaN for an empty mask.

    Source: paper (arXiv 2505.05848), section 5 (DMAE).
    """
    return _mean_over(jnp.abs(_errors(rendered, target, mask)), mask)


def root_mean_square_error(
    rendered: Float[Array, "h w"], target: Float[Array, "h w"], mask: Bool[Array, "h w"]
) -> Float[Array, ""]:
    """Returns `sqrt(mean((rendered - target)^2))` over a mask, in world units.

    At least 0 and at least the mean absolute error, lower is better; NaN for an empty mask. If all
    distances are equal, the gradient is 0, where the plain formula gives NaN.

    Source: paper (arXiv 2505.05848), supplement, table of the farthest views (DRMSE).
    """
    mean = _mean_over(jnp.square(_errors(rendered, target, mask)), mask)
    return jnp.where(jnp.isnan(mean), mean, safe_sqrt(mean))


def _errors(
    rendered: Float[Array, "h w"], target: Float[Array, "h w"], mask: Bool[Array, "h w"]
) -> Float[Array, "h w"]:
    """Returns differences inside the mask, and 0 elsewhere."""
    return jnp.where(mask, rendered, 0.0) - jnp.where(mask, target, 0.0)


def _mean_over(values: Float[Array, "h w"], mask: Bool[Array, "h w"]) -> Float[Array, ""]:
    count = jnp.sum(mask, dtype=values.dtype)
    return jnp.where(count > 0, safe_divide(jnp.sum(values), count), jnp.nan)
