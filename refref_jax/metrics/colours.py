"""Colour metrics: PSNR, masked PSNR and SSIM.

Images are sRGB in `[0, 1]`. In float32, the variance of a bright and nearly constant image is lost
to rounding (the SSIM of two constant images had an error of 1e-4), so use double precision for
reported numbers.
"""

import dm_pix
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

SMALLEST_FOR_SSIM = 11
"""Edge of SSIM's window in pixels; SSIM is undefined for smaller images."""


def psnr(rendered: Float[Array, "h w 3"], target: Float[Array, "h w 3"]) -> Float[Array, ""]:
    """Returns the peak signal-to-noise ratio in dB, `-10 log10(mean((rendered - target)^2))`.

    The mean is over pixels and channels, the peak is 1. At least 0 for images in `[0, 1]`, and
    `inf` for equal images; higher is better.
    """
    return dm_pix.psnr(rendered, target)


def psnr_masked(
    rendered: Float[Array, "h w 3"],
    target: Float[Array, "h w 3"],
    mask: Bool[Array, "h w"],
) -> Float[Array, ""]:
    """Returns the PSNR over the pixels of a mask in dB.

    As `psnr`, with the mean over the channels of the mask's pixels only: `inf` if they are equal,
    NaN for an empty mask. The paper's PSNR_M is the mean of this metric over images.

    Source: paper (arXiv 2505.05848), section 5 (PSNR_M).
    """
    squared = jnp.where(mask[..., None], jnp.square(rendered - target), 0.0)
    error = jnp.sum(squared) / (3.0 * jnp.sum(mask, dtype=rendered.dtype))
    return -10.0 * jnp.log10(error)


def ssim(rendered: Float[Array, "h w 3"], target: Float[Array, "h w 3"]) -> Float[Array, ""]:
    """Returns the structural similarity, in `[-1, 1]`: 1 for equal images, higher is better.

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
            f"SSIM is undefined for an image of {width} x {height} pixels: its window is "
            f"{SMALLEST_FOR_SSIM} x {SMALLEST_FOR_SSIM}. Give larger images."
        )
    return dm_pix.ssim(rendered, target)
