"""Colours, and light on reliefs.

Colours are sRGB values from 0 to 1, as stored in files. The unit of heights is the edge of the
image.
"""

import numpy as np
import scipy.ndimage
from jaxtyping import Float

from experiments.dataset.textures.fields import Field, Picture

_LIGHT = (-0.45, -0.55, 0.7)
_AMBIENT = 0.3


def colour(code: str) -> Float[np.ndarray, "3"]:
    """Returns the colour of a code such as `#c04020`."""
    return np.array([int(code[at : at + 2], 16) for at in (1, 3, 5)], np.float32) / 255.0


def colours(*codes: str) -> Float[np.ndarray, "colours 3"]:
    """Returns the colours of codes."""
    return np.stack([colour(code) for code in codes])


def graded(values: np.ndarray, *stops: tuple[float, str]) -> np.ndarray:
    """Returns colours for values: linear between stops in ascending order."""
    positions = [position for position, _ in stops]
    table = colours(*(code for _, code in stops))
    channels = [np.interp(values, positions, table[:, each]) for each in range(3)]
    return np.stack(channels, -1).astype(np.float32)


def chosen(share: np.ndarray, *codes: str) -> np.ndarray:
    """Returns one of the colours for each share from 0 to 1, split into equal intervals."""
    index = np.minimum((share * len(codes)).astype(np.int32), len(codes) - 1)
    return colours(*codes)[index]


def lit(picture: Picture, height: Field, *, gloss: float = 0.0, shininess: float = 30.0) -> Picture:
    """Returns an image as a relief lit from the upper left; flat areas are unchanged.

    Args:
      picture: colours without light.
      height: height of the relief.
      gloss: strength of highlights.
      shininess: exponent of highlights (Blinn and Phong).
    """
    n = height.shape[0]
    slope_y, slope_x = np.gradient(height * np.float32(n))
    length = np.sqrt(slope_x**2 + slope_y**2 + 1.0)
    light = np.asarray(_LIGHT, np.float32) / np.float32(np.linalg.norm(_LIGHT))
    towards = (-slope_x * light[0] - slope_y * light[1] + light[2]) / length
    bright = _AMBIENT + (1.0 - _AMBIENT) * np.maximum(towards, 0.0) / light[2]
    result = picture * bright[..., None]
    if gloss:
        half = light + np.array([0.0, 0.0, 1.0], np.float32)
        half /= np.linalg.norm(half)
        facing = (-slope_x * half[0] - slope_y * half[1] + half[2]) / length
        result = result + (gloss * np.maximum(facing, 0.0) ** shininess)[..., None]
    return result


def hollows(height: Field, radius: float, *, strength: float) -> Field:
    """Returns a factor below 1 where a relief is lower than its surroundings within `radius`."""
    around = scipy.ndimage.gaussian_filter(height, radius * height.shape[0], truncate=2.5)
    return np.exp(-strength * np.maximum(around - height, 0.0) / radius)


def linear(picture: np.ndarray) -> np.ndarray:
    """Returns linear RGB of sRGB values."""
    low = picture / 12.92
    return np.where(picture <= 0.04045, low, ((np.maximum(picture, 0.0) + 0.055) / 1.055) ** 2.4)
