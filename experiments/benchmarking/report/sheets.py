"""Draws the image files of a benchmark: a typical view of each scene by every method.

`{out}/pictures.jpg` has a column for each scene; `{out}/distances.jpg` has two, the image and the
map of its distances, like the grids of methods by scenes in the paper.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from experiments.benchmarking import tables
from experiments.benchmarking.report import data, images
from experiments.benchmarking.report.data import Scene, View
from experiments.benchmarking.report.images import Scale
from experiments.figures.style import pyplot
from refref_jax import atomic_files

SHEET, GRID = "pictures.jpg", "distances.jpg"

# With more scenes the tiles become too small.
_MOST_SCENES, _MOST_METHODS = 8, 7

_INCHES = 1.7
_DOTS = 120
_SMALL = 7


class Column(NamedTuple):
    """A scene and the view that is drawn of it."""

    scene: Scene
    view: View


def write(out: Path) -> list[Path]:
    """Draws all images, of the median view of each scene, ordered by the mean over all methods.

    Scenes whose images are missing are skipped; if there are many scenes, a subset is shown that is
    spread evenly over their names. Files of earlier calls that cannot be drawn now are removed.

    Args:
      out: folder of the benchmark, with its results.json.

    Returns:
      Paths of the files; none if there is nothing to show.

    Raises:
      ValueError: if there are no results, or they are broken.
    """
    everything = data.read(out)
    labels = {name: everything.labels[name] for name in list(everything.labels)[:_MOST_METHODS]}
    columns = []
    for scene in _spread(everything.scenes, _MOST_SCENES):
        name = data.typical_view(scene)
        view = None if name is None else data.read_view(out, scene, name)
        if view is not None and view.truth.rgb is not None:
            columns.append(Column(scene, view))
    scaled = [(column, scale) for column in columns if (scale := _scale(column.view)) is not None]
    drawings: dict[str, tuple[Sequence, Callable]] = {
        SHEET: (columns, _draw_pictures),
        GRID: (scaled, _draw_distances),
    }
    written = []
    for file, (shown, draw) in drawings.items():
        path = out / file
        if shown:
            draw(path, shown, labels)
            written.append(path)
        else:
            path.unlink(missing_ok=True)
    return written


def _spread(scenes: Sequence[Scene], most: int) -> list[Scene]:
    count = min(len(scenes), most)
    return [scenes[i * len(scenes) // count] for i in range(count)]


def _scale(view: View) -> Scale | None:
    """Returns the scale of all distances of a view, as in the report."""
    known = [image.distance for image in view.rendered.values() if image.distance is not None]
    return images.distance_scale(view.truth.distance, known)


def _draw_pictures(path: Path, columns: Sequence[Column], labels: Mapping[str, str]) -> None:
    """Draws a column for each scene: the reference, then each method with its masked PSNR."""
    rows = len(labels) + 1
    size = (_INCHES * len(columns) + 0.3, 1.1 * _INCHES * rows + 0.2)
    figure, axes = pyplot.subplots(
        rows, len(columns), figsize=size, squeeze=False, layout="constrained"
    )
    for tiles, column in zip(axes.T, columns, strict=True):
        tiles[0].set_title(column.scene.name, fontsize=_SMALL)
        _draw_images(tiles, column, labels)
    _label(axes[:, 0], labels)
    _save(figure, path)


def _draw_distances(
    path: Path, columns: Sequence[tuple[Column, Scale]], labels: Mapping[str, str]
) -> None:
    """Draws two columns for each scene: images, and distances on one scale for each scene."""
    rows = len(labels) + 1
    size = (2.0 * _INCHES * len(columns) + 0.3, 1.1 * _INCHES * rows + 0.6)
    figure, axes = pyplot.subplots(
        rows, 2 * len(columns), figsize=size, squeeze=False, layout="constrained"
    )
    for i, (column, scale) in enumerate(columns):
        left, right = axes[:, 2 * i], axes[:, 2 * i + 1]
        left[0].set_title(column.scene.name, fontsize=_SMALL)
        right[0].set_title("distance", fontsize=_SMALL)
        _draw_images(left, column, labels)
        _draw_maps(right, column, scale, labels)
        shades = ScalarMappable(Normalize(scale.low, scale.high), scale.colours)
        bar = figure.colorbar(
            shades, ax=right, location="bottom", shrink=0.9, aspect=14, pad=0.01, extend="both"
        )
        bar.ax.tick_params(labelsize=_SMALL)
        bar.set_label("world units; grey: no distance", fontsize=_SMALL)
    _label(axes[:, 0], labels)
    _save(figure, path)


def _draw_images(tiles: Sequence[pyplot.Axes], column: Column, labels: Mapping[str, str]) -> None:
    scene, view = column
    shown = [view.truth, *(view.rendered.get(name) for name in labels)]
    below = [view.name, *(_psnr(scene, name, view.name) for name in labels)]
    for tile, image, text in zip(tiles, shown, below, strict=True):
        _draw_tile(tile, None if image is None else image.rgb, text)


def _draw_maps(
    tiles: Sequence[pyplot.Axes], column: Column, scale: Scale, labels: Mapping[str, str]
) -> None:
    scene, view = column
    shown = [view.truth, *(view.rendered.get(name) for name in labels)]
    below = ["", *(_distance_error(scene, name, view.name) for name in labels)]
    for tile, image, text in zip(tiles, shown, below, strict=True):
        known = None if image is None or image.distance is None else image.distance
        _draw_tile(tile, None if known is None else images.colour(known, scale), text)


def _draw_tile(tile: pyplot.Axes, pixels: UInt8[np.ndarray, "h w 3"] | None, text: str) -> None:
    """Draws an image and the text below it; a missing image leaves the tile empty."""
    tile.set_xticks([])
    tile.set_yticks([])
    tile.set_xlabel(text or " ", fontsize=_SMALL, labelpad=2)  # of one height in every column
    if pixels is None:
        tile.set_frame_on(False)
    else:
        tile.imshow(pixels)


def _label(tiles: Sequence[pyplot.Axes], labels: Mapping[str, str]) -> None:
    for tile, label in zip(tiles, ("ground truth", *labels.values()), strict=True):
        tile.set_ylabel(label, fontsize=_SMALL + 1)


def _save(figure: pyplot.Figure, path: Path) -> None:
    with atomic_files.written_file(path) as draft:
        figure.savefig(draft, format="jpeg", dpi=_DOTS, pil_kwargs={"quality": 88})
    pyplot.close(figure)


def _psnr(scene: Scene, method: str, view: str) -> str:
    value = data.psnr_masked(scene, method, view)
    return "" if value is None else f"{value:.1f} dB"


def _distance_error(scene: Scene, method: str, view: str) -> str:
    """Returns the mean absolute error of a view's distances as text; empty if it is unknown."""
    for result in scene.results:
        for image in result.record.per_image:
            if (result.record.method, image.name) == (method, view):
                value = tables.value(tables.DMAE_MEDIAN, image.metrics, scene.background)
                return "" if value is None else f"mean error {value:.2f}"
    return ""
