"""Finds and measures images of a scene's views that another program has rendered.

A folder of renderings has a PNG image for each view, under the view's name (`r_0.png`), and, if
distances are known, an EXR file of the same name (`r_0.exr`): arc length from the camera in world
units, `inf` or at least 1e4 where there is nothing. The files are in the folder itself, or in its
folders `rgb` and `distance`, as `experiments.evaluate` writes them. Other files are ignored.

The metrics are those of `refref_jax.training.evaluation`, by the same functions as for trained
models; all three kinds of distances are the given ones, as for straight rays.
"""

import hashlib
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.runs.image_folders import NAME
from refref_jax.data import SceneError, image_files, scene_folder
from refref_jax.data.scene_folder import Frames
from refref_jax.training import evaluation
from refref_jax.training.evaluation import Perceptual

_IMAGES, _DISTANCES = "rgb", "distance"

# Largest number of missing views in a message.
_MOST_NAMES = 5


class Renderings(NamedTuple):
    """Files of a method for some views of a scene.

    Attributes:
      names: names of the views, in the order of the split.
      images: PNG image of each view.
      distances: EXR file of each view, or `None`.
    """

    names: tuple[str, ...]
    images: tuple[Path, ...]
    distances: tuple[Path, ...] | None


def is_scene(folder: Path) -> bool:
    """Returns whether a folder is a scene, not a folder of images."""
    return any(folder.glob("transforms_*.json"))


def find(folder: Path, frames: Frames, *, limit: int | None = None) -> Renderings:
    """Finds the renderings of a split, and checks their names and sizes without reading pixels.

    Args:
      folder: folder of the renderings.
      frames: views of the split.
      limit: number of views to measure, evenly spread; all if not given.

    Raises:
      SceneError: if the folder or a file is missing, or if an image has another size than the
        scene's.
    """
    if not folder.is_dir():
        raise SceneError(f"{folder} is not a folder. Give one with a PNG image for each view.")
    of_images, of_distances = (
        folder / name if (folder / name).is_dir() else folder for name in (_IMAGES, _DISTANCES)
    )
    names = tuple(frames.names[i] for i in evaluation.spread(len(frames.names), limit))
    if not any(of_images.glob("*.png")):
        raise SceneError(
            f"{of_images} contains no .png. Save an image for each view there, named like "
            f"{names[0]}.png."
        )
    images, distances = _files(of_images, names, ".png"), None
    if any(of_distances.glob("*.exr")):
        distances = _files(of_distances, names, ".exr")
    for path in (*images, *(distances or ())):
        _check_size(path, frames)
    return Renderings(names, images, distances)


def _files(folder: Path, names: Sequence[str], ending: str) -> tuple[Path, ...]:
    paths = tuple(folder / f"{name}{ending}" for name in names)
    if missing := [path.name for path in paths if not path.is_file()]:
        more = ", ..." if len(missing) > _MOST_NAMES else ""
        raise SceneError(
            f"{folder} lacks {len(missing)} of {len(paths)} views: "
            f"{', '.join(missing[:_MOST_NAMES])}{more}. Save a file for each view there, under its "
            "name in the scene."
        )
    return paths


def _check_size(path: Path, frames: Frames) -> None:
    height, width = image_files.read_size(path)
    if (height, width) != (frames.cameras.height, frames.cameras.width):
        raise SceneError(
            f"{path} is {width} x {height} pixels, but the scene's images are "
            f"{frames.cameras.width} x {frames.cameras.height}. Render it at their size."
        )


def digest(found: Renderings) -> str:
    """Returns the SHA-256 of the names and contents of all files."""
    whole = hashlib.sha256()
    for name, paths in zip(found.names, _of_each_view(found), strict=True):
        for path in paths:
            content = path.read_bytes()
            whole.update(f"{name}{path.suffix} {len(content)} ".encode())
            whole.update(content)
    return whole.hexdigest()


def copy(found: Renderings, folder: Path) -> None:
    """Copies all files into the folders `rgb` and `distance`, in place of what is there."""
    for name in (_IMAGES, _DISTANCES):
        if (folder / name).is_dir():
            shutil.rmtree(folder / name)
    places = {".png": folder / _IMAGES, ".exr": folder / _DISTANCES}
    for paths in _of_each_view(found):
        for path in paths:
            places[path.suffix].mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, places[path.suffix] / path.name)


def _of_each_view(found: Renderings) -> Iterator[tuple[Path, ...]]:
    yield from zip(*filter(None, (found.images, found.distances)), strict=True)


def measure(
    folder: Path, scene: Path, *, split: str, limit: int | None, perceptual: Perceptual
) -> Iterator[dict[str, Any]]:
    """Yields the name and the metrics of each view, `None` where they are undefined.

    Args:
      folder: folder of the renderings.
      scene: scene folder.
      split: `train`, `val` or `test`.
      limit: number of views to measure, evenly spread; all if not given.
      perceptual: perceptual metrics to compute in addition.

    Raises:
      SceneError: if a file of the scene or of the folder is missing or broken.
    """
    found = find(folder, scene_folder.read_frames(scene, split), limit=limit)
    truth = evaluation.read_truth(scene, split)
    for place, i in enumerate(evaluation.spread(len(truth.images), limit)):
        rgb = (image_files.read_rgb(found.images[place]) / 255.0).astype(np.float32)
        distance = None
        if found.distances is not None:
            distance = image_files.read_depth(found.distances[place])
        seen = evaluation.measure_view(rgb, distance, truth, i, perceptual=perceptual)
        yield {NAME: found.names[place], **seen}
