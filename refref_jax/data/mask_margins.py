"""Masks without the pixels at their outlines, which see both sides (NumPy only)."""

import numpy as np
from jaxtyping import Bool
from scipy.ndimage import binary_dilation, binary_erosion

Masks = Bool[np.ndarray, "frames h w"]

# Neighbours within an image, corners included, and none in another one.
_AROUND = np.ones((1, 3, 3), bool)


def well_inside(masks: Masks, *, margin: int = 1) -> Masks:
    """Returns the pixels that are so many pixels inside of a mask, and of the image."""
    return binary_erosion(masks, _AROUND, iterations=margin) if margin else masks


def well_outside(masks: Masks, *, margin: int = 2) -> Masks:
    """Returns the pixels that are so many pixels away from a mask."""
    return ~(binary_dilation(masks, _AROUND, iterations=margin) if margin else masks)
