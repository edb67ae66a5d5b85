"""Reads and writes captures in nerfstudio's dialect of `transforms.json` (NumPy only).

    {source}/transforms.json    cameras, shared or in each frame; poses; names of files
    {source}/images/...         PNG or JPEG
    {source}/masks/...          one an image, or none at all; black is what training ignores

Its camera frame is ours (x right, y up, looking along -z), and so is its pixel frame: a principal
point of half the width and half the height is the image's centre. `applied_transform` and
`applied_scale` say what the poses *have been* moved by, `p -> applied_scale applied_transform(p)`:
they are not to be applied once more.

Source: https://docs.nerf.studio/quickstart/data_conventions.html. `camera_angle_x` and file names
without an ending are Instant NGP's, whose files are alike.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from refref_jax.data import files, transforms
from refref_jax.data.errors import SceneError
from refref_jax.data.local_layout import SPLITS
from refref_jax.data.nerfstudio.frames import (
    DISTORTION,
    MODEL,
    CaptureFrame,
    read_frame,
    read_number,
)
from refref_jax.geometry.cameras import Cameras

FILE = "transforms.json"

# Grey levels from here on are white: JPEG leaves some beside every edge.
_WHITE = 128


class Capture(NamedTuple):
    """What a `transforms.json` says that we can use.

    Attributes:
      frames: ordered by name.
      splits: numbers of the frames of `train`, `val` and `test`, or `None` if the file lists none.
      applied: what the poses were turned and moved by, from the world in which they were found.
      applied_scale: what they were scaled by after that.
      has_depth: whether frames name depth maps, which are not read.
    """

    frames: tuple[CaptureFrame, ...]
    splits: dict[str, tuple[int, ...]] | None
    applied: Float[np.ndarray, "3 4"]
    applied_scale: float
    has_depth: bool


def read_capture(source: Path) -> Capture:
    """Reads a capture, and the size of each of its images, but no pixels.

    Args:
      source: the folder of a `transforms.json`, or such a file of any name.

    Raises:
      SceneError: if a file is missing or broken, if a pose is not a rigid motion, if a camera is
        not a pinhole without distortion, or if some frames have a mask and others none.
    """
    path = source if source.suffix == ".json" else source / FILE
    if not path.is_file():
        is_ours = (path.parent / "transforms_train.json").is_file()
        advice = (
            "The folder is a scene in our own layout: no conversion is needed."
            if is_ours
            else f"Give the folder that holds {FILE}."
        )
        raise SceneError(f"{path} does not exist. {advice}")
    content = transforms.read_json(path)
    records = transforms.get(content, "frames", path)
    if not isinstance(records, list) or not records:
        raise SceneError(f"{path} lists no frames. Process the images again.")
    frames = sorted(
        (read_frame(content, record, path) for record in records), key=lambda frame: frame.name
    )
    _check_masks(frames, path)
    scale = read_number([content], "applied_scale", path)
    if scale is not None and not scale > 0.0:
        raise SceneError(f"applied_scale is {scale:g} in {path}. Give a positive number.")
    return Capture(
        frames=tuple(frames),
        splits=_splits(content, [frame.name for frame in frames], path),
        applied=_applied_transform(content, path),
        applied_scale=1.0 if scale is None else scale,
        has_depth=any("depth_file_path" in record for record in records),
    )


def every_nth(frames: int, *, every: int) -> dict[str, tuple[int, ...]]:
    """Returns splits of a capture that lists none: each n-th frame is test, the first included.

    So does nerfstudio in its evaluation mode `interval`.

    Args:
      frames: their number.
      every: n, at least 2.

    Raises:
      SceneError: if no frame is left to train on.
    """
    train = tuple(number for number in range(frames) if number % every)
    if not train:
        raise SceneError(
            f"There is {frames} frame, and the first of every {every} is for testing, so none is "
            "left to train on. Capture more."
        )
    return {"train": train, "test": tuple(range(0, frames, every))}


def read_capture_mask(path: Path) -> Bool[np.ndarray, "h w"]:
    """Returns where a mask is not black; the grey that JPEG adds around edges counts half-way."""
    if path.suffix.lower() in (".jpg", ".jpeg"):
        return files.read_rgb(path).max(axis=-1) >= _WHITE
    return files.read_mask(path)


def write_capture(
    out: Path,
    cameras: Mapping[str, Cameras],
    images: Mapping[str, Sequence[str]],
    masks: Mapping[str, Sequence[str]],
) -> None:
    """Writes the `transforms.json` of images that are there.

    nerfstudio asks for all three lists of files if there is one: what is missing is the test split,
    or what stands for it, once more.

    Args:
      out: the folder.
      cameras: of each split.
      images: names of each split's images, below the folder.
      masks: likewise; of no split if there are none.
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


def _check_masks(frames: Sequence[CaptureFrame], path: Path) -> None:
    lacking = [frame.name for frame in frames if frame.mask is None]
    if 0 < len(lacking) < len(frames):
        raise SceneError(
            f"{lacking[0]} in {path} has no mask_path, as {len(lacking)} of {len(frames)} frames "
            "have none. Add it to these, or remove it from all."
        )


def _applied_transform(content: dict[str, Any], path: Path) -> Float[np.ndarray, "3 4"]:
    rows = content.get("applied_transform", np.eye(4).tolist())
    if isinstance(rows, list) and len(rows) == 3:
        rows = [*rows, [0.0, 0.0, 0.0, 1.0]]
    return transforms.rigid_motion(rows, "the applied_transform", path)


def _splits(
    content: dict[str, Any], names: Sequence[str], path: Path
) -> dict[str, tuple[int, ...]] | None:
    """Returns the splits that a file lists; one that repeats another is left out."""
    numbers = {Path(name): number for number, name in enumerate(names)}
    found: dict[str, tuple[int, ...]] = {}
    for split in ("train", "test", "val"):
        listed = content.get(f"{split}_filenames") or []
        for name in listed:
            if not isinstance(name, str) or Path(name) not in numbers:
                raise SceneError(
                    f"{split}_filenames of {path} lists {name!r}, which is no frame's file_path. "
                    "Add the frame, or remove the name."
                )
        frames = tuple(sorted(numbers[Path(name)] for name in listed))
        if frames and frames not in found.values():
            found[split] = frames
    if found and "train" not in found:
        raise SceneError(f"{path} lists no train_filenames. Add the list, or remove the others.")
    return {split: found[split] for split in SPLITS if split in found} or None
