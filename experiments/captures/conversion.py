"""Converts between nerfstudio captures and scene folders (NumPy only).

All cameras of a split share one focal length and a centred principal point. A capture is brought
into this form without interpolation, or refused: images are cropped so that the principal point is
their centre, to within half a pixel, and cameras whose focal lengths differ by less than half a
pixel at the image border share their mean. `Placement` moves and scales the world of the cameras.
"""

import math
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from experiments.captures import nerfstudio
from experiments.captures.nerfstudio import CaptureFrame
from refref_jax import atomic_files
from refref_jax.data import SceneError, image_files, scene_folder
from refref_jax.data.scene_folder import Frames

USUAL_DISTANCE = 4.0
"""Distance of the data set's cameras from the origin, world units, for captures without a scale."""

# Axes count as parallel if their intersection moves more than this per unit of their shift.
_WORST_CONDITION = 1e4

Sense = Literal["object", "background", "none"]
"""White area of nerfstudio's masks: the object or the background; `none` for no masks."""

# Maximum displacement of a pixel at the border of an image, pixels.
_TOLERANCE = 0.5

# Minimum share of an image that is kept; for less, the principal point must be wrong.
_LEAST_KEPT = 0.5


class Windows(NamedTuple):
    """Crop windows of the images of a split, along one axis.

    Attributes:
      starts: first pixel of each image's window.
      size: size of all windows, pixels.
      shift: maximum distance of a principal point from the centre of its window, pixels.
    """

    starts: Int[np.ndarray, " images"]
    size: int
    shift: float


def centred_windows(centres: Float[np.ndarray, " images"], size: int) -> Windows:
    """Returns the largest windows of one size that are centred on the principal points.

    Of the largest even and the largest odd size, the one with the smaller shift is used, and the
    larger one if the shifts are equal.

    Args:
      centres: principal points along the axis, pixels from the border, within the images.
      size: size of the images, pixels.
    """
    found: list[Windows] = []
    for kept in range(size, 0, -1):
        starts = np.rint(centres - 0.5 * kept).astype(np.int64)
        if np.all((starts >= 0) & (starts + kept <= size)):
            found.append(Windows(starts, kept, float(np.abs(starts + 0.5 * kept - centres).max())))
        if len(found) == 2:
            break
    return min(found, key=lambda windows: windows.shift)


class Placement(NamedTuple):
    """A change of the world frame: `x -> scale (x - centre)`.

    Attributes:
      centre: position of the new origin, in old units.
      scale: new units per old unit.
    """

    centre: Float[np.ndarray, "3"]
    scale: float


def place(
    poses: Float[np.ndarray, "cameras 3 4"], placement: Placement
) -> Float[np.ndarray, "cameras 3 4"]:
    """Returns camera-to-world matrices in the changed frame; rotations do not change."""
    positions = placement.scale * (poses[..., 3] - placement.centre)
    return np.concatenate([poses[..., :3], positions[..., None]], axis=-1)


def undo_motion(
    poses: Float[np.ndarray, "cameras 3 4"], motion: Float[np.ndarray, "3 4"], scale: float
) -> Float[np.ndarray, "cameras 3 4"]:
    """Returns poses as they were before `p -> scale motion(p)`.

    Args:
      poses: camera-to-world matrices.
      motion: rotation and translation, which were applied first.
      scale: scale of positions, which was applied second.
    """
    back = motion[:, :3].T
    positions = (poses[..., 3] / scale - motion[:, 3]) @ back.T
    return np.concatenate([back @ poses[..., :3], positions[..., None]], axis=-1)


def meeting_point(poses: Float[np.ndarray, "cameras 3 4"]) -> Float[np.ndarray, "3"]:
    """Returns the point that is nearest to all optical axes, by least squares.

    Raises:
      SceneError: if the axes are nearly parallel, so that they have no such point.
    """
    axes = poses[..., 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    total = across.sum(axis=0)
    if np.linalg.cond(total) > _WORST_CONDITION:
        raise SceneError(
            "All cameras look in the same direction, so the centre of the scene is unknown. Give "
            "centre, such as (0.5, 0, 1.2)."
        )
    return np.linalg.solve(total, np.einsum("nij,nj->i", across, poses[..., 3]))


class View(NamedTuple):
    """A frame that is converted.

    Attributes:
      frame: frame of the capture.
      pose: camera-to-world matrix in the scene.
    """

    frame: CaptureFrame
    pose: Float[np.ndarray, "3 4"]


class Lens(NamedTuple):
    """The camera that all frames of a split share.

    Attributes:
      columns, rows: crop windows of the images.
      focal: focal length, pixels.
      stretch: maximum displacement of border pixels by the shared focal length, pixels.
    """

    columns: Windows
    rows: Windows
    focal: float
    stretch: float


class Converted(NamedTuple):
    """Summary of a split that was written.

    Attributes:
      frames: number of frames.
      before: width and height of the capture's images.
      lens: shared camera of the frames.
      masked: share of the pixels that the masks mark, or `None` without masks.
    """

    frames: int
    before: tuple[int, int]
    lens: Lens
    masked: float | None


def positions(capture: nerfstudio.Capture, *, original: bool) -> Float[np.ndarray, "frames 3 4"]:
    """Returns the poses of all frames.

    Args:
      capture: the capture.
      original: whether to undo `applied_transform` and `applied_scale`.
    """
    poses = np.stack([frame.pose for frame in capture.frames])
    if original:
        return undo_motion(poses, capture.applied, capture.applied_scale)
    return poses


def write_scene(
    views: dict[str, Sequence[View]], out: Path, sense: Sense, *, step: Callable[[], None]
) -> dict[str, Converted]:
    """Writes the scene, which appears when it is complete.

    Args:
      views: frames and poses of each split.
      out: folder of the scene; must not exist.
      sense: meaning of white in the masks: `object` or `background`; `none` drops the masks.
      step: function called after every image.

    Raises:
      SceneError: if the folder exists, if the cameras of a split differ too much to share a lens,
        if an image or mask is broken or of another size, or if a mask is empty.
    """
    if out.exists():
        raise SceneError(f"{out} exists, and nothing is overwritten. Give a new folder.")
    lenses = {split: _common_lens([view.frame for view in each]) for split, each in views.items()}
    with atomic_files.new_folder(out) as scene:
        return {
            split: _write_split(each, split, scene, lenses[split], sense, step)
            for split, each in views.items()
        }


def _common_lens(frames: Sequence[CaptureFrame]) -> Lens:
    first = frames[0].intrinsics
    for frame in frames:
        lens = frame.intrinsics
        if (lens.width, lens.height) != (first.width, first.height):
            raise SceneError(
                f"{frame.name} is {lens.width} x {lens.height} pixels, but {frames[0].name} is "
                f"{first.width} x {first.height}. Images of a split must have one size: leave "
                "out one size, or list them in different splits (train_filenames, ...)."
            )
    half = 0.5 * max(first.width, first.height)
    focals = np.array([(frame.intrinsics.focal_x, frame.intrinsics.focal_y) for frame in frames])
    focal = float(focals.mean())
    for frame, (along, across) in zip(frames, focals, strict=True):
        if half * abs(along - across) / (along + across) > _TOLERANCE:
            raise SceneError(
                f"The pixels of {frame.name} are not square: fl_x is {along:g}, and fl_y "
                f"{across:g}. Estimate a single focal length (COLMAP's SIMPLE_RADIAL, then "
                "image_undistorter), or resize the images to square pixels."
            )
    stretches = half * np.abs(focals - focal).max(axis=-1) / focal
    if stretches.max() > _TOLERANCE:
        frame = frames[int(np.argmax(stretches))]
        raise SceneError(
            f"The focal length of {frame.name} is {frame.intrinsics.focal_x:g} pixels, but the "
            f"mean is {focal:g}. All frames of a split share one: calibrate them as one camera "
            "(COLMAP's single_camera), or list them in different splits (train_filenames, ...)."
        )
    columns = _windows(frames, [frame.intrinsics.centre_x for frame in frames], first.width)
    rows = _windows(frames, [frame.intrinsics.centre_y for frame in frames], first.height)
    return Lens(columns, rows, focal, float(stretches.max()))


def _windows(frames: Sequence[CaptureFrame], centres: Sequence[float], size: int) -> Windows:
    off = np.abs(np.array(centres) - 0.5 * size)
    if off.max() > 0.5 * (1.0 - _LEAST_KEPT) * size:
        frame = frames[int(np.argmax(off))]
        raise SceneError(
            f"The principal point of {frame.name} is ({frame.intrinsics.centre_x:g}, "
            f"{frame.intrinsics.centre_y:g}), far from the centre of its {frame.intrinsics.width} "
            f"x {frame.intrinsics.height} pixels. Check that cx and cy belong to these images."
        )
    return centred_windows(np.array(centres), size)


def _write_split(
    views: Sequence[View],
    split: str,
    scene: Path,
    lens: Lens,
    sense: Sense,
    step: Callable[[], None],
) -> Converted:
    records, shares = [], []
    for number, view in enumerate(views):
        names = scene_folder.plain(split, number)
        cut = _cut(lens, number)
        _write_image(view.frame, cut, scene / f"{names.image}.png")
        source = view.frame.mask if sense != "none" else None
        if source is not None:
            mask = _read_mask(view.frame, source, sense)[cut]
            if not mask.any():
                raise SceneError(
                    f"The mask {source} marks no object if {sense} is white. Give another "
                    "sense, or leave the frame out."
                )
            (scene / names.mask).parent.mkdir(parents=True, exist_ok=True)
            image_files.write_mask(scene / names.mask, mask)
            shares.append(mask.mean())
        pose = [*view.pose.tolist(), [0.0, 0.0, 0.0, 1.0]]
        record = scene_folder.frame_record(names, pose, masked=source is not None, deep=False)
        records.append(record | {"source": view.frame.name})
        step()
    angle = 2.0 * math.atan(0.5 * lens.columns.size / lens.focal)
    scene_folder.write_transforms(scene, split, {"camera_angle_x": angle, "frames": records})
    first = views[0].frame.intrinsics
    share = float(np.mean(shares)) if shares else None
    return Converted(len(views), (first.width, first.height), lens, share)


def _cut(lens: Lens, number: int) -> tuple[slice, slice]:
    top, left = lens.rows.starts[number], lens.columns.starts[number]
    return slice(top, top + lens.rows.size), slice(left, left + lens.columns.size)


def _write_image(frame: CaptureFrame, cut: tuple[slice, slice], path: Path) -> None:
    """Writes the cropped image; a PNG that is not cropped is copied byte for byte."""
    pixels = image_files.read_rgb(frame.image)
    kept = pixels[cut]
    path.parent.mkdir(parents=True, exist_ok=True)
    if kept.shape == pixels.shape and frame.image.suffix.lower() == ".png":
        shutil.copyfile(frame.image, path)
    else:
        image_files.write_png(path, kept)


def _read_mask(frame: CaptureFrame, mask: Path, sense: Sense) -> Bool[np.ndarray, "h w"]:
    white = nerfstudio.read_capture_mask(mask)
    expected = (frame.intrinsics.height, frame.intrinsics.width)
    if white.shape != expected:
        raise SceneError(
            f"The mask {mask} is {white.shape[1]} x {white.shape[0]} pixels, but its image "
            f"{expected[1]} x {expected[0]}. Resize it without interpolation."
        )
    return white if sense == "object" else ~white


def read_splits(scene: Path) -> dict[str, Frames]:
    """Reads all splits of a scene."""
    names = [
        split
        for split in scene_folder.SPLITS
        if split == "train" or (scene / f"transforms_{split}.json").is_file()
    ]
    return {split: scene_folder.read_frames(scene, split) for split in names}


def write_capture(
    splits: dict[str, Frames], out: Path, sense: Sense, *, step: Callable[[], None]
) -> None:
    """Writes a capture, which appears when it is complete. Images are copied byte for byte.

    Args:
      splits: splits of the scene.
      out: folder of the capture; must not exist.
      sense: meaning of white in the masks: `object` or `background`; `none` drops the masks.
      step: function called after every image.

    Raises:
      SceneError: if the folder exists, or a mask is broken.
    """
    if out.exists():
        raise SceneError(f"{out} exists, and nothing is overwritten. Give a new folder.")
    digits = len(str(max(len(frames.names) for frames in splits.values())))
    images: dict[str, list[str]] = {}
    masks: dict[str, list[str]] = {}
    with atomic_files.new_folder(out) as folder:
        for name in ("images", "masks"):
            (folder / name).mkdir()
        for split, frames in splits.items():
            # Names are unique across folders, as nerfstudio's search for downscaled copies needs.
            files_of = [f"{split}_{i:0{digits}d}.png" for i in range(len(frames.names))]
            images[split] = [f"images/{name}" for name in files_of]
            if frames.masks is not None and sense != "none":
                masks[split] = [f"masks/{name}" for name in files_of]
            for number, name in enumerate(images[split]):
                shutil.copyfile(frames.images[number], folder / name)
                if frames.masks is not None and split in masks:
                    _write_mask(frames.masks[number], folder / masks[split][number], sense)
                step()
        if not masks:
            (folder / "masks").rmdir()
        cameras = {split: frames.cameras for split, frames in splits.items()}
        _check_masks(images, masks)
        nerfstudio.write_capture(folder, cameras, images, masks)


def _write_mask(source: Path, target: Path, sense: Sense) -> None:
    seen = image_files.read_mask(source)
    image_files.write_mask(target, seen if sense == "object" else ~seen)


def _check_masks(images: dict[str, list[str]], masks: dict[str, list[str]]) -> None:
    if masks and set(masks) != set(images):
        lacking = next(split for split in images if split not in masks)
        raise SceneError(
            f"The {lacking} split has no masks, but another has, and nerfstudio requires all or "
            "none. Use sense='none' to leave all masks out, or add the missing ones."
        )
