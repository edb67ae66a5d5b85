"""Reads and writes captures in nerfstudio's `transforms.json` format (NumPy only).

    {source}/transforms.json    cameras, shared or in each frame; poses; names of files
    {source}/images/...         PNG, JPEG or EXR
    {source}/masks/...          one per image, or none at all; training ignores black pixels

Values that all frames share are at the top of the file; otherwise each frame has its own, as in the
captures of Polycam and Record3D.

The camera frame is that of this library (x right, y up, looking along -z), and so is the pixel
frame: a principal point of half the width and half the height is the image's centre.
`applied_transform` and `applied_scale` state how the poses *were* transformed,
`p -> applied_scale applied_transform(p)`: they must not be applied again.

Source: https://docs.nerf.studio/quickstart/data_conventions.html. `camera_angle_x` and file names
without an extension are Instant NGP's, whose files have the same form.
"""

import collections
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from experiments.captures.capture import (
    Capture,
    CaptureFrame,
    PointCloud,
    check_sizes,
    missing_photographs,
    read_points,
)
from experiments.captures.lenses import Distortion, Intrinsics
from refref_jax import configuration
from refref_jax.choices import SPLITS
from refref_jax.data import SceneError, file_inside, image_files, scene_folder
from refref_jax.geometry.cameras import Cameras, focal_length

MODEL = "OPENCV"
"""Camera model of captures that are written, without distortion."""

_RATIONAL = "FULL_OPENCV"
_FISHEYES = ("OPENCV_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_RADIAL_FISHEYE")
_PINHOLES = (MODEL, "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", _RATIONAL)

DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
"""Distortion coefficients of nerfstudio's models."""

# Coefficients that a model has not; nerfstudio's own readers disagree about them.
_HAS_NOT = {MODEL: ("k4", "k5", "k6"), _RATIONAL: (), _FISHEYES[0]: ("k5", "k6", "p1", "p2")}

FILE = "transforms.json"


def read_frame(content: dict[str, Any], record: Any, path: Path) -> CaptureFrame:
    """Reads a frame, and the size of its image, but no pixels.

    Args:
      content: content of the whole file.
      record: record of the frame.
      path: path of the file.

    Raises:
      SceneError: if a file is missing, the pose is not a rigid motion, or the camera's model is
        not known.
    """
    name, image = _photograph(record, path)
    matrix = scene_folder.get(record, "transform_matrix", path)
    mask = None
    if "mask_path" in record:
        mask = file_inside([path.parent], record["mask_path"], where="mask_path", path=path)
    distortion = _distortion(content, record, name, path)
    if mask is not None and not mask.is_file():
        raise SceneError(
            f"{mask} does not exist, but {path} names it. Copy it there, or remove the frame."
        )
    return CaptureFrame(
        name=name,
        image=image,
        mask=mask,
        pose=scene_folder.rigid_motion(matrix, name, path),
        intrinsics=_intrinsics(content, record, image, path),
        distortion=distortion,
    )


def _photograph(record: Any, path: Path) -> tuple[str, Path]:
    """Returns the name of a frame's photograph, and its file."""
    name = scene_folder.get_text(record, "file_path", path)
    # Instant NGP omits the extension.
    named = name if Path(name).suffix else f"{name}.png"
    return name, file_inside([path.parent], named, where="file_path", path=path)


def read_number(records: Sequence[dict[str, Any]], name: str, path: Path) -> float | None:
    """Returns a number by its key in one of several records, or `None`.

    Raises:
      SceneError: if a value is not a finite number, or two records contradict each other.
    """
    values = [record[name] for record in records if name in record]
    for value in values:
        if not math.isfinite(configuration.as_number(value)):
            shown = configuration.abridged(value)
            raise SceneError(f"{name} is {shown} in {path}. Give a finite number.")
    if len(set(values)) > 1:
        raise SceneError(
            f"{name} is {values[0]} for all frames of {path}, and {values[1]} in one of them. "
            "Remove one of the two."
        )
    return float(values[0]) if values else None


def _distortion(
    content: dict[str, Any], record: dict[str, Any], name: str, path: Path
) -> Distortion:
    both = (content, record)
    model = record.get("camera_model", content.get("camera_model", MODEL))
    if any(each.get("is_fisheye", False) for each in both):
        model = _FISHEYES[0]
    if model not in (*_PINHOLES, *_FISHEYES):
        shown = configuration.abridged(model)
        raise SceneError(
            f"The camera of {name} in {path} is {shown}, which is not read. Read are "
            f"{', '.join((*_PINHOLES, *_FISHEYES))}: export pinhole images."
        )
    values = {key: read_number(both, key, path) or 0.0 for key in (*DISTORTION, "k5", "k6")}
    family = _FISHEYES[0] if model in _FISHEYES else model if model == _RATIONAL else MODEL
    for key in _HAS_NOT[family]:
        if values[key]:
            raise SceneError(
                f"The camera of {name} in {path} is {model} with {key} = {values[key]:g}, "
                f"which {family} does not have. Remove it, or name the model that has it."
            )
    radial = tuple(values[f"k{number}"] for number in range(1, 7))
    return Distortion(model in _FISHEYES, radial, (values["p1"], values["p2"]))


def _intrinsics(
    content: dict[str, Any], record: dict[str, Any], image: Path, path: Path
) -> Intrinsics:
    given = {
        key: read_number((content, record), key, path)
        for key in ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x", "camera_angle_y")
    }
    height, width = image_files.read_size(image)
    declared = (given["w"] or width, given["h"] or height)
    if declared != (width, height):
        raise SceneError(
            f"{image} is {width} x {height} pixels, but {path} says {declared[0]:g} x "
            f"{declared[1]:g}. Use the images that belong to the file, or create it again."
        )
    along = _focal(given["fl_x"], given["camera_angle_x"], width, image, path)
    across = _focal(given["fl_y"], given["camera_angle_y"], height, image, path) or along
    if along is None or across is None:
        raise SceneError(
            f"{path} lacks the focal length of {image.name}. Add fl_x and fl_y in pixels, or "
            "camera_angle_x in radians."
        )
    centre_x = 0.5 * width if given["cx"] is None else given["cx"]
    centre_y = 0.5 * height if given["cy"] is None else given["cy"]
    return Intrinsics(along, across, centre_x, centre_y, width, height)


def _focal(
    pixels: float | None, angle: float | None, size: int, image: Path, path: Path
) -> float | None:
    """Returns a focal length in pixels, or `None` if neither it nor its angle is given."""
    if pixels is None and angle is None:
        return None
    if pixels is not None and pixels > 0.0:
        return pixels
    if pixels is None and angle is not None and 0.0 < angle < math.pi:
        return focal_length(size, angle)
    wrong = f"angle of view is {angle:g}" if pixels is None else f"focal length is {pixels:g}"
    raise SceneError(
        f"The {wrong} for {image.name} in {path}. Give a positive fl_x and fl_y in pixels, or "
        "angles in radians between 0 and pi."
    )


def read_capture(source: Path) -> Capture:
    """Reads a capture, and the size of each of its images, but no pixels.

    Args:
      source: folder of a `transforms.json`, or path of such a file with any name.

    Raises:
      SceneError: if a file is missing or broken, if a pose is not a rigid motion, if the model of a
        camera is not known.
    """
    path = source if source.suffix == ".json" else source / FILE
    if not path.is_file():
        is_ours = (path.parent / "transforms_train.json").is_file()
        advice = (
            "The folder already is a scene folder: no conversion is needed."
            if is_ours
            else f"Give the folder that holds {FILE}."
        )
        raise SceneError(f"{path} does not exist. {advice}")
    content = scene_folder.read_json(path)
    records = scene_folder.get(content, "frames", path)
    if not isinstance(records, list) or not records:
        raise SceneError(f"{path} lists no frames. Process the images again.")
    named = [(*_photograph(record, path), record) for record in records]
    counted = collections.Counter(Path(name) for name, _, _ in named)
    if repeated := [name for name, count in counted.items() if count > 1]:
        raise SceneError(f"{path} lists {repeated[0]} twice. Remove one of the frames.")
    missing = missing_photographs({name: image for name, image, _ in named}, path)
    there = [record for name, _, record in named if name not in missing]
    frames = sorted(
        (read_frame(content, record, path) for record in there), key=lambda frame: frame.name
    )
    check_sizes(frames)
    scale = read_number([content], "applied_scale", path)
    if scale is not None and not scale > 0.0:
        raise SceneError(f"applied_scale is {scale:g} in {path}. Give a positive number.")
    return Capture(
        frames=tuple(frames),
        splits=_splits(content, [frame.name for frame in frames], missing, path),
        applied=_applied_transform(content, path),
        applied_scale=1.0 if scale is None else scale,
        has_depth=any("depth_file_path" in record for record in records),
        points=_points(content, path),
        missing=missing,
    )


def _points(content: dict[str, Any], path: Path) -> PointCloud | None:
    """Returns the points that a file names; they are in the world of its poses."""
    if content.get("ply_file_path") is None:
        return None
    name = scene_folder.get_text(content, "ply_file_path", path)
    file = file_inside([path.parent], name, where="ply_file_path", path=path)
    if not file.is_file():
        raise SceneError(
            f"{file} does not exist, but {path} names it. Copy it there, or remove ply_file_path."
        )
    return read_points(file)


def write_capture(
    out: Path,
    cameras: Mapping[str, Cameras],
    images: Mapping[str, Sequence[str]],
    masks: Mapping[str, Sequence[str]],
) -> None:
    """Writes the `transforms.json` for images that already exist.

    nerfstudio requires all three lists of files if there is one: a missing list repeats the test
    split or, without one, `val` or `train`.

    Args:
      out: the folder.
      cameras: cameras of each split.
      images: names of each split's images, relative to the folder.
      masks: names of each split's masks; empty if there are none.
    """
    lenses = {split: _describe_lens(each) for split, each in cameras.items()}
    first = next(iter(lenses.values()))
    is_shared = all(lens == first for lens in lenses.values())
    frames = []
    for split, each in cameras.items():
        for number, pose in enumerate(each.poses):
            record: dict[str, Any] = {"file_path": images[split][number]}
            if split in masks:
                record["mask_path"] = masks[split][number]
            record |= {} if is_shared else lenses[split]
            frames.append(record | {"transform_matrix": [*pose.tolist(), [0.0, 0.0, 0.0, 1.0]]})
    held_out = images.get("test", images.get("val", images["train"]))
    content = {
        "camera_model": MODEL,
        **(first if is_shared else {}),
        **{f"{split}_filenames": list(images.get(split, held_out)) for split in SPLITS},
        "frames": frames,
    }
    (out / FILE).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _describe_lens(cameras: Cameras) -> dict[str, float]:
    return {
        "fl_x": cameras.focal,
        "fl_y": cameras.focal,
        "cx": 0.5 * cameras.width,
        "cy": 0.5 * cameras.height,
        "w": cameras.width,
        "h": cameras.height,
        **dict.fromkeys(DISTORTION, 0.0),
    }


def _applied_transform(content: dict[str, Any], path: Path) -> Float[np.ndarray, "3 4"]:
    rows = content.get("applied_transform", np.eye(4).tolist())
    if isinstance(rows, list) and len(rows) == 3:
        rows = [*rows, [0.0, 0.0, 0.0, 1.0]]
    return scene_folder.rigid_motion(rows, "the applied_transform", path)


def _splits(
    content: dict[str, Any], names: Sequence[str], missing: Sequence[str], path: Path
) -> dict[str, tuple[int, ...]] | None:
    """Returns the splits that a file lists, without repetitions of another split.

    Args:
      content: content of the file.
      names: names of the frames.
      missing: names of those that are left out.
      path: path of the file.
    """
    numbers = {Path(name): number for number, name in enumerate(names)}
    unseen = {Path(name) for name in missing}
    found: dict[str, tuple[int, ...]] = {}
    for split in ("train", "test", "val"):
        listed = content.get(f"{split}_filenames") or []
        if not isinstance(listed, list):
            raise SceneError(f"{split}_filenames is {listed!r} in {path}. Give a list of names.")
        for name in listed:
            if not isinstance(name, str) or Path(name) not in numbers.keys() | unseen:
                raise SceneError(
                    f"{split}_filenames of {path} lists {name!r}, which is not the file_path of a "
                    "frame. Add the frame, or remove the name."
                )
        seen = (Path(name) for name in listed if Path(name) not in unseen)
        frames = tuple(sorted(numbers[name] for name in seen))
        if frames and frames not in found.values():
            found[split] = frames
    if found and "train" not in found:
        raise SceneError(f"{path} lists no train_filenames. Add the list, or remove the others.")
    return {split: found[split] for split in SPLITS if split in found} or None
