"""How near the colours of an image are to the true ones, pixel by pixel and window by window.

Images are sRGB in `[0, 1]`, as they are shown. In float32, means of a bright and nearly flat image
have no digits left for its variance (an SSIM of two flat images was 1e-4 off), so whoever reports
these numbers calls them in double precision.
"""

import dm_pix
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

SMALLEST_FOR_SSIM = 11
"""Edge of SSIM's window: an image that it does not fit into has no SSIM."""


def psnr(rendered: Float[Array, "h w 3"], target: Float[Array, "h w 3"]) -> Float[Array, ""]:
    """Returns the peak signal-to-noise ratio in dB, `-10 log10(mean((rendered - target)^2))`.

    The mean is over pixels and channels, the peak is 1. From 0 for images in `[0, 1]` to `inf` for
    equal ones; more is better.
    """
    return dm_pix.psnr(rendered, target)


def psnr_masked(
    rendered: Float[Array, "h w 3"],
    target: Float[Array, "h w 3"],
    mask: Bool[Array, "h w"],
) -> Float[Array, ""]:
    """Returns the PSNR over the pixels of a mask in dB.

    As `psnr`, with the mean over the mask's pixels and their channels alone: `inf` where they are
    equal, NaN for an empty mask. Over images, the paper's PSNR_M is the mean of these.

    Source: paper (arXiv 2505.05848), section 5 (PSNR_M).
    """
    squared = jnp.where(mask[..., None], jnp.square(rendered - target), 0.0)
    error = jnp.sum(squared) / (3.0 * jnp.sum(mask, dtype=rendered.dtype))
    return -10.0 * jnp.log10(error)


def ssim(rendered: Float[Array, "h w 3"], target: Float[Array, "h w 3"]) -> Float[Array, ""]:
    """Returns the structural similarity, in `[-1, 1]`: 1 for equal images, more is better.

    With means `m`, variances `v` and the covariance `c` of both images under a window,

        (2 m_a m_b + 0.01^2) (2 c + 0.03^2) / ((m_a^2 + m_b^2 + 0.01^2) (v_a + v_b + 0.03^2)),

    averaged over channels and over all windows that fit into the image. The window is a Gaussian of
    sigma 1.5 on 11 x 11 pixels; the data range is 1.

    Source: Wang, Bovik, Sheikh, Simoncelli, Image Quality Assessment, IEEE TIP 13(4), 2004.

    Raises:
      ValueError: if the image is smaller than the window.
    """
    height, width, _ = rendered.shape
    if min(height, width) < SMALLEST_FOR_SSIM:
        raise ValueError(
            f"An image of {width} x {height} pixels has no SSIM: its window is "
            f"{SMALLEST_FOR_SSIM} x {SMALLEST_FOR_SSIM}. Give larger images."
        )
    return dm_pix.ssim(rendered, target)
