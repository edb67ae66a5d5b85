"""Reads scene folders: transforms, file names, images, masks and depth (NumPy only).

The JSON that places a scene's cameras: what it must hold (NumPy only).

Every function raises a `SceneError` that names the file and says what to do.

How a scene's files are called in the layouts of folders (NumPy only).

    plain    {split}/r_000.png    mask/{split}/r_000.png         depth/{split}/r_000.png
    raw      {split}/r_0.png      {split}/r_0_mask_0000.png      {split}/r_0_depth_0000.png

`raw` is that of the data set's raw release. Readers go by the transforms file, never by these.

Reads a scene folder in the local layout of the data set (NumPy only).

    {scene}/transforms_{train,val,test}.json    poses and file names
    {scene}/{split}/*.png  mask/  depth/        as the JSON names them
    {scene}/meshes/*.ply                        see `meshes`
    {scene}/scene.json                          optional, see `meshes`

A depth map named as PNG is read from the float EXR beside it when there is one.
"""

import collections
import json
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np
from jaxtyping import Bool, Float, UInt8

from refref_jax import configuration
from refref_jax.choices import Split
from refref_jax.data import SceneError, image_files
from refref_jax.geometry.cameras import Cameras, focal_length, planar_depth_to_distance

# Poses are written with six digits or more; a larger deviation is a scale or a shear.
_ROTATION_TOLERANCE = 1e-3

SPLITS: tuple[Split, ...] = get_args(Split)

TRANSFORMS = "transforms_{}.json"
"""Name of a split's transforms file."""


def read_json(path: Path) -> dict[str, Any]:
    """Reads a JSON object."""
    if not path.is_file():
        raise SceneError(
            f"{path} does not exist. Give the folder of a scene, which holds "
            "transforms_train.json, transforms_val.json and transforms_test.json."
        )
    try:
        content = configuration.parse_json(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise SceneError(f"{path} is not valid JSON ({error}). Copy it again.") from error
    if not isinstance(content, dict):
        raise SceneError(f"{path} is not a JSON object. Copy it again.")
    return content


def get(record: Any, name: str, path: Path) -> Any:
    """Returns a value that a record of a file must have."""
    if not isinstance(record, dict) or name not in record:
        raise SceneError(f"{path} lacks the key {name!r}. Add it, as the data format asks.")
    return record[name]


def get_text(record: Any, name: str, path: Path) -> str:
    """Returns a text that a record of a file must have."""
    text = get(record, name, path)
    if not isinstance(text, str):
        raise SceneError(f"{name} is {text!r} in {path}. Give the name of a file.")
    return text


def rigid_motion(matrix: Any, name: str, path: Path) -> Float[np.ndarray, "3 4"]:
    """Returns the upper three rows of a 4 x 4 matrix that rotates and moves, nothing else."""
    try:
        pose = np.asarray(matrix, np.float64)
    except (TypeError, ValueError):
        pose = np.empty(0)
    if pose.shape != (4, 4) or not np.all(np.isfinite(pose)):
        raise SceneError(
            f"The transform_matrix of {name} in {path} is not a finite 4 x 4 matrix. Export the "
            "poses again."
        )
    rotation = pose[:3, :3]
    residual = np.max(np.abs(rotation @ rotation.T - np.eye(3)))
    if np.max(np.abs(pose[3] - [0.0, 0.0, 0.0, 1.0])) > _ROTATION_TOLERANCE:
        raise SceneError(
            f"The transform_matrix of {name} in {path} ends with the row {pose[3]}, not "
            "0 0 0 1. Export camera-to-world matrices, with the position in the last column."
        )
    if residual > _ROTATION_TOLERANCE or np.linalg.det(rotation) < 0.0:
        raise SceneError(
            f"The transform_matrix of {name} in {path} does not rotate: its axes are scaled, "
            f"sheared or mirrored (deviation {residual:.2g}). Export the poses without scale."
        )
    return pose[:3]


class FrameFiles(NamedTuple):
    """Files of one frame, below the scene's folder.

    Attributes:
      image: without its ending, which is `.png`.
      mask: with it.
      depth: with it.
    """

    image: str
    mask: str
    depth: str


Naming = Callable[[str, int], FrameFiles]
"""From a split and the number of a frame to its files."""


def plain(split: str, number: int) -> FrameFiles:
    """Returns the plain names."""
    name = f"{split}/r_{number:03d}"
    return FrameFiles(name, f"mask/{name}.png", f"depth/{name}.png")


def raw(split: str, number: int) -> FrameFiles:
    """Returns the names of the raw release."""
    name = f"{split}/r_{number}"
    return FrameFiles(name, f"{name}_mask_0000.png", f"{name}_depth_0000.png")


def write_transforms(scene: Path, split: str, content: dict[str, Any]) -> None:
    """Writes the transforms file of a split; numbers are read back exactly."""
    text = json.dumps(content, indent=1) + "\n"
    (scene / TRANSFORMS.format(split)).write_text(text, encoding="utf-8")


def frame_record(
    files: FrameFiles, pose: Sequence[Sequence[float]], *, masked: bool, deep: bool
) -> dict[str, Any]:
    """Returns a frame of a transforms file.

    Args:
      files: the frame's.
      pose: 4 x 4, camera to world.
      masked: whether it has a mask.
      deep: whether it has a depth map.
    """
    record: dict[str, Any] = {"file_path": f"./{files.image}"}
    if masked:
        record["mask_file_path"] = f"./{files.mask}"
    if deep:
        record["depth_file_path"] = f"./{files.depth}"
    return record | {"transform_matrix": [list(row) for row in pose]}


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
    path = scene / _transforms_name(split)
    content = read_json(path)
    frames = get(content, "frames", path)
    if not isinstance(frames, list) or not frames:
        raise SceneError(f"{path} lists no frames. Add frames, or remove the split.")
    stems = [get_text(frame, "file_path", path) for frame in frames]
    images = tuple(scene / f"{stem}.png" for stem in stems)
    width, height = _image_size(images[0])
    angle = get(content, "camera_angle_x", path)
    if not isinstance(angle, int | float) or not 0.0 < angle < math.pi:
        raise SceneError(
            f"camera_angle_x is {angle!r} in {path}. Give the horizontal field of view in "
            "radians, between 0 and pi."
        )
    poses = np.stack(
        [
            rigid_motion(get(frame, "transform_matrix", path), stem, path)
            for frame, stem in zip(frames, stems, strict=True)
        ]
    )
    masks = _optional_files(scene, frames, stems, "mask_file_path", path)
    depths = _optional_files(scene, frames, stems, "depth_file_path", path)
    result = Frames(
        names=tuple(image.stem for image in images),
        images=images,
        masks=masks,
        depths=depths and tuple(_prefer_exr(depth) for depth in depths),
        cameras=Cameras(poses, width, height, focal_length(width, float(angle))),
    )
    _check_files(result)
    return result


def check_scene(scene: Path, *, needed: Sequence[str] = ("train",)) -> None:
    """Reads every file of every split once, so that a broken one is found before it is needed.

    Args:
      scene: its folder.
      needed: splits that may not be missing.

    Raises:
      SceneError: at the first file that is broken or missing.
    """
    for split in SPLITS:
        if split in needed or (scene / _transforms_name(split)).is_file():
            frames = read_frames(scene, split)
            for readings in (_images(frames), _masks(frames), _depths(frames)):
                collections.deque(readings, maxlen=0)


def read_images(frames: Frames) -> UInt8[np.ndarray, "frames h w 3"]:
    """Reads the images of a split as 8-bit sRGB, over white where they are transparent."""
    return np.stack(list(_images(frames)))


def read_masks(frames: Frames) -> Bool[np.ndarray, "frames h w"]:
    """Reads the object masks of a split.

    Raises:
      SceneError: if the split has none, or one of them marks no object.
    """
    if frames.masks is None:
        raise SceneError(
            f"The frames of {frames.images[0].parent} have no masks. Add mask_file_path to each "
            "frame of the transforms file; docs/masks.md tells how to take over the masks of a "
            "segmentation model."
        )
    return np.stack(list(_masks(frames)))


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
    return planar_depth_to_distance(frames.cameras, np.stack(list(_depths(frames))))


def _images(frames: Frames) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    for path in frames.images:
        yield _checked(image_files.read_rgb(path), path, frames)


def _masks(frames: Frames) -> Iterator[Bool[np.ndarray, "h w"]]:
    for path in frames.masks or ():
        mask = _checked(image_files.read_mask(path), path, frames)
        if not mask.any():
            raise SceneError(
                f"{path} marks no object. Render the mask again, or remove the frame from the "
                "transforms file."
            )
        yield mask


def _depths(frames: Frames) -> Iterator[Float[np.ndarray, "h w"]]:
    for path in frames.depths or ():
        yield _checked(image_files.read_depth(path), path, frames)


def _transforms_name(split: str) -> str:
    return f"transforms_{split}.json"


def _optional_files(
    scene: Path, frames: list[Any], stems: list[str], key: str, path: Path
) -> tuple[Path, ...] | None:
    """Returns the files that all frames name under a key, or `None` if no frame does."""
    lacking = [stem for frame, stem in zip(frames, stems, strict=True) if key not in frame]
    if len(lacking) == len(frames):
        return None
    if lacking:
        raise SceneError(
            f"The frame {lacking[0]} of {path} lacks {key!r}, as {len(lacking)} of {len(frames)} "
            "frames do. Add it to these, or remove it from all."
        )
    return tuple(scene / get_text(frame, key, path) for frame in frames)


def _prefer_exr(path: Path) -> Path:
    exr = path.with_suffix(".exr")
    return exr if exr.is_file() else path


def _image_size(path: Path) -> tuple[int, int]:
    height, width, _ = image_files.read_rgb(path).shape
    return width, height


def _check_files(frames: Frames) -> None:
    for paths in (frames.images, frames.masks or (), frames.depths or ()):
        for path in paths:
            if not path.is_file():
                raise SceneError(
                    f"{path} does not exist, but the transforms file names it. Copy the scene "
                    "again, or remove the frame."
                )
    name, count = collections.Counter(frames.names).most_common(1)[0]
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
