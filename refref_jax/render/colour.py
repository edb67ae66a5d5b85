"""Conversion between linear RGB, in which light is summed, and sRGB, in which images are stored."""

import jax.numpy as jnp
from jaxtyping import Array, Float

# Thresholds between the linear and the power segment of the transfer function.
_LINEAR_KNEE = 0.0031308
_SRGB_KNEE = 0.04045


def linear_to_srgb(linear: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Applies the sRGB opto-electronic transfer function; 0 maps to 0 and 1 to 1.

    Negative values use the linear segment and values above 1 the power segment, so that neither
    value nor gradient is clipped. The gradient is finite everywhere: 12.92 at and below 0.

    Source: IEC 61966-2-1.
    """
    curved = linear > _LINEAR_KNEE
    power = jnp.where(curved, linear, 1.0) ** (1.0 / 2.4)
    return jnp.where(curved, 1.055 * power - 0.055, 12.92 * linear)


def srgb_to_linear(srgb: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Inverts `linear_to_srgb`."""
    curved = srgb > _SRGB_KNEE
    power = ((jnp.where(curved, srgb, 1.0) + 0.055) / 1.055) ** 2.4
    return jnp.where(curved, power, srgb / 12.92)
