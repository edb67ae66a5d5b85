"""Writes captures as scene folders (NumPy only).

A `Layout` says what becomes of the photographs of a split: they are copied, cropped, or resampled
into one pinhole. It is found for all splits before anything is written.
"""

import json
import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import trimesh
from jaxtyping import Bool, Float, UInt8

from experiments.captures import capture as captures
from experiments.captures import cropping, photographs, resampling
from experiments.captures.capture import CaptureFrame, PointCloud
from experiments.captures.cropping import Crop
from experiments.captures.resampling import Frame, Pinhole
from refref_jax import atomic_files
from refref_jax.data import SceneError, image_files, meshes, scene_folder
from refref_jax.geometry.cameras import Cameras

RECORD = "import.json"
"""File of a scene that says where it came from."""

POINTS = "points.ply"

Sense = Literal["object", "background", "none"]
"""White area of a capture's masks: the object or the background; `none` for no masks."""

# Limits of a camera: tangent of half its field of view, and pixels of its images.
_LEAST_TANGENT, _MOST_PIXELS = 1e-3, 1 << 26

# Width of the masks in which the object is searched, pixels.
_COARSE = 200


class Layout(NamedTuple):
    """How the photographs of a split become images of one camera.

    Attributes:
      photographs: frames of the capture.
      frames: place of each photograph in the camera.
      pinhole: the camera.
      crop: windows of the photographs, if they are cropped only.
      exact: whether pixels are kept as they are.
      kept: share of each photograph that its image shows.
      narrowest: name of the photograph that limits the field of view.
    """

    photographs: tuple[CaptureFrame, ...]
    frames: tuple[Frame, ...]
    pinhole: Pinhole
    crop: Crop | None
    exact: bool
    kept: Float[np.ndarray, " frames"]
    narrowest: str


class Written(NamedTuple):
    """Summary of a split that was written.

    Attributes:
      masked: share of the pixels that the masks mark, or `None` without masks.
      empty: names of the frames whose masks mark no pixel.
    """

    masked: float | None
    empty: tuple[str, ...]


class Content(NamedTuple):
    """What a scene holds besides images.

    Attributes:
      properties: content of `scene.json`.
      record: content of `import.json`, to which cameras and names are added.
      meshes: vertices and faces of meshes by file name, in the world of the scene.
      points: points in the world of the scene, or `None`.
    """

    properties: Mapping[str, Any]
    record: Mapping[str, Any]
    meshes: Mapping[str, tuple[np.ndarray, np.ndarray]]
    points: PointCloud | None


def find_layout(
    found: Sequence[CaptureFrame], *, width: int | None = None, resample: bool = True
) -> Layout:
    """Returns how the photographs of a split become images of one camera.

    Args:
      found: frames of the split.
      width: width of the images in pixels; that of the photographs by default, see `resampling`.
      resample: whether pixels may be interpolated; otherwise photographs are cropped only.

    Raises:
      SceneError: if a lens folds, or the photographs cannot share a camera.
    """
    if not resample:
        crop = cropping.find_crop(found)
        frames = tuple(Frame(frame.name, frame.lens, False) for frame in found)
        size = np.array([crop.columns.size, crop.rows.size])
        kept = np.array([np.prod(size / frame.intrinsics[4:]) for frame in found])
        pinhole = Pinhole(crop.columns.size, crop.rows.size, crop.focal)
        _check_size(pinhole, found[0].name)
        return Layout(tuple(found), frames, pinhole, crop, True, kept, found[0].name)
    turned = resampling.turns([frame.lens for frame in found])
    frames = tuple(
        Frame(frame.name, frame.lens, turn) for frame, turn in zip(found, turned, strict=True)
    )
    shared = resampling.share(frames, width=width)
    _check_size(shared.pinhole, shared.narrowest)
    return Layout(
        tuple(found), frames, shared.pinhole, None, shared.exact, shared.kept, shared.narrowest
    )


def _check_size(pinhole: Pinhole, name: str) -> None:
    """Refuses cameras of which no scene can have images."""
    width, height, focal = pinhole
    if not _LEAST_TANGENT <= 0.5 * width / focal <= 1.0 / _LEAST_TANGENT:
        raise SceneError(
            f"The focal length is {focal:g} pixels for images of {width} x {height}, as that of "
            f"{name}. Check the focal lengths of the capture."
        )
    if width * height > _MOST_PIXELS:
        raise SceneError(
            f"Images of {width} x {height} pixels are too large. Give a smaller width (--width)."
        )


def turned_poses(
    layout: Layout, poses: Float[np.ndarray, "frames 3 4"]
) -> Float[np.ndarray, "frames 3 4"]:
    """Returns the poses of a split's images, some of which are turned."""
    turned = poses.copy()
    for number, frame in enumerate(layout.frames):
        if frame.turned:
            turned[number, :, :3] = poses[number, :, :3] @ resampling.TURN
    return turned


def read_image(layout: Layout, number: int) -> UInt8[np.ndarray, "h w 3"]:
    """Returns the pixels of an image of the scene.

    Raises:
      SceneError: if the photograph is broken.
    """
    path, frame = layout.photographs[number].image, layout.frames[number]
    if not layout.exact:
        linear = photographs.read_linear(path)
        return photographs.to_srgb(resampling.resample(linear, frame, layout.pinhole))
    if photographs.is_plain(path):
        pixels = image_files.read_rgb(path)
    else:
        pixels = photographs.to_srgb(photographs.read_linear(path))
    return _framed(pixels, layout, number)


def read_mask(layout: Layout, number: int, sense: Sense) -> Bool[np.ndarray, "h w"]:
    """Returns the mask of an image of the scene; all false if it has none.

    Raises:
      SceneError: if the mask is broken.
    """
    photograph, frame = layout.photographs[number], layout.frames[number]
    if photograph.mask is None:
        return np.zeros((layout.pinhole.height, layout.pinhole.width), bool)
    mask = captures.read_mask(photograph.mask, white=sense)
    if layout.exact:
        return _framed(mask, layout, number)
    return resampling.resample_mask(mask, frame, layout.pinhole)


def coarse_masks(
    layout: Layout, poses: Float[np.ndarray, "frames 3 4"], sense: Sense
) -> tuple[Bool[np.ndarray, "frames h w"], Cameras]:
    """Returns masks of a width of 200 pixels or less, and their cameras.

    Args:
      layout: layout of the split.
      poses: poses of its images.
      sense: meaning of white.
    """
    width, height, focal = layout.pinhole
    step = max(1, math.ceil(max(width, height) / _COARSE))
    masks = [_pooled(read_mask(layout, number, sense), step) for number in range(len(poses))]
    rows, columns = masks[0].shape
    return np.stack(masks), Cameras(poses, columns, rows, focal / step)


def write_scene(
    layouts: Mapping[str, Layout],
    poses: Mapping[str, Float[np.ndarray, "frames 3 4"]],
    out: Path,
    content: Content,
    sense: Sense,
    *,
    step: Callable[[], None],
) -> dict[str, Written]:
    """Writes the scene, which appears when it is complete.

    Args:
      layouts: layout of each split.
      poses: poses of their images, in the world of the scene.
      out: folder of the scene; must not exist.
      content: other content of the scene.
      sense: meaning of white in the masks: `object` or `background`; `none` drops the masks.
      step: function called after every image.

    Raises:
      SceneError: if the folder exists, or an image or mask is broken.
    """
    refuse_existing(out)
    with atomic_files.new_folder(out) as scene:
        written = {
            split: _write_split(layout, poses[split], split, scene, sense, step)
            for split, layout in layouts.items()
        }
        if content.meshes:
            (scene / "meshes").mkdir()
        for name, (vertices, faces) in content.meshes.items():
            trimesh.Trimesh(vertices, faces, process=False).export(scene / "meshes" / name)
        if content.points is not None:
            captures.write_points(scene / POINTS, content.points)
        splits = {split: _describe(layout) for split, layout in layouts.items()}
        _write_json(scene / "scene.json", content.properties)
        _write_json(scene / RECORD, {**content.record, "splits": splits})
    return written


def refuse_existing(out: Path) -> None:
    """Raises `SceneError` if a folder exists."""
    if out.exists():
        raise SceneError(f"{out} exists, and nothing is overwritten. Give a new folder.")


def read_meshes(folder: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Reads all meshes of a folder, by file name.

    Raises:
      SceneError: if there are none, one is broken, or its name ends on no material.
    """
    paths = meshes.mesh_files(folder, folder=folder)
    if not paths:
        raise SceneError(f"{folder} has no PLY files. Give the folder of the object's meshes.")
    return {path.name: meshes.read_mesh(path) for path in paths}


def _write_split(
    layout: Layout,
    poses: Float[np.ndarray, "frames 3 4"],
    split: str,
    scene: Path,
    sense: Sense,
    step: Callable[[], None],
) -> Written:
    masked = sense != "none" and any(each.mask is not None for each in layout.photographs)
    records, shares, empty = [], [], []
    for number, photograph in enumerate(layout.photographs):
        names = scene_folder.plain(split, number)
        _write_image(layout, number, scene / f"{names.image}.png")
        if masked:
            mask = read_mask(layout, number, sense)
            (scene / names.mask).parent.mkdir(parents=True, exist_ok=True)
            image_files.write_mask(scene / names.mask, mask)
            shares.append(mask.mean())
            empty += [] if mask.any() else [photograph.name]
        pose = [*poses[number].tolist(), [0.0, 0.0, 0.0, 1.0]]
        record = scene_folder.frame_record(names, pose, masked=masked, deep=False)
        records.append(record | {"source": photograph.name})
        step()
    angle = 2.0 * math.atan(0.5 * layout.pinhole.width / layout.pinhole.focal)
    scene_folder.write_transforms(scene, split, {"camera_angle_x": angle, "frames": records})
    return Written(float(np.mean(shares)) if shares else None, tuple(empty))


def _write_image(layout: Layout, number: int, path: Path) -> None:
    """Writes an image; a PNG whose pixels stay as they are is copied byte for byte."""
    source = layout.photographs[number].image
    pixels = read_image(layout, number)
    path.parent.mkdir(parents=True, exist_ok=True)
    unchanged = layout.exact and pixels.shape[:2] == image_files.read_size(source)
    turned = layout.frames[number].turned
    is_png = source.suffix.lower() == ".png" and photographs.is_plain(source)
    if unchanged and is_png and not turned:
        shutil.copyfile(source, path)
    else:
        image_files.write_png(path, pixels)


def _framed(pixels: np.ndarray, layout: Layout, number: int) -> np.ndarray:
    """Returns pixels that are kept as they are, cropped or turned."""
    if layout.crop is not None:
        pixels = pixels[layout.crop.window(number)]
    turned = np.rot90(pixels, k=-1) if layout.frames[number].turned else pixels
    return np.ascontiguousarray(turned)


def _pooled(mask: Bool[np.ndarray, "h w"], step: int) -> Bool[np.ndarray, "h w"]:
    """Returns whether each block of pixels has one of a mask."""
    rows, columns = (-(-size // step) for size in mask.shape)
    padded = np.zeros((rows * step, columns * step), bool)
    padded[: mask.shape[0], : mask.shape[1]] = mask
    return padded.reshape(rows, step, columns, step).any(axis=(1, 3))


def _describe(layout: Layout) -> dict[str, Any]:
    return {
        "camera": layout.pinhole._asdict(),
        "resampled": not layout.exact,
        "images": [
            {
                "source": photograph.name,
                "turned": frame.turned,
                **photograph.intrinsics._asdict(),
                "distortion": photograph.distortion.describe(),
            }
            for photograph, frame in zip(layout.photographs, layout.frames, strict=True)
        ],
    }


def _write_json(path: Path, content: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
