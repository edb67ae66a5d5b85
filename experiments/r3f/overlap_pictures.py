"""Pictures of masks and silhouettes, drawn with matplotlib."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8
from matplotlib.colors import to_rgb
from matplotlib.patches import Patch

from experiments.figures.style import COLOURS, pyplot, style
from experiments.r3f import windows
from experiments.r3f.windows import Window

AGREES, MISSING, EXCESS = COLOURS[5], COLOURS[1], COLOURS[3]
"""Colours of pixels in mask and silhouette, in the mask alone, and in the silhouette alone."""

DPI = 110

# Inches of a thumbnail, and the most pixels along its edge; columns of a contact sheet.
_THUMBNAIL = 1.25
_PIXELS = 136
_COLUMNS = 10

# Around the object, as a share of it.
_MARGIN = 0.12

# Contrast that is left of a photograph, and how strong the colour of agreement is on it.
_CONTRAST = 0.35
_TINT = 0.55


class Outline(NamedTuple):
    """One view of mask and silhouette.

    Attributes:
      name: of the view.
      image: the photograph, 8-bit sRGB.
      mask: where the object is seen.
      silhouette: where the mesh is.
      overlap: of the two.
    """

    name: str
    image: UInt8[np.ndarray, "h w 3"]
    mask: Bool[np.ndarray, "h w"]
    silhouette: Bool[np.ndarray, "h w"]
    overlap: float


def draw_overlaps(path: Path, outlines: Sequence[Outline]) -> None:
    """Draws all views as a contact sheet of agreement, missing and excess pixels.

    Where there are more pixels than fit, one that errs is never averaged away.
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
    around = windows.around(seen, margin=_MARGIN)
    for axis, outline, window in zip(axes.flat, outlines, around, strict=False):
        axis.imshow(colour_overlap(outline, window), interpolation="nearest")
        axis.set_title(f"{outline.name}  {outline.overlap:.4f}", fontsize=6.5, pad=2.5)
    named = {"in both": _tinted(), "mask alone": MISSING, "silhouette alone": EXCESS}
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
    """Returns a window of the photograph in grey, agreement tinted, errors in full colour."""
    image, mask, silhouette = (
        windows.cut(each, window) for each in (outline.image, outline.mask, outline.silhouette)
    )
    stride = -(-max(mask.shape) // _PIXELS)
    grey = np.mean(windows.shrink(image / 255.0, stride), axis=-1, keepdims=True)
    both = windows.shrink_any(mask & silhouette, stride)
    picture = np.repeat(1.0 - _CONTRAST * (1.0 - grey), 3, axis=-1)
    picture[both] *= _tinted()
    picture[windows.shrink_any(mask & ~silhouette, stride)] = to_rgb(MISSING)
    picture[windows.shrink_any(silhouette & ~mask, stride)] = to_rgb(EXCESS)
    return picture


def draw_errors(path: Path, outlines: Sequence[Outline]) -> None:
    """Draws a bar for each view: the share of pixels in mask or silhouette that are not in both."""
    errors = 100.0 * (1.0 - np.asarray([outline.overlap for outline in outlines]))
    missing = np.asarray(
        [_share(outline.mask & ~outline.silhouette, outline) for outline in outlines]
    )
    figure, axis = pyplot.subplots(figsize=(9.0, 3.2), layout="constrained")
    at = np.arange(len(outlines))
    axis.bar(at, missing, color=MISSING, label="mask alone")
    axis.bar(at, errors - missing, bottom=missing, color=EXCESS, label="silhouette alone")
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
    """Returns the colour of agreement on white."""
    return 1.0 - _TINT * (1.0 - np.asarray(to_rgb(AGREES)))


def _share(pixels: Bool[np.ndarray, "h w"], outline: Outline) -> float:
    """Returns what percent of mask or silhouette some of their pixels are."""
    return 100.0 * float(pixels.sum()) / max(1, int((outline.mask | outline.silhouette).sum()))
