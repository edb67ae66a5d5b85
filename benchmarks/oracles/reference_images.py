"""Images of a scene whose background is known, and how far they are from Cycles' (NumPy)."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import imageio.v3 as iio
import numpy as np
import OpenEXR

from benchmarks.oracles.backgrounds import CubeBackground
from benchmarks.oracles.colours import linear_to_srgb
from benchmarks.oracles.reference_surfaces import unit


class EnvironmentBackground:
    """An image of all directions, infinitely distant, as `scene.json` describes it."""

    def __init__(self, scene: Path):
        """Reads the image of a scene's folder."""
        background = json.loads((scene / "scene.json").read_text())["background"]
        channels = OpenEXR.File(str(scene / background["image"])).channels()
        if "RGB" in channels:
            self.texture = np.asarray(channels["RGB"].pixels, float)
        else:
            self.texture = np.stack([channels[c].pixels for c in "RGB"], axis=-1).astype(float)

    def look(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns what rays see, and how far away."""
        height, width, _ = self.texture.shape
        x, y, z = directions.T
        u = (0.5 - np.arctan2(y, x) / (2.0 * np.pi)) % 1.0
        v = 0.5 + np.arcsin(np.clip(z, -1.0, 1.0)) / np.pi
        column, row = u * width - 0.5, np.clip((1.0 - v) * height - 0.5, 0.0, height - 1.0)
        left, top = np.floor(column).astype(int), np.floor(row).astype(int)
        fx, fy = (column - left)[:, None], (row - top)[:, None]
        right, bottom = (left + 1) % width, np.minimum(top + 1, height - 1)
        left = left % width
        upper = (1 - fx) * self.texture[top, left] + fx * self.texture[top, right]
        lower = (1 - fx) * self.texture[bottom, left] + fx * self.texture[bottom, right]
        return (1 - fy) * upper + fy * lower, np.full(len(origins), np.inf)


def read_background(scene: Path) -> CubeBackground | EnvironmentBackground:
    kinds = {"cube": CubeBackground, "env": EnvironmentBackground}
    kind = json.loads((scene / "scene.json").read_text())["background"]["type"]
    return kinds[kind](scene)


class View(NamedTuple):
    """A test view: pose, focal length in pixels, sRGB image and mask."""

    pose: np.ndarray
    focal: float
    image: np.ndarray
    mask: np.ndarray


def read_view(scene: Path, number: int) -> View:
    transforms = json.loads((scene / "transforms_test.json").read_text())
    frame = transforms["frames"][number]
    image = iio.imread(scene / f"{frame['file_path']}.png", plugin="pillow")[..., :3] / 255.0
    mask = iio.imread(scene / frame["mask_file_path"], plugin="pillow")
    mask = mask.reshape(*image.shape[:2], -1)[..., 0] > 0
    focal = 0.5 * image.shape[1] / np.tan(0.5 * transforms["camera_angle_x"])
    return View(np.array(frame["transform_matrix"]), focal, image, mask)


def pixel_rays(view: View, rows: np.ndarray, fine: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns `fine` x `fine` rays a pixel of some rows, [rows, fine, columns, fine, 3]."""
    height, width, _ = view.image.shape
    inner = (np.arange(fine) + 0.5) / fine
    y = (rows[:, None] + inner)[:, :, None, None]
    x = np.arange(width)[:, None] + inner
    across = (x - 0.5 * width) / view.focal
    down = (0.5 * height - y) / view.focal
    local = np.stack(np.broadcast_arrays(across, down, -1.0), axis=-1)
    directions = unit(local @ view.pose[:3, :3].T)
    return np.broadcast_to(view.pose[:3, 3], directions.shape), directions


Look = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def image(
    rays: np.ndarray, weights: np.ndarray, seen: np.ndarray, shape: tuple[int, ...]
) -> np.ndarray:
    """Sums paths to rays and averages these over pixels; returns sRGB in `[0, 1]`.

    Args:
      rays: the ray of each path.
      weights: its share, [paths, 3].
      seen: linear radiance at its end, [paths, 3].
      shape: rows, rays a pixel, columns, rays a pixel.
    """
    size = int(np.prod(shape))
    linear = np.stack(
        [np.bincount(rays, weights[:, c] * seen[:, c], minlength=size) for c in range(3)], axis=-1
    )
    mean = linear.reshape(*shape, 3).mean(axis=(1, 3))
    return np.clip(linear_to_srgb(mean), 0.0, 1.0)


def psnr(image: np.ndarray, target: np.ndarray, mask: np.ndarray) -> float:
    """Returns the PSNR of sRGB values inside a mask, in dB."""
    return float(-10.0 * np.log10(np.mean((image - target)[mask] ** 2)))
