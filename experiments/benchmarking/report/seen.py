"""The files of a view, read as far as they are there."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Bool, Float, UInt8

from experiments.benchmarking.jobs import SPLIT
from experiments.benchmarking.report.contents import Scene
from experiments.benchmarking.results import Truth
from refref_jax.data import files, transforms
from refref_jax.data.errors import SceneError
from refref_jax.geometry import cameras
from refref_jax.geometry.cameras import Cameras

T = TypeVar("T")


class Image(NamedTuple):
    """A view, true or rendered; what is not there is `None`.

    Attributes:
      rgb: 8-bit sRGB.
      distance: along each pixel's ray, world units, `inf` where it meets nothing.
    """

    rgb: UInt8[np.ndarray, "h w 3"] | None
    distance: Float[np.ndarray, "h w"] | None


class View(NamedTuple):
    """A view of a scene.

    Attributes:
      name: of the view.
      truth: what should be seen.
      mask: of the object; `None` if it is not there.
      rendered: what each method sees, by its name.
    """

    name: str
    truth: Image
    mask: Bool[np.ndarray, "h w"] | None
    rendered: dict[str, Image]


def read_view(out: Path, scene: Scene, name: str) -> View:
    """Reads a view of a scene.

    A file that is missing or broken is `None`, and so is one of another size than the true image.

    Args:
      out: folder of the benchmark.
      scene: with its results.
      name: of the view.
    """
    files_of = {
        result.record.method: view
        for result in scene.results
        for view in result.record.views
        if view.name == name
    }
    roots = dict.fromkeys(root for result in scene.results for root in result.roots)
    told = next(iter(files_of.values())).truth
    truth, mask = _truth(list(roots), told)
    rendered = {
        method: Image(
            _known(files.read_rgb, out / view.rgb),
            _known(files.read_exr, out / view.distance),
        )
        for method, view in files_of.items()
    }
    if truth.rgb is not None:
        size = truth.rgb.shape[:2]
        truth = Image(truth.rgb, _of_size(truth.distance, size))
        mask = _of_size(mask, size)
        rendered = {
            method: Image(_of_size(image.rgb, size), _of_size(image.distance, size))
            for method, image in rendered.items()
        }
    return View(name, truth, mask, rendered)


def _truth(roots: Sequence[Path], told: Truth) -> tuple[Image, Bool[np.ndarray, "h w"] | None]:
    """Returns the true image and the mask, from the first folder that has the image."""
    root = next((root for root in roots if (root / told.rgb).is_file()), None)
    if root is None:
        return Image(None, None), None
    rgb = _known(files.read_rgb, root / told.rgb)
    mask = told.mask and _known(files.read_mask, root / told.mask)
    depth = told.distance and _known(files.read_depth, root / told.distance)
    return Image(rgb, None if depth is None else _distance(root, depth)), mask


def _distance(root: Path, depth: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"] | None:
    """Returns planar depth as distance; `None` if the scene does not tell its field of view."""
    path = root / f"transforms_{SPLIT}.json"
    try:
        angle = transforms.get(transforms.read_json(path), "camera_angle_x", path)
        height, width = depth.shape
        pose = np.eye(4)[None, :3]
        seen = Cameras(pose, width, height, cameras.focal_length(width, float(angle)))
        return cameras.planar_depth_to_distance(seen, depth)
    except (SceneError, TypeError, ValueError, ZeroDivisionError):
        return None


def _known(read: Callable[[Path], T], path: Path) -> T | None:
    try:
        return read(path)
    except SceneError:
        return None


def _of_size(pixels: T | None, size: tuple[int, int]) -> T | None:
    return pixels if pixels is not None and pixels.shape[:2] == size else None
