"""Draws the figures of the report on a reconstruction with matplotlib.

One shows masks and silhouettes, another the surface with its distance to the true one. Each shows
square windows around the object.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
from jaxtyping import Bool, Float, Num, Shaped, UInt8
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, TwoSlopeNorm, to_rgb
from matplotlib.patches import Patch

from experiments.figures.style import COLOURS, pyplot, style

AGREES, MISSING, EXCESS = COLOURS[5], COLOURS[1], COLOURS[3]
"""Colours of pixels in both mask and silhouette, only in the mask, and only in the silhouette."""

DPI = 110

# Inches of a thumbnail, and the largest number of pixels along its edge; columns of a contact
# sheet.
_THUMBNAIL = 1.25
_PIXELS = 136
_COLUMNS = 10

# Margin around the object, as a share of it.
_MARGIN = 0.12

# Remaining contrast of a photograph, and opacity of the colour of agreement on it.
_CONTRAST = 0.35
_TINT = 0.55

# Inches of a view, and of the colour bars next to it.
_VIEW = 2.4
_SCALES = 1.5

_DISTANCES, _ANGLES = "RdBu_r", "YlOrRd"

# Scales end at this percentile of the pixels, but not below the given minimum.
_MOST = 99.0
_LEAST_ANGLE = 1.0
_LEAST_DISTANCE = 0.05


class Window(NamedTuple):
    """A square of an image, in shares of its height, so that it fits images of any size.

    Attributes:
      top: position of the first row.
      left: position of the first column.
      side: length of the edge.
    """

    top: float
    left: float
    side: float


class Outline(NamedTuple):
    """Mask and silhouette in one view.

    Attributes:
      name: name of the view.
      image: photograph, 8-bit sRGB.
      mask: true where the object is visible.
      silhouette: true where the mesh is visible.
      overlap: IoU of mask and silhouette.
    """

    name: str
    image: UInt8[np.ndarray, "h w 3"]
    mask: Bool[np.ndarray, "h w"]
    silhouette: Bool[np.ndarray, "h w"]
    overlap: float


class SurfaceView(NamedTuple):
    """The surface and the true one, as seen by one camera.

    Attributes:
      name: name of the view.
      image: photograph, 8-bit sRGB, of any size, but square as all are.
      normals: normals in the camera's frame, zero where nothing is visible.
      true_normals: normals of the true surface, or `None` if there is none.
      distance: distance from the true surface, positive outside, in percent of its diameter; NaN
        where nothing is visible; or `None`.
    """

    name: str
    image: UInt8[np.ndarray, "ih iw 3"]
    normals: Float[np.ndarray, "h w 3"]
    true_normals: Float[np.ndarray, "h w 3"] | None = None
    distance: Float[np.ndarray, "h w"] | None = None


def windows_around(areas: Sequence[Bool[np.ndarray, "h w"]], *, margin: float) -> list[Window]:
    """Returns one window for each area, all of the same size, within the image.

    Args:
      areas: regions to show, of one size; the centre is used if one is empty.
      margin: margin around the largest of them, as a share of it.
    """
    height, width = areas[0].shape
    boxes = [_box(area) for area in areas]
    side = (1.0 + 2.0 * margin) * max(float(np.max(high - low)) for low, high in boxes)
    side = min(side, height, width)
    ends = np.asarray([height, width]) - side
    corners = [np.clip(0.5 * (low + high - side), 0.0, ends) / height for low, high in boxes]
    return [Window(float(top), float(left), side / height) for top, left in corners]


def crop(image: Shaped[np.ndarray, "h w *channels"], window: Window) -> np.ndarray:
    """Returns the part of an image in a window, rounded to pixels."""
    height = len(image)
    top, left = math.floor(window.top * height), math.floor(window.left * height)
    side = max(1, math.ceil(window.side * height))
    return image[top : top + side, left : left + side]


def shrink_any(area: Bool[np.ndarray, "h w"], stride: int) -> Bool[np.ndarray, "sh sw"]:
    """Downsamples an area by a stride; a pixel is set if any of its pixels is."""
    return _blocks(area, stride).any(axis=(1, 3))


def shrink(image: Num[np.ndarray, "h w 3"], stride: int) -> Num[np.ndarray, "sh sw 3"]:
    """Downsamples an image by a stride, as means."""
    return _blocks(image, stride).mean(axis=(1, 3))


def _blocks(image: Shaped[np.ndarray, "h w *channels"], stride: int) -> np.ndarray:
    """Splits an image into squares; the last pixel is repeated at its ends."""
    short = [-length % stride for length in image.shape[:2]]
    ends = [(0, short[0]), (0, short[1]), *[(0, 0)] * (image.ndim - 2)]
    padded = np.pad(image, ends, mode="edge")
    height, width, *channels = padded.shape
    return padded.reshape(height // stride, stride, width // stride, stride, *channels)


def _box(area: Bool[np.ndarray, "h w"]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the bounds of rows and columns of an area."""
    if not area.any():
        middle = 0.5 * np.asarray(area.shape)
        return middle, middle
    found = np.argwhere(area)
    return found.min(axis=0), found.max(axis=0) + 1


def draw_overlaps(path: Path, outlines: Sequence[Outline]) -> None:
    """Draws all views as a contact sheet of agreement, missing and excess pixels.

    Images too large for a thumbnail are downsampled without averaging wrong pixels away.
    """
    columns = min(_COLUMNS, len(outlines), max(4, math.ceil(math.sqrt(1.6 * len(outlines)))))
    rows = -(-len(outlines) // columns)
    figure, axes = pyplot.subplots(
        rows,
        columns,
        figsize=(columns * _THUMBNAIL, rows * (_THUMBNAIL + 0.2) + 0.45),
        squeeze=False,
        layout="constrained",
    )
    for axis in axes.flat:
        axis.axis("off")
    seen = [outline.mask | outline.silhouette for outline in outlines]
    around = windows_around(seen, margin=_MARGIN)
    for axis, outline, window in zip(axes.flat, outlines, around, strict=False):
        axis.imshow(colour_overlap(outline, window), interpolation="nearest")
        axis.set_title(f"{outline.name}  {outline.overlap:.4f}", fontsize=6.5, pad=2.5)
    named = {"in both": _tinted(), "mask only": MISSING, "silhouette only": EXCESS}
    figure.legend(
        handles=[Patch(color=colour, label=name) for name, colour in named.items()],
        loc="outside lower center",
        ncols=3,
        frameon=False,
        fontsize=8,
    )
    figure.savefig(path, dpi=DPI)
    pyplot.close(figure)


def colour_overlap(outline: Outline, window: Window) -> Float[np.ndarray, "ph pw 3"]:
    """Returns a grey window of the photograph, agreement tinted, errors in full colour."""
    image, mask, silhouette = (
        crop(each, window) for each in (outline.image, outline.mask, outline.silhouette)
    )
    stride = -(-max(mask.shape) // _PIXELS)
    grey = np.mean(shrink(image / 255.0, stride), axis=-1, keepdims=True)
    both = shrink_any(mask & silhouette, stride)
    drawn = np.repeat(1.0 - _CONTRAST * (1.0 - grey), 3, axis=-1)
    drawn[both] *= _tinted()
    drawn[shrink_any(mask & ~silhouette, stride)] = to_rgb(MISSING)
    drawn[shrink_any(silhouette & ~mask, stride)] = to_rgb(EXCESS)
    return drawn


def draw_errors(path: Path, outlines: Sequence[Outline]) -> None:
    """Draws a bar for each view: the share of pixels of mask or silhouette that are not in both."""
    errors = 100.0 * (1.0 - np.asarray([outline.overlap for outline in outlines]))
    missing = np.asarray(
        [_share(outline.mask & ~outline.silhouette, outline) for outline in outlines]
    )
    figure, axis = pyplot.subplots(figsize=(9.0, 3.2), layout="constrained")
    at = np.arange(len(outlines))
    axis.bar(at, missing, color=MISSING, label="mask only")
    axis.bar(at, errors - missing, bottom=missing, color=EXCESS, label="silhouette only")
    axis.axhline(errors.mean(), color="#555555", linewidth=1.0, linestyle="--")
    axis.annotate(
        f"mean {errors.mean():.2f} %",
        (1.005, errors.mean()),
        xycoords=("axes fraction", "data"),
        va="center",
        fontsize=8,
        color="#555555",
    )
    axis.set_xlim(-0.7, len(outlines) - 0.3)
    some = at[:: max(1, len(at) // 20)]
    axis.set_xticks(some, [outlines[i].name for i in some], rotation=60, ha="right", fontsize=7)
    axis.set_ylabel("1 - IoU, %")
    axis.set_title(
        f"Overlap of mask and silhouette (IoU): mean {1 - errors.mean() / 100:.4f}, least "
        f"{1 - errors.max() / 100:.4f}",
        fontsize=10,
    )
    axis.legend(frameon=False, fontsize=8, loc="upper right", ncols=2)
    axis.margins(y=0.22)
    style(axis)
    axis.grid(False, axis="x")
    figure.savefig(path, dpi=DPI)
    pyplot.close(figure)


def _tinted() -> Float[np.ndarray, "3"]:
    """Returns the colour of agreement on a white background."""
    return 1.0 - _TINT * (1.0 - np.asarray(to_rgb(AGREES)))


def _share(pixels: Bool[np.ndarray, "h w"], outline: Outline) -> float:
    """Returns the share of some pixels in the union of mask and silhouette, in percent."""
    return 100.0 * float(pixels.sum()) / max(1, int((outline.mask | outline.silhouette).sum()))


def draw_surface(path: Path, views: Sequence[SurfaceView]) -> None:
    """Draws one row per view: photograph, normals, and the errors of both if the truth is known."""
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
    """Returns normals as colours: x is red, y green, towards the viewer blue; missing is white."""
    seen = np.any(normals != 0.0, axis=-1, keepdims=True)
    return np.where(seen, np.clip(0.5 + 0.5 * normals, 0.0, 1.0), 1.0)


def angles_between(view: SurfaceView) -> Float[np.ndarray, "h w"]:
    """Returns the angle in degrees between both normals, NaN where either is missing."""
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
    """Shades a surface slightly by its slope, so that its shape is visible."""
    seen = np.any(normals != 0.0, axis=-1, keepdims=True)
    return np.where(seen, rgb * (0.65 + 0.35 * np.clip(normals[..., 2:], 0.0, 1.0)), rgb)


def _most(values: Sequence[Float[np.ndarray, "h w"]]) -> float:
    known = np.concatenate([value[np.isfinite(value)] for value in values])
    return float(np.percentile(known, _MOST)) if known.size else 0.0
