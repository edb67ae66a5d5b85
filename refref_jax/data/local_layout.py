"""Reads a scene folder in the local layout of the data set (NumPy only).

    {scene}/transforms_{train,val,test}.json    poses and file names
    {scene}/{split}/*.png  mask/  depth/        as the JSON names them
    {scene}/meshes/*.ply                        see `meshes`
    {scene}/scene.json                          optional, see `meshes`

A depth map named as PNG is read from the float EXR beside it when there is one.
"""

import json
import math
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8

from refref_jax.data import files
from refref_jax.data.cameras import Cameras, focal_length, planar_depth_to_distance
from refref_jax.data.errors import SceneError

SPLITS = ("train", "val", "test")

# Poses are written with six digits or more; a larger deviation is a scale or a shear.
_ROTATION_TOLERANCE = 1e-3


class Frames(NamedTuple):
    """One split of a scene: where its files are, and its cameras.

    Attributes:
      names: stem of each image, unique in the split.
      images: 8-bit images.
      masks: object masks, or `None` where the split has none.
      depths: planar depth maps, or `None` where the split has none.
      cameras: one a frame.
    """

    names: tuple[str, ...]
    images: tuple[Path, ...]
    masks: tuple[Path, ...] | None
    depths: tuple[Path, ...] | None
    cameras: Cameras


def read_frames(scene: Path, split: str) -> Frames:
    """Reads the cameras of a split, and checks that all of its files exist.

    Args:
      scene: the scene folder.
      split: `train`, `val` or `test`.

    Raises:
      SceneError: if a file is missing or broken, or a pose is not a rigid motion.
    """
    path = scene / f"transforms_{split}.json"
    transforms = _read_json(path)
    frames = _get(transforms, "frames", path)
    if not isinstance(frames, list) or not frames:
        raise SceneError(f"{path} lists no frames. Add frames, or remove the split.")
    stems = [_get_text(frame, "file_path", path) for frame in frames]
    images = tuple(scene / f"{stem}.png" for stem in stems)
    width, height = _image_size(images[0])
    angle = _get(transforms, "camera_angle_x", path)
    if not isinstance(angle, int | float) or not 0.0 < angle < math.pi:
        raise SceneError(
            f"camera_angle_x is {angle!r} in {path}. Give the horizontal field of view in "
            "radians, between 0 and pi."
        )
    poses = np.stack([_pose(_get(f, "transform_matrix", path), path) for f in frames])
    masks = _optional_files(scene, frames, "mask_file_path", path)
    depths = _optional_files(scene, frames, "depth_file_path", path)
    result = Frames(
        names=tuple(image.stem for image in images),
        images=images,
        masks=masks,
        depths=depths and tuple(_prefer_exr(depth) for depth in depths),
        cameras=Cameras(poses, width, height, focal_length(width, float(angle))),
    )
    _check_files(result)
    return result


def read_images(frames: Frames) -> UInt8[np.ndarray, "frames h w 3"]:
    """Reads the images of a split as 8-bit sRGB, over white where they are transparent."""
    return np.stack([_checked(files.read_rgb(path), path, frames) for path in frames.images])


def read_masks(frames: Frames) -> Bool[np.ndarray, "frames h w"]:
    """Reads the object masks of a split.

    Raises:
      SceneError: if the split has none, or one of them marks no object.
    """
    if frames.masks is None:
        raise SceneError(
            f"The frames of {frames.images[0].parent} have no masks. Add mask_file_path to each "
            "frame of the transforms file."
        )
    masks = [_checked(files.read_mask(path), path, frames) for path in frames.masks]
    for mask, path in zip(masks, frames.masks, strict=True):
        if not mask.any():
            raise SceneError(
                f"{path} marks no object. Render the mask again, or remove the frame from the "
                "transforms file."
            )
    return np.stack(masks)


def read_distances(frames: Frames) -> Float[np.ndarray, "frames h w"]:
    """Reads the depth maps of a split as distance along each pixel's unit ray, world units.

    `inf` where a float map says that the ray meets nothing. 8-bit maps saturate at a planar
    depth of 11.5.
    """
    if frames.depths is None:
        raise SceneError(
            f"The frames of {frames.images[0].parent} have no depth maps. Add depth_file_path to "
            "each frame of the transforms file."
        )
    depths = [_checked(files.read_depth(path), path, frames) for path in frames.depths]
    return planar_depth_to_distance(frames.cameras, np.stack(depths))


def _read_json(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise SceneError(
            f"{path} does not exist. Give the folder of a scene, which holds "
            "transforms_train.json, transforms_val.json and transforms_test.json."
        )
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise SceneError(f"{path} is not valid JSON ({error}). Copy it again.") from error
    if not isinstance(content, dict):
        raise SceneError(f"{path} is not a JSON object. Copy it again.")
    return content


def _get(record: Any, key: str, path: Path) -> Any:
    if not isinstance(record, dict) or key not in record:
        raise SceneError(f"{path} lacks the key {key!r}. Add it, as the data format asks.")
    return record[key]


def _get_text(record: Any, key: str, path: Path) -> str:
    text = _get(record, key, path)
    if not isinstance(text, str):
        raise SceneError(f"{key} is {text!r} in {path}. Give the name of a file.")
    return text


def _pose(matrix: Any, path: Path) -> Float[np.ndarray, "3 4"]:
    """Checks that a matrix is a rigid motion and returns its upper three rows."""
    try:
        pose = np.asarray(matrix, np.float64)
    except (TypeError, ValueError):
        pose = np.empty(0)
    if pose.shape != (4, 4) or not np.all(np.isfinite(pose)):
        raise SceneError(
            f"A transform_matrix in {path} is not a finite 4 x 4 matrix. Export the poses again."
        )
    rotation = pose[:3, :3]
    residual = np.max(np.abs(rotation @ rotation.T - np.eye(3)))
    if np.max(np.abs(pose[3] - [0.0, 0.0, 0.0, 1.0])) > _ROTATION_TOLERANCE:
        raise SceneError(
            f"A transform_matrix in {path} ends with the row {pose[3]}, not 0 0 0 1. Export "
            "camera-to-world matrices, with the position in the last column."
        )
    if residual > _ROTATION_TOLERANCE or np.linalg.det(rotation) < 0.0:
        raise SceneError(
            f"A transform_matrix in {path} does not rotate: its axes are scaled, sheared or "
            f"mirrored (deviation {residual:.2g}). Export the poses without scale."
        )
    return pose[:3]


def _optional_files(
    scene: Path, frames: list[Any], key: str, path: Path
) -> tuple[Path, ...] | None:
    """Returns the files that all frames name under a key, or `None` if no frame does."""
    if not any(isinstance(frame, dict) and key in frame for frame in frames):
        return None
    return tuple(scene / _get_text(frame, key, path) for frame in frames)


def _prefer_exr(path: Path) -> Path:
    exr = path.with_suffix(".exr")
    return exr if exr.is_file() else path


def _image_size(path: Path) -> tuple[int, int]:
    height, width, _ = files.read_rgb(path).shape
    return width, height


def _check_files(frames: Frames) -> None:
    for paths in (frames.images, frames.masks or (), frames.depths or ()):
        for path in paths:
            if not path.is_file():
                raise SceneError(
                    f"{path} does not exist, but the transforms file names it. Copy the scene "
                    "again, or remove the frame."
                )
    name, count = Counter(frames.names).most_common(1)[0]
    if count > 1:
        raise SceneError(
            f"{count} frames of {frames.images[0].parent} have the same file name, {name}. Give "
            "every frame a name of its own."
        )


def _checked(pixels: np.ndarray, path: Path, frames: Frames) -> np.ndarray:
    """Checks an image's size against the split's."""
    expected = (frames.cameras.height, frames.cameras.width)
    if pixels.shape[:2] != expected:
        height, width = pixels.shape[:2]
        raise SceneError(
            f"{path} is {width} x {height} pixels, but the split's images are {expected[1]} x "
            f"{expected[0]}. Render it again in that size."
        )
    return pixels
