"""The figures of `experiments.glass_figures`, drawn with matplotlib and written as JPEG."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.colors import LogNorm

from experiments.figures.comparison import ERROR_GAIN, amplified_error
from experiments.figures.cross_sections import Line, Outline, Panel, lines_within
from experiments.figures.style import pyplot

_DPI = 150
_QUALITY = 88

_GLASS = {"facecolor": "#dcecf7", "edgecolor": "#5b8db8", "linewidth": 1.4, "zorder": 1}
_SHARES = "plasma_r"
_LEAST_SHARE = 1e-3
_HUES = "turbo"
_DISTANCES = "viridis"


class Shown(NamedTuple):
    """One picture of a row.

    Attributes:
      title: above it.
      rgb: sRGB in `[0, 1]`.
      psnr: inside the mask against the first picture of the row, dB; `None` for that one.
    """

    title: str
    rgb: Float[np.ndarray, "h w 3"]
    psnr: float | None = None


def write_views(path: Path, views: Sequence[Shown]) -> None:
    """Draws a true image and renderings of it, with their errors below."""
    figure, axes = pyplot.subplots(
        2, len(views), figsize=(2.6 * len(views), 5.7), layout="constrained", squeeze=False
    )
    truth = views[0].rgb
    for (above, below), view in zip(axes.T, views, strict=True):
        _show(above, view.rgb)
        above.set_title(view.title, fontsize=12)
        if view.psnr is None:
            below.axis("off")
            below.text(
                0.5,
                0.5,
                f"below each picture:\nwhat is wrong with it,\n{ERROR_GAIN:g} times as bright,\n"
                "and PSNR on the glass",
                ha="center",
                va="center",
                fontsize=11,
                color="#444444",
                transform=below.transAxes,
            )
            continue
        _show(below, amplified_error(view.rgb, truth))
        below.set_xlabel(f"{view.psnr:.1f} dB", fontsize=13, fontweight="bold")
    _save(figure, path)


def write_fan(
    path: Path, panels: Sequence[Panel], outlines: Sequence[Outline], half: float
) -> None:
    """Draws many rays of a camera, each in a colour of its own, up to the walls of a room."""
    figure, axes = pyplot.subplots(
        1, len(panels), figsize=(4.6 * len(panels), 4.9), layout="constrained", squeeze=False
    )
    for axis, panel in zip(axes[0], panels, strict=True):
        _draw_body(axis, outlines, half)
        hues = matplotlib.colormaps[_HUES](np.linspace(0.05, 0.95, len(panel.paths)))
        for paths, hue in zip(panel.paths, hues, strict=True):
            for line in lines_within(paths, half):
                axis.plot(*line.points.T, color=hue, linewidth=1.5, zorder=2)
                axis.plot(*line.points[-1], "s", color=hue, markersize=8, clip_on=False, zorder=3)
        axis.plot(*panel.paths[0].polylines[0][0, :2], "o", color="black", markersize=7, zorder=4)
        axis.set_title(panel.title, fontsize=12)
    _save(figure, path)


def write_tree(path: Path, panels: Sequence[Panel], outlines: Sequence[Outline]) -> None:
    """Draws the light paths of one ray, coloured and labelled by the light that they carry."""
    half = 3.0 * max(float(np.max(np.abs(outline))) for outline in outlines)
    figure, axes = pyplot.subplots(
        1, len(panels), figsize=(3.3 * len(panels) + 0.8, 3.7), layout="constrained", squeeze=False
    )
    norm = LogNorm(_LEAST_SHARE, 1.0)
    colours = matplotlib.cm.ScalarMappable(norm, matplotlib.colormaps[_SHARES])
    for axis, panel in zip(axes[0], panels, strict=True):
        _draw_body(axis, outlines, half)
        lines = [line for paths in panel.paths for line in lines_within(paths, half)]
        for line in sorted(lines, key=lambda line: line.share):
            weight = 0.9 + 2.6 * float(np.sqrt(line.share))
            colour = colours.to_rgba(line.share)
            axis.plot(*line.points.T, color=colour, linewidth=weight, zorder=2 + line.share)
        _label_shares(axis, lines, half)
        start = panel.paths[0].polylines[0][0, :2]
        axis.plot(*start, "o", color="black", markersize=7, zorder=4, clip_on=False)
        axis.set_title(panel.title, fontsize=12)
    scale = figure.colorbar(colours, ax=axes, shrink=0.75, pad=0.01)
    scale.set_label("share of the pixel's light")
    scale.ax.set_yticks([1.0, 0.1, 0.01, 0.001], ["100 %", "10 %", "1 %", "0.1 %"])
    _save(figure, path)


def write_distances(
    path: Path, truth: Shown, maps: Sequence[tuple[str, Float[np.ndarray, "h w"]]]
) -> None:
    """Draws a picture beside maps of distances on one scale; what has none is white."""
    count = 1 + len(maps)
    figure, axes = pyplot.subplots(
        1, count, figsize=(2.75 * count + 0.6, 3.2), layout="constrained", squeeze=False
    )
    _show(axes[0, 0], truth.rgb)
    axes[0, 0].set_title(truth.title, fontsize=11)
    known = np.concatenate([values[np.isfinite(values)] for _, values in maps])
    for axis, (title, values) in zip(axes[0, 1:], maps, strict=True):
        shown = axis.imshow(
            np.where(np.isfinite(values), values, np.nan),
            cmap=_DISTANCES,
            vmin=float(known.min()),
            vmax=float(known.max()),
        )
        axis.set_xticks([])
        axis.set_yticks([])
        axis.set_title(title, fontsize=11)
    figure.colorbar(shown, ax=axes[0, -1], label="world units", shrink=0.8)
    _save(figure, path)


def _draw_body(axis: pyplot.Axes, outlines: Sequence[Outline], half: float) -> None:
    for outline in outlines:
        axis.fill(*outline.T, **_GLASS)
    axis.set_xlim(-half, half)
    axis.set_ylim(-half, half)
    axis.set_aspect("equal")
    axis.set_xticks([])
    axis.set_yticks([])
    for spine in axis.spines.values():
        spine.set_color("#aaaaaa")


def _label_shares(axis: pyplot.Axes, lines: Sequence[Line], half: float) -> None:
    """Writes each path's share beside its end, a little inside of the frame."""
    for line in lines:
        end, before = line.points[-1], line.points[-2]
        back = (before - end) / np.linalg.norm(before - end)
        place = end + 0.16 * half * back
        axis.text(
            *place,
            f"{100.0 * line.share:.3g} %",
            ha="center",
            va="center",
            fontsize=11,
            zorder=5,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.2, "alpha": 0.85},
        )


def _show(axis: pyplot.Axes, rgb: Float[np.ndarray, "h w 3"]) -> None:
    axis.imshow(np.clip(rgb, 0.0, 1.0), interpolation="bicubic")
    axis.set_xticks([])
    axis.set_yticks([])


def _save(figure: pyplot.Figure, path: Path) -> None:
    figure.savefig(path, dpi=_DPI, facecolor="white", pil_kwargs={"quality": _QUALITY})
    pyplot.close(figure)
