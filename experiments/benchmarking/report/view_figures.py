"""A view as the truth and each method have it: picture, error and distance, side by side."""

from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

from experiments.benchmarking.report import pictures, tables_shown
from experiments.benchmarking.report.data import Scene, View
from experiments.benchmarking.report.markup import Html, join, tag
from experiments.benchmarking.report.pictures import Scale

TRUTH = "truth"
"""What the true image is called, beside the names of methods."""

NOT_HERE = "picture not here"

Places = dict[tuple[str, str, str], str]
"""Identifiers of a page's pictures, by view, method (or `TRUTH`) and kind."""

IMAGE, ERROR, MASK, DISTANCE = "image", "error", "object's mask", "distance"
"""Kinds of pictures."""


class Figures(NamedTuple):
    """The pictures of a view, as a page has them.

    Attributes:
      html: what is shown.
      places: identifiers of the pictures.
    """

    html: Html
    places: Places


def show(view: View, scene: Scene, edge: int, prefix: str) -> Figures:
    """Returns a view: a group of pictures for the truth and for each method.

    Args:
      view: what was read of it.
      scene: with its results.
      edge: longest edge of a picture.
      prefix: of the identifiers of its pictures; no other view of the page may have it.
    """
    rendered = [image.distance for image in view.rendered.values() if image.distance is not None]
    scale = pictures.distance_scale(view.truth.distance, rendered)
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
    return Figures(html, places)


def title(method: str) -> str:
    """Returns what a method, or the truth, is called."""
    return "ground truth" if method == TRUTH else method


def _drawn(
    view: View, method: str, scale: Scale | None, edge: int
) -> dict[str, UInt8[np.ndarray, "h w 3"] | None]:
    """Returns the pictures of a method by their kinds, `None` for what is not there.

    The truth has no error: there its mask is shown.
    """
    image = view.truth if method == TRUTH else view.rendered[method]
    target, second = view.truth.rgb, None
    if method == TRUTH and target is not None and view.mask is not None:
        second = pictures.dim_outside(target, view.mask)
    elif method != TRUTH and target is not None and image.rgb is not None:
        second = pictures.error_map(image.rgb, target, edge)
    distance = None
    if scale is not None and image.distance is not None:
        distance = pictures.distance_map(image.distance, scale, edge)
    return {IMAGE: image.rgb, MASK if method == TRUTH else ERROR: second, DISTANCE: distance}


def _picture(
    pixels: UInt8[np.ndarray, "h w 3"] | None,
    edge: int,
    place: str | None,
    key: tuple[str, str, str],
) -> Html:
    view, method, kind = key
    if pixels is None:
        return tag("figure", tag("p", NOT_HERE, class_="absent"), tag("figcaption", kind))
    picture = pictures.embed(pixels, edge)
    image = tag(
        "img",
        src=picture.uri,
        width=picture.width,
        height=picture.height,
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
    psnr, masked = (
        tables_shown.number(images[0].metrics.get(key), 1) for key in ("psnr", "psnr_masked")
    )
    return join([tag("small", f"PSNR {psnr} dB"), " ", tag("small", f"in mask {masked} dB")])


def _legends(scale: Scale | None) -> Html:
    """Returns what the colours of errors and distances stand for."""
    parts = [_legend("error, of sRGB in 0 to 1", pictures.ERRORS)]
    if scale is not None:
        parts.append(_legend("distance in world units, of this view", scale))
    return tag("div", *parts, class_="legends")


def _legend(name: str, scale: Scale) -> Html:
    ramp = tag("span", class_="ramp", style=f"background:{pictures.gradient(scale)}")
    bounds = tag("span", f"{scale.low:.3g} ", ramp, f" {scale.high:.3g} and more")
    return tag("p", f"{name}: ", bounds)
