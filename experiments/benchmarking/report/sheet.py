"""One picture of a benchmark: a view of each scene as each method sees it."""

from collections.abc import Sequence
from pathlib import Path

from experiments.benchmarking.report import data
from experiments.benchmarking.report.data import Scene, View
from experiments.figures.style import pyplot
from refref_jax import atomic_files

FILE = "pictures.jpg"

# Beyond, tiles are too small to be looked at.
_MOST_SCENES, _MOST_METHODS = 8, 7

_INCHES = 1.7
_DOTS = 120


def write(out: Path) -> Path | None:
    """Draws a column for each scene: the true image, then each method's with its PSNR in the mask.

    The view is the one in the middle of the scene's views, ordered by how well all methods do on
    it. Scenes whose images are gone have none; of many scenes some are shown, spread evenly over
    their names.

    Args:
      out: folder of the benchmark, with its results.json.

    Returns:
      The file; `None` if there is nothing to show.

    Raises:
      ValueError: if there are no results, or they are broken.
    """
    everything = data.read(out)
    methods = list(everything.labels)[:_MOST_METHODS]
    columns = []
    for scene in _spread(everything.scenes, _MOST_SCENES):
        name = data.typical_view(scene)
        view = None if name is None else data.read_view(out, scene, name)
        if view is not None and view.truth.rgb is not None:
            columns.append((scene, view))
    path = out / FILE
    if not columns:
        path.unlink(missing_ok=True)  # of scenes that are gone
        return None
    _draw(path, columns, {name: everything.labels[name] for name in methods})
    return path


def _spread(scenes: Sequence[Scene], most: int) -> list[Scene]:
    count = min(len(scenes), most)
    return [scenes[i * len(scenes) // count] for i in range(count)]


def _draw(path: Path, columns: Sequence[tuple[Scene, View]], labels: dict[str, str]) -> None:
    figure, axes = pyplot.subplots(
        len(labels) + 1,
        len(columns),
        figsize=(_INCHES * len(columns) + 0.3, 1.1 * _INCHES * (len(labels) + 1) + 0.2),
        squeeze=False,
        layout="constrained",
    )
    for tiles, (scene, view) in zip(axes.T, columns, strict=True):
        tiles[0].set_title(scene.name, fontsize=7)
        images = [view.truth, *(view.rendered.get(name) for name in labels)]
        below = [view.name, *(_psnr(scene, name, view.name) for name in labels)]
        for tile, image, text in zip(tiles, images, below, strict=True):
            tile.set_xticks([])
            tile.set_yticks([])
            tile.set_xlabel(text, fontsize=7, labelpad=2)
            if image is not None and image.rgb is not None:
                tile.imshow(image.rgb)
            else:
                tile.set_frame_on(False)
    for tile, label in zip(axes[:, 0], ("ground truth", *labels.values()), strict=True):
        tile.set_ylabel(label, fontsize=8)
    with atomic_files.written_file(path) as draft:
        figure.savefig(draft, format="jpeg", dpi=_DOTS, pil_kwargs={"quality": 88})
    pyplot.close(figure)


def _psnr(scene: Scene, method: str, view: str) -> str:
    value = data.psnr_masked(scene, method, view)
    return "" if value is None else f"{value:.1f} dB"
