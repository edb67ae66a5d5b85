"""Pictures of a surface and its distance to the true one, drawn with matplotlib."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, TwoSlopeNorm

from experiments.figures.style import pyplot

DPI = 110

# Inches of a view, and of the scales beside it.
_VIEW = 2.4
_SCALES = 1.5

_DISTANCES, _ANGLES = "RdBu_r", "YlOrRd"

# Scales end at the value that so many percent of the pixels stay below, but at least here.
_MOST = 99.0
_LEAST_ANGLE = 1.0
_LEAST_DISTANCE = 0.05


class SurfaceView(NamedTuple):
    """What one camera sees of the surface, and of the true one.

    Attributes:
      name: of the view.
      image: the photograph, 8-bit sRGB, in any size, but square as all are.
      normals: in the camera's frame, zero where nothing is seen.
      true_normals: of the true surface, or `None` if there is none.
      distance: from the true surface, positive outside, in percent of its diameter; NaN where
        nothing is seen; or `None`.
    """

    name: str
    image: UInt8[np.ndarray, "ih iw 3"]
    normals: Float[np.ndarray, "h w 3"]
    true_normals: Float[np.ndarray, "h w 3"] | None = None
    distance: Float[np.ndarray, "h w"] | None = None


def draw_surface(path: Path, views: Sequence[SurfaceView]) -> None:
    """Draws views as rows: photograph and normals, and beside a true surface the errors of both."""
    compared = all(view.true_normals is not None for view in views)
    titles = ["photograph", "normals"]
    titles += ["true normals", "angle between", "distance to the truth"] * compared
    figure, axes = pyplot.subplots(
        len(views),
        len(titles),
        figsize=(_VIEW * len(titles) + _SCALES * compared, _VIEW * len(views) + 0.4),
        squeeze=False,
        layout="constrained",
    )
    for axis in axes.flat:
        axis.set_xticks([])
        axis.set_yticks([])
        axis.spines[:].set_visible(False)
    for axis, title in zip(axes[0], titles, strict=True):
        axis.set_title(title, fontsize=10)
    for row, view in zip(axes, views, strict=True):
        row[0].imshow(view.image)
        row[0].set_ylabel(view.name, fontsize=9)
        row[1].imshow(colour_normals(view.normals))
    if compared:
        _draw_errors_of_surfaces(figure, axes, views)
    figure.savefig(path, dpi=DPI)
    pyplot.close(figure)


def colour_normals(normals: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Returns normals as colours: x is red, y green, towards the viewer blue; none is white."""
    seen = np.any(normals != 0.0, axis=-1, keepdims=True)
    return np.where(seen, np.clip(0.5 + 0.5 * normals, 0.0, 1.0), 1.0)


def angles_between(view: SurfaceView) -> Float[np.ndarray, "h w"]:
    """Returns the angle in degrees between both normals, NaN where one is missing."""
    both = np.any(view.normals != 0.0, axis=-1) & np.any(view.true_normals != 0.0, axis=-1)
    cosine = np.clip(np.sum(view.normals * view.true_normals, axis=-1), -1.0, 1.0)
    return np.where(both, np.degrees(np.arccos(cosine)), np.nan)


def _draw_errors_of_surfaces(
    figure: pyplot.Figure, axes: np.ndarray, views: Sequence[SurfaceView]
) -> None:
    angles = [angles_between(view) for view in views]
    distances = [view.distance for view in views]
    most_angle = max(_LEAST_ANGLE, _most(angles))
    most = max(_LEAST_DISTANCE, _most([np.abs(distance) for distance in distances]))
    angle_scale = ScalarMappable(Normalize(0.0, most_angle), _ANGLES)
    distance_scale = ScalarMappable(TwoSlopeNorm(0.0, -most, most), _DISTANCES)
    for row, view, angle in zip(axes, views, angles, strict=True):
        row[2].imshow(colour_normals(view.true_normals))
        row[3].imshow(_coloured(angle, angle_scale))
        row[4].imshow(_shaded(_coloured(view.distance, distance_scale), view.normals))
    ends = {"shrink": 0.7, "aspect": 26, "pad": 0.02}
    figure.colorbar(angle_scale, ax=axes[:, 3], label="degrees", extend="max", **ends)
    figure.colorbar(
        distance_scale,
        ax=axes[:, 4],
        label="% of the diameter, positive outside",
        extend="both",
        **ends,
    )


def _coloured(
    values: Float[np.ndarray, "h w"], scale: ScalarMappable
) -> Float[np.ndarray, "h w 3"]:
    known = np.isfinite(values)
    rgb = matplotlib.colormaps[scale.cmap.name](scale.norm(np.where(known, values, 0.0)))
    return np.where(known[..., None], np.asarray(rgb)[..., :3], 1.0)


def _shaded(
    rgb: Float[np.ndarray, "h w 3"], normals: Float[np.ndarray, "h w 3"]
) -> Float[np.ndarray, "h w 3"]:
    """Darkens a surface a little where it turns away, so that its shape is seen."""
    seen = np.any(normals != 0.0, axis=-1, keepdims=True)
    return np.where(seen, rgb * (0.65 + 0.35 * np.clip(normals[..., 2:], 0.0, 1.0)), rgb)


def _most(values: Sequence[Float[np.ndarray, "h w"]]) -> float:
    known = np.concatenate([value[np.isfinite(value)] for value in values])
    return float(np.percentile(known, _MOST)) if known.size else 0.0
