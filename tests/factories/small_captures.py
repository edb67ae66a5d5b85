"""Writes a small capture in nerfstudio's layout, and breaks it."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from refref_jax.data import image_files

WIDTH, HEIGHT = 12, 10
FOCAL = 9.0

LENS = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": 6.0, "cy": 5.0, "w": WIDTH, "h": HEIGHT}


def write_capture(folder: Path, *, frames: int = 9) -> Path:
    """Writes frames whose pixels tell row, column and frame, with masks of one white pixel each."""
    for name in ("images", "masks"):
        (folder / name).mkdir(parents=True)
    content = {"camera_model": "OPENCV", **LENS, "k1": 0.0, "p2": 0}
    content["frames"] = [_write_frame(folder, i) for i in range(frames)]
    _save(folder, content)
    return folder


def pixels_of(frame: int) -> np.ndarray:
    """The colours of a frame: row, column and number."""
    row, column = np.indices((HEIGHT, WIDTH))
    return np.stack([row, column, np.full_like(row, frame)], axis=-1).astype(np.uint8)


def pose_of(frame: int) -> np.ndarray:
    """4 x 4: around the z axis by 0.7 a frame, looking at the origin from 5 units."""
    angle = 0.7 * frame
    back = np.array([np.cos(angle), np.sin(angle), 0.0])
    right = np.array([-np.sin(angle), np.cos(angle), 0.0])
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, 5.0 * back], axis=-1)
    return pose


def edit(folder: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    """Applies a function to the parsed transforms file, and writes it again."""
    content = json.loads((folder / "transforms.json").read_text(encoding="utf-8"))
    change(content)
    _save(folder, content)
    return folder


def _save(folder: Path, content: dict[str, Any]) -> None:
    (folder / "transforms.json").write_text(json.dumps(content), encoding="utf-8")


def _write_frame(folder: Path, frame: int) -> dict[str, Any]:
    name = f"frame_{frame:05d}.png"
    image_files.write_png(folder / "images" / name, pixels_of(frame))
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[4, 5] = True
    image_files.write_mask(folder / "masks" / name, mask)
    return {
        "file_path": f"images/{name}",
        "mask_path": f"./masks/{name}",
        "transform_matrix": pose_of(frame).tolist(),
    }
