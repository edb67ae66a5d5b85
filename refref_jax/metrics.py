"""Measures of a rendered image against the true one. Images are sRGB in `[0, 1]`."""

import dm_pix
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def psnr(rendered: Float[Array, "h w 3"], target: Float[Array, "h w 3"]) -> Float[Array, ""]:
    """Returns the peak signal-to-noise ratio in dB; `inf` for equal images."""
    return dm_pix.psnr(rendered, target)


def psnr_masked(
    rendered: Float[Array, "h w 3"],
    target: Float[Array, "h w 3"],
    mask: Bool[Array, "h w"],
) -> Float[Array, ""]:
    """Returns the PSNR over the pixels of a mask in dB; NaN for an empty one.

    Source: paper (arXiv 2505.05848), section 5 (PSNR_M).
    """
    squared = jnp.where(mask[..., None], jnp.square(rendered - target), 0.0)
    error = jnp.sum(squared) / (3.0 * jnp.sum(mask, dtype=rendered.dtype))
    return -10.0 * jnp.log10(error)


def ssim(rendered: Float[Array, "h w 3"], target: Float[Array, "h w 3"]) -> Float[Array, ""]:
    """Returns the structural similarity with an 11 x 11 Gaussian window of sigma 1.5."""
    return dm_pix.ssim(rendered, target)


def mean_absolute_error(
    rendered: Float[Array, "h w"], target: Float[Array, "h w"], mask: Bool[Array, "h w"]
) -> Float[Array, ""]:
    """Returns the mean error of distances over a mask, in world units; NaN for an empty mask.

    Source: paper (arXiv 2505.05848), section 5 (DMAE).
    """
    error = jnp.where(mask, jnp.abs(rendered - jnp.where(mask, target, 0.0)), 0.0)
    count = jnp.sum(mask, dtype=rendered.dtype)
    return jnp.where(count > 0, jnp.sum(error) / count, jnp.nan)
