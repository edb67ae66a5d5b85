"""The sRGB encoding in float64 NumPy, written from IEC 61966-2-1."""

import numpy as np


def srgb_to_linear(srgb):
    """Returns linear light (IEC 61966-2-1)."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(linear):
    """Returns the sRGB encoding of linear light (IEC 61966-2-1)."""
    held = np.maximum(linear, 0.0031308)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * held ** (1 / 2.4) - 0.055)
