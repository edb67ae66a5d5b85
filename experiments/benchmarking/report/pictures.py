"""Pictures of a page: reduced, coloured, compressed, and written into it as text."""

import base64
import io
from collections.abc import Sequence
from typing import NamedTuple

import matplotlib
import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image

# Of WebP: beyond it a picture of 100 x 100 grows faster than the eye gains.
_QUALITY = 82

_STOPS = 12

_GREY = 128.0


class Scale(NamedTuple):
    """What colours stand for.

    Attributes:
      low: value of the first colour.
      high: value of the last; what is beyond has it too.
      colours: name of matplotlib's colour map.
    """

    low: float
    high: float
    colours: str


ERRORS = Scale(0.0, 0.25, "magma")
"""Of errors: the mean over the channels of the absolute difference of sRGB in `[0, 1]`."""

_DISTANCES = "viridis"


class Embedded(NamedTuple):
    """A picture as a page has it.

    Attributes:
      uri: the picture itself, as a data URI.
      width: in pixels.
      height: in pixels.
    """

    uri: str
    width: int
    height: int


def embed(pixels: UInt8[np.ndarray, "h w 3"], edge: int) -> Embedded:
    """Returns a picture, reduced to a longest edge where it is longer."""
    image = Image.fromarray(pixels)
    image = image.resize(_size(image, edge), Image.Resampling.BOX)
    file = io.BytesIO()
    image.save(file, "WEBP", quality=_QUALITY)
    data = base64.b64encode(file.getvalue()).decode("ascii")
    return Embedded(f"data:image/webp;base64,{data}", *image.size)


def error_map(
    rendered: UInt8[np.ndarray, "h w 3"], target: UInt8[np.ndarray, "h w 3"], edge: int
) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Colours the error of a rendering on the scale `ERRORS`, as large as it will be shown.

    Errors are averaged where the picture is reduced, not their colours.
    """
    error = np.mean(np.abs(rendered.astype(np.float32) - target.astype(np.float32)), axis=-1)
    image = Image.fromarray(error / 255.0)
    return colour(np.asarray(image.resize(_size(image, edge), Image.Resampling.BOX)), ERRORS)


def distance_map(
    distances: Float[np.ndarray, "h w"], scale: Scale, edge: int
) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Colours distances, as large as they will be shown.

    Where the picture is reduced one distance stands for its neighbours: there is none between two.
    """
    image = Image.fromarray(distances.astype(np.float32))
    return colour(np.asarray(image.resize(_size(image, edge), Image.Resampling.NEAREST)), scale)


def colour(values: Float[np.ndarray, "h w"], scale: Scale) -> UInt8[np.ndarray, "h w 3"]:
    """Colours values; what is not finite is grey."""
    known = np.isfinite(values)
    places = (np.where(known, values, scale.low) - scale.low) / (scale.high - scale.low)
    rgb = matplotlib.colormaps[scale.colours](np.clip(places, 0.0, 1.0))[..., :3] * 255.0
    return np.round(np.where(known[..., None], rgb, _GREY)).astype(np.uint8)


def dim_outside(
    pixels: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Returns a picture that is nearly grey outside a mask."""
    pale = 0.8 * _GREY + 0.2 * pixels
    return np.round(np.where(mask[..., None], pixels, pale)).astype(np.uint8)


def distance_scale(
    truth: Float[np.ndarray, "h w"] | None, rendered: Sequence[Float[np.ndarray, "h w"]]
) -> Scale | None:
    """Returns a scale for all distances of a view: that of the true ones, if there are any.

    It goes from their first to their 99th percentile. `None` if nothing is at a finite distance.
    """
    for source in ([] if truth is None else [truth], rendered):
        finite = [values[np.isfinite(values)] for values in source]
        known = np.concatenate(finite) if finite else np.empty(0)
        if known.size:
            low, high = np.percentile(known, (1.0, 99.0))
            return Scale(float(low), float(max(high, low + 1e-3)), _DISTANCES)
    return None


def gradient(scale: Scale) -> str:
    """Returns the colours of a scale, from left to right, as CSS has them."""
    steps = np.linspace(scale.low, scale.high, _STOPS)[None]
    stops = ", ".join(f"rgb({r} {g} {b})" for r, g, b in colour(steps, scale)[0].tolist())
    return f"linear-gradient(to right, {stops})"


def _size(image: Image.Image, edge: int) -> tuple[int, int]:
    share = min(1.0, edge / max(image.size))
    return max(1, round(image.width * share)), max(1, round(image.height * share))
