"""Compares two folders of images or distance maps, file by file."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from refref_jax.data import SceneError, image_files
from refref_jax.training import evaluation
from refref_jax.training.evaluation import Perceptual

NAME = "name"
"""Key of the name of a row."""

_MEAN = "mean"


class Pair(NamedTuple):
    """Two files of the same name in both folders.

    Attributes:
      name: name of the files, without extension.
      images: rendered and true image, or `None`.
      distances: rendered and true distance map, or `None`.
      mask: mask of both, or `None`.
    """

    name: str
    images: tuple[Path, Path] | None
    distances: tuple[Path, Path] | None
    mask: Path | None


def match(rendered: Path, target: Path, masks: Path | None) -> list[Pair]:
    """Pairs the files of two folders by name: `.png` are images, `.exr` are distance maps.

    A type of file that only one of the folders contains is ignored.

    Args:
      rendered: folder to evaluate.
      target: folder of the reference.
      masks: folder of 8-bit masks named like the images, or `None`.

    Raises:
      SceneError: if a folder is missing or empty, if the names in both folders differ, or if the
        sizes of a pair differ.
    """
    images = _paired(rendered, target, ".png")
    distances = _paired(rendered, target, ".exr")
    if not images and not distances:
        raise SceneError(
            f"{rendered} and {target} have nothing in common: one contains images (.png), the "
            "other distances (.exr). Give two folders of the same type."
        )
    pairs = []
    for name in sorted({*images, *distances}):
        mask = None if masks is None else masks / f"{name}.png"
        if mask is not None and not mask.is_file():
            raise SceneError(
                f"There is no mask of {name}: {mask} does not exist. Save it there, or leave out "
                "--masks."
            )
        pairs.append(Pair(name, images.get(name), distances.get(name), mask))
    for pair in pairs:
        _check_sizes(pair)
    return pairs


def compare(pairs: Sequence[Pair], perceptual: Perceptual) -> Iterator[dict[str, Any]]:
    """Yields the metrics of each pair, `None` where they are undefined.

    Raises:
      SceneError: if a file is broken.
    """
    for pair in pairs:
        mask = None if pair.mask is None else image_files.read_mask(pair.mask)
        row: dict[str, Any] = {NAME: pair.name}
        if pair.images is not None:
            rendered, target = (image_files.read_rgb(path) / 255.0 for path in pair.images)
            row |= evaluation.measure_colours(rendered, target, mask, perceptual)
        if pair.distances is not None:
            seen, true = (image_files.read_depth(path) for path in pair.distances)
            row |= evaluation.measure_distances("distance", seen, true, mask)
        yield row


def summarise(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Returns the means of all metrics, over the rows that have them."""
    keys = dict.fromkeys(key for row in rows for key in row if key != NAME)
    return {key: evaluation.mean_of([row for row in rows if key in row], key) for key in keys}


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Returns a text table with a line per row and their means, without empty columns."""
    means = {NAME: _MEAN} | summarise(rows)
    keys = [key for key, value in means.items() if key != NAME and value is not None]
    cells = [[NAME, *keys]]
    for row in (*rows, means):
        cells.append([row[NAME], *(_text(row.get(key)) for key in keys)])
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = []
    for first, *others in cells:
        padded = [x.rjust(width) for x, width in zip(others, widths[1:], strict=True)]
        lines.append("  ".join([first.ljust(widths[0]), *padded]))
    return "\n".join(lines)


def _paired(rendered: Path, target: Path, ending: str) -> dict[str, tuple[Path, Path]]:
    """Returns the files of one type by name, or none if one of the folders has none."""
    found = []
    for folder in (rendered, target):
        if not folder.is_dir():
            raise SceneError(f"{folder} is not a folder. Give one that contains images.")
        if not any(path.suffix in (".png", ".exr") for path in folder.iterdir()):
            raise SceneError(f"{folder} contains no .png and no .exr. Give a folder of images.")
        found.append({path.stem: path for path in folder.glob(f"*{ending}")})
    a, b = found
    if not a or not b:
        return {}
    for folder, lacking in ((target, sorted(a.keys() - b)), (rendered, sorted(b.keys() - a))):
        if lacking:
            more = f" (and {len(lacking) - 1} more)" if len(lacking) > 1 else ""
            raise SceneError(
                f"{folder} has no {lacking[0]}{ending}{more}, which the other folder has. Give "
                "folders with the same names."
            )
    return {name: (a[name], b[name]) for name in a}


def _check_sizes(pair: Pair) -> None:
    masks = () if pair.mask is None else (pair.mask,)
    for kind in (pair.images, pair.distances):
        if kind is None:
            continue
        sizes = {path: image_files.read_size(path) for path in (*kind, *masks)}
        first, (height, width) = next(iter(sizes.items()))
        for path, (other_height, other_width) in sizes.items():
            if (other_height, other_width) != (height, width):
                raise SceneError(
                    f"{path} is {other_width} x {other_height} pixels, but {first} is {width} x "
                    f"{height}. Give images of one size."
                )


def _text(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"
