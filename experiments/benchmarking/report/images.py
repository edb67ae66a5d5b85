"""Downsamples, colours and compresses images, and embeds them in a page as text.

The figure of a view shows the reference and each method next to each other: image, error and
distance.
"""

import base64
import io
from collections.abc import Sequence
from typing import NamedTuple

import matplotlib
import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image

from experiments.benchmarking.report import markup
from experiments.benchmarking.report.data import Scene, View
from experiments.benchmarking.report.markup import Html, join, tag

# Quality of WebP: above it the size of a 100 x 100 image grows without a visible gain.
_QUALITY = 82

_STOPS = 12

_GREY = 128.0

_DISTANCES = "viridis"

TRUTH = "truth"
"""Name of the reference image among those of methods."""

NOT_HERE = "image not available"

Places = dict[tuple[str, str, str], str]
"""Identifiers of a page's images, by view, method (or `TRUTH`) and kind."""

IMAGE, ERROR, MASK, DISTANCE = "image", "error", "object's mask", "distance"
"""Kinds of images."""


class Scale(NamedTuple):
    """A colour scale.

    Attributes:
      low: value of the first colour.
      high: value of the last colour, to which larger values are clipped.
      colours: name of matplotlib's colour map.
    """

    low: float
    high: float
    colours: str


ERRORS = Scale(0.0, 0.25, "magma")
"""Scale of errors: the mean over the channels of the absolute difference of sRGB in `[0, 1]`."""


def error_map(
    rendered: UInt8[np.ndarray, "h w 3"], target: UInt8[np.ndarray, "h w 3"], edge: int
) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Colours the error of a rendering on the scale `ERRORS`, at the size of the page.

    Downsampling averages the errors, not their colours.
    """
    error = np.mean(np.abs(rendered.astype(np.float32) - target.astype(np.float32)), axis=-1)
    image = Image.fromarray(error / 255.0)
    return colour(np.asarray(image.resize(_size(image, edge), Image.Resampling.BOX)), ERRORS)


def distance_map(
    distances: Float[np.ndarray, "h w"], scale: Scale, edge: int
) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Colours distances at the size of the page.

    Downsampling takes nearest neighbours: the mean of two distances may be on no surface.
    """
    image = Image.fromarray(distances.astype(np.float32))
    return colour(np.asarray(image.resize(_size(image, edge), Image.Resampling.NEAREST)), scale)


def colour(values: Float[np.ndarray, "h w"], scale: Scale) -> UInt8[np.ndarray, "h w 3"]:
    """Maps values to colours; values that are not finite are grey."""
    known = np.isfinite(values)
    places = (np.where(known, values, scale.low) - scale.low) / (scale.high - scale.low)
    rgb = matplotlib.colormaps[scale.colours](np.clip(places, 0.0, 1.0))[..., :3] * 255.0
    return np.round(np.where(known[..., None], rgb, _GREY)).astype(np.uint8)


def dim_outside(
    pixels: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Returns an image that is nearly grey outside a mask."""
    pale = 0.8 * _GREY + 0.2 * pixels
    return np.round(np.where(mask[..., None], pixels, pale)).astype(np.uint8)


def distance_scale(
    truth: Float[np.ndarray, "h w"] | None, rendered: Sequence[Float[np.ndarray, "h w"]]
) -> Scale | None:
    """Returns a scale for all distances of a view: that of the true ones, if they exist.

    It spans their first to their 99th percentile. `None` if no distance is finite.
    """
    for source in ([] if truth is None else [truth], rendered):
        finite = [values[np.isfinite(values)] for values in source]
        known = np.concatenate(finite) if finite else np.empty(0)
        if known.size:
            low, high = np.percentile(known, (1.0, 99.0))
            return Scale(float(low), float(max(high, low + 1e-3)), _DISTANCES)
    return None


def gradient(scale: Scale) -> str:
    """Returns the colours of a scale, from left to right, as a CSS gradient."""
    steps = np.linspace(scale.low, scale.high, _STOPS)[None]
    stops = ", ".join(f"rgb({r} {g} {b})" for r, g, b in colour(steps, scale)[0].tolist())
    return f"linear-gradient(to right, {stops})"


def _size(image: Image.Image, edge: int) -> tuple[int, int]:
    share = min(1.0, edge / max(image.size))
    return max(1, round(image.width * share)), max(1, round(image.height * share))


class Shown(NamedTuple):
    """HTML of a view, or of a scene with all of its views.

    Attributes:
      html: markup.
      places: identifiers of the images.
    """

    html: Html
    places: Places


def show(view: View, scene: Scene, edge: int, prefix: str) -> Shown:
    """Returns a view: a group of images for the reference and for each method.

    Args:
      view: data of the view.
      scene: scene with its results.
      edge: longest edge of an image, pixels.
      prefix: prefix of the identifiers of its images, unique in the page.
    """
    rendered = [image.distance for image in view.rendered.values() if image.distance is not None]
    scale = distance_scale(view.truth.distance, rendered)
    places: Places = {}
    groups = []
    for method in (TRUTH, *view.rendered):
        shown = []
        for kind, pixels in _drawn(view, method, scale, edge).items():
            key = (view.name, method, kind)
            if pixels is not None:
                places[key] = f"{prefix}p{len(places)}"
            shown.append(_picture(pixels, edge, places.get(key), key))
        heading = tag("h4", title(method), _caption(scene, view.name, method))
        groups.append(tag("div", heading, *shown, class_="group"))
    html = tag(
        "article",
        tag("h4", f"View {view.name}"),
        tag("div", *groups, class_="groups", tabindex="0"),
        _legends(scale),
        data_view=view.name,
    )
    return Shown(html, places)


def title(method: str) -> str:
    """Returns the title of a method, or of the reference."""
    return "ground truth" if method == TRUTH else method


def _drawn(
    view: View, method: str, scale: Scale | None, edge: int
) -> dict[str, UInt8[np.ndarray, "h w 3"] | None]:
    """Returns the images of a method by kind, `None` for missing ones.

    The reference has no error; its mask is shown instead.
    """
    image = view.truth if method == TRUTH else view.rendered[method]
    target, second = view.truth.rgb, None
    if method == TRUTH and target is not None and view.mask is not None:
        second = dim_outside(target, view.mask)
    elif method != TRUTH and target is not None and image.rgb is not None:
        second = error_map(image.rgb, target, edge)
    distance = None
    if scale is not None and image.distance is not None:
        distance = distance_map(image.distance, scale, edge)
    return {IMAGE: image.rgb, MASK if method == TRUTH else ERROR: second, DISTANCE: distance}


def _picture(
    pixels: UInt8[np.ndarray, "h w 3"] | None,
    edge: int,
    place: str | None,
    key: tuple[str, str, str],
) -> Html:
    """Returns an image, downsampled to a longest edge."""
    view, method, kind = key
    if pixels is None:
        return tag("figure", tag("p", NOT_HERE, class_="absent"), tag("figcaption", kind))
    thumbnail = Image.fromarray(pixels)
    thumbnail = thumbnail.resize(_size(thumbnail, edge), Image.Resampling.BOX)
    file = io.BytesIO()
    thumbnail.save(file, "WEBP", quality=_QUALITY)
    image = tag(
        "img",
        src=f"data:image/webp;base64,{base64.b64encode(file.getvalue()).decode('ascii')}",
        width=thumbnail.width,
        height=thumbnail.height,
        id=place,
        alt=f"{kind} of {view}, {title(method)}",
        data_key=method if kind == IMAGE else None,
    )
    return tag("figure", image, tag("figcaption", kind))


def _caption(scene: Scene, view: str, method: str) -> Html | None:
    images = [
        image
        for result in scene.results
        if result.record.method == method
        for image in result.record.per_image
        if image.name == view
    ]
    if not images:
        return None
    psnr, masked = (markup.number(images[0].metrics.get(key), 1) for key in ("psnr", "psnr_masked"))
    return join([tag("small", f"PSNR {psnr} dB"), " ", tag("small", f"in mask {masked} dB")])


def _legends(scale: Scale | None) -> Html:
    """Returns the legends of errors and distances."""
    parts = [_legend("error of sRGB in 0 to 1", ERRORS)]
    if scale is not None:
        parts.append(_legend("distance in this view, world units", scale))
    return tag("div", *parts, class_="legends")


def _legend(name: str, scale: Scale) -> Html:
    ramp = tag("span", class_="ramp", style=f"background:{gradient(scale)}")
    bounds = tag("span", f"{scale.low:.3g} ", ramp, f" {scale.high:.3g} and more")
    return tag("p", f"{name}: ", bounds)
