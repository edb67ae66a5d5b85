"""Comparison figures, drawn with matplotlib."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
from jaxtyping import Float, UInt8

matplotlib.use("Agg")
from matplotlib import pyplot

_COLOUR_MAP = "turbo"

ERROR_GAIN = 4.0
"""Amplification of colour errors."""

_INCHES = 2.4
_INCHES_OF_THE_SCALE = 1.1


class Comparison(NamedTuple):
    """One view, true and rendered.

    Attributes:
      name: name of the view.
      target: true sRGB in `[0, 1]`.
      rgb: rendered sRGB in `[0, 1]`.
      distance: rendered distance, world units; `None` for all views, or for none.
    """

    name: str
    target: Float[np.ndarray, "h w 3"]
    rgb: Float[np.ndarray, "h w 3"]
    distance: Float[np.ndarray, "h w"] | None = None


def write_comparison(path: Path, views: Sequence[Comparison]) -> None:
    """Draws views as rows: ground truth, render, error, and distance if available.

    Distances share one scale, from 0 to the largest finite one.
    """
    titles = ["ground truth", "render", f"error x {ERROR_GAIN:g}"]
    distances = [view.distance for view in views if view.distance is not None]
    titles += ["distance"] * bool(distances)
    figure, axes = pyplot.subplots(
        len(views),
        len(titles),
        figsize=(
            _INCHES * len(titles) + _INCHES_OF_THE_SCALE * bool(distances),
            _INCHES * len(views) + 0.4,
        ),
        squeeze=False,
        layout="constrained",
    )
    for row, view in zip(axes, views, strict=True):
        row[0].imshow(view.target)
        row[1].imshow(view.rgb)
        row[2].imshow(amplified_error(view.rgb, view.target))
        row[0].set_ylabel(view.name)
        for axis in row:
            axis.set_xticks([])
            axis.set_yticks([])
    for axis, title in zip(axes[0], titles, strict=True):
        axis.set_title(title)
    if distances:
        farthest = max(map(_largest_finite, distances))
        for axis, distance in zip(axes[:, 3], distances, strict=True):
            shown = axis.imshow(distance, cmap=_COLOUR_MAP, vmin=0.0, vmax=farthest)
        figure.colorbar(shown, ax=axes[:, 3], shrink=0.6, label="world units")
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def amplified_error(
    rgb: Float[np.ndarray, "h w 3"], target: Float[np.ndarray, "h w 3"]
) -> Float[np.ndarray, "h w 3"]:
    """Returns the absolute error of each channel times `ERROR_GAIN`, clipped to `[0, 1]`."""
    return np.clip(np.abs(rgb - target) * ERROR_GAIN, 0.0, 1.0)


def colour_distances(
    distances: Sequence[Float[np.ndarray, "h w"]], *, farthest: float | None = None
) -> list[UInt8[np.ndarray, "h w 3"]]:
    """Colours distance maps on one scale from 0; misses are white.

    Args:
      distances: distance maps, world units.
      farthest: end of the scale, beyond which its last colour is used; the largest finite distance
        if not given.
    """
    if farthest is None:
        farthest = max(_largest_finite(distance) for distance in distances)
    coloured = []
    for distance in distances:
        known = np.isfinite(distance)
        rgb = matplotlib.colormaps[_COLOUR_MAP](np.where(known, distance, 0.0) / farthest)
        coloured.append(np.round(255.0 * np.where(known[..., None], rgb[..., :3], 1.0)))
    return [rgb.astype(np.uint8) for rgb in coloured]


def _largest_finite(values: Float[np.ndarray, "*shape"]) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.max()) if finite.size else 1.0
