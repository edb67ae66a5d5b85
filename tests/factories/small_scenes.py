"""Writes a small scene in the local layout, and breaks it."""

import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np

from refref_jax.data import image_files

WIDTH, HEIGHT = 8, 6
"""Not square, so that rows and columns can not be exchanged."""

Edit = Callable[[dict[str, Any]], None]


def write_scene(scene: Path, *, frames: int = 2) -> Path:
    """Writes a `train` split of colour, masks with one object pixel a frame, and float depth."""
    transforms = {"camera_angle_x": 1.0, "frames": [_write_frame(scene, i) for i in range(frames)]}
    _transforms(scene).write_text(json.dumps(transforms), encoding="utf-8")
    return scene


def edit_transforms(scene: Path, edit: Edit) -> None:
    """Applies a function to the parsed transforms file, and writes it again."""
    transforms = json.loads(_transforms(scene).read_text(encoding="utf-8"))
    edit(transforms)
    _transforms(scene).write_text(json.dumps(transforms), encoding="utf-8")


def without_masks(transforms: dict[str, Any]) -> None:
    """An edit: takes the masks out of a transforms file."""
    for record in transforms["frames"]:
        del record["mask_file_path"]


def truncate(path: Path, share: float = 0.5) -> None:
    """Cuts a file off, as an interrupted copy does."""
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])


def png_chunk(name: bytes, content: bytes) -> bytes:
    """Returns a chunk of a PNG file, with its length and checksum."""
    checksum = zlib.crc32(name + content)
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", checksum)


def write_grey(path: Path, pixels: np.ndarray) -> None:
    """Writes an 8-bit image with one channel."""
    path.parent.mkdir(parents=True, exist_ok=True)
    iio.imwrite(path, pixels.astype(np.uint8), plugin="pillow", extension=".png")


def _transforms(scene: Path) -> Path:
    return scene / "transforms_train.json"


def _write_frame(scene: Path, frame: int) -> dict[str, Any]:
    name = f"train/r_{frame:03d}"
    (scene / "train").mkdir(parents=True, exist_ok=True)
    image_files.write_rgb(scene / f"{name}.png", np.full((HEIGHT, WIDTH, 3), (frame + 1) / 255.0))
    mask = np.zeros((HEIGHT, WIDTH))
    mask[1, 2 + frame] = 255
    write_grey(scene / "mask" / f"{name}.png", mask)
    write_grey(scene / "depth" / f"{name}.png", np.full((HEIGHT, WIDTH), 51 * frame))
    pose = np.eye(4)
    pose[:3, 3] = [frame, 10.0, 20.0]
    return {
        "file_path": f"./{name}",
        "mask_file_path": f"./mask/{name}.png",
        "depth_file_path": f"./depth/{name}.png",
        "transform_matrix": pose.tolist(),
    }
