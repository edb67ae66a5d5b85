"""A capture of any program: photographs with lenses, poses and masks, before it becomes a scene."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Bool, Float, UInt8

from experiments.captures.lenses import Distortion, Intrinsics, Lens
from refref_jax.data import SceneError, image_files

# Minimum grey level of white: JPEG adds grey pixels at every edge.
_WHITE = 128


class CaptureFrame(NamedTuple):
    """One image of a capture.

    Attributes:
      name: name of the image in the file.
      image: path of the image.
      mask: path of a mask of the same size, or `None` if the frame has none.
      pose: camera-to-world matrix in the file.
      intrinsics: intrinsics of the camera.
      distortion: distortion of its lens.
    """

    name: str
    image: Path
    mask: Path | None
    pose: Float[np.ndarray, "3 4"]
    intrinsics: Intrinsics
    distortion: Distortion = Distortion()

    @property
    def lens(self) -> Lens:
        """Intrinsics and distortion together."""
        return Lens(self.intrinsics, self.distortion)


class PointCloud(NamedTuple):
    """Points that the program found.

    Attributes:
      positions: positions in the world of the file.
      colours: sRGB.
    """

    positions: Float[np.ndarray, "points 3"]
    colours: UInt8[np.ndarray, "points 3"]


class Capture(NamedTuple):
    """Content of a capture, as far as it is used here.

    Attributes:
      frames: frames, ordered by name.
      splits: numbers of the frames of `train`, `val` and `test`, or `None` if the file lists none.
      applied: rotation and translation that were applied to the original poses.
      applied_scale: scale that was applied after that.
      has_depth: whether frames name depth maps, which are not read.
      points: points of the capture, or `None` without any.
      missing: names of photographs that the capture lists, but that do not exist.
    """

    frames: tuple[CaptureFrame, ...]
    splits: dict[str, tuple[int, ...]] | None
    applied: Float[np.ndarray, "3 4"]
    applied_scale: float
    has_depth: bool
    points: PointCloud | None = None
    missing: tuple[str, ...] = ()


def missing_photographs(photographs: Mapping[str, Path], path: Path) -> tuple[str, ...]:
    """Returns the names of photographs that do not exist, as of blurred ones that were removed.

    Args:
      photographs: file of each name.
      path: file that names them, for messages.

    Raises:
      SceneError: if half of them are missing, as in a wrong folder.
    """
    missing = tuple(name for name, file in photographs.items() if not file.is_file())
    if 2 * len(missing) >= max(1, len(photographs)):
        raise SceneError(
            f"{photographs[missing[0]]} does not exist, but {path} names it, and "
            f"{len(missing)} of its {len(photographs)} photographs are missing. Copy them there; "
            "for a model of COLMAP, give their folder (--images of import_capture)."
        )
    return missing


def every_nth(frames: int, *, every: int) -> dict[str, tuple[int, ...]]:
    """Returns splits for a capture that lists none: every n-th frame, from the first, is test.

    nerfstudio's evaluation mode `interval` does the same.

    Args:
      frames: number of frames.
      every: value of n, at least 2.

    Raises:
      SceneError: if no frame is left to train on.
    """
    train = tuple(number for number in range(frames) if number % every)
    if not train:
        raise SceneError(
            f"There is {frames} frame, and the first of every {every} is for testing, so none is "
            "left for training. Capture more images."
        )
    return {"train": train, "test": tuple(range(0, frames, every))}


def masked_frames(capture: Capture) -> tuple[Capture, tuple[str, ...]]:
    """Returns a capture of the frames that have a mask, and the names of the others.

    Where the object is in an image without a mask is unknown, so that neither its background nor
    its object can be learned from it. A capture without any mask stays as it is.

    Raises:
      SceneError: if other frames have a mask, but none of the listed training frames.
    """
    kept = [number for number, frame in enumerate(capture.frames) if frame.mask is not None]
    if not kept or len(kept) == len(capture.frames):
        return capture, ()
    lacking = tuple(frame.name for frame in capture.frames if frame.mask is None)
    places, splits = {number: place for place, number in enumerate(kept)}, capture.splits
    if splits is not None:
        splits = {
            split: tuple(places[number] for number in numbers if number in places)
            for split, numbers in splits.items()
        }
        splits = {split: numbers for split, numbers in splits.items() if numbers}
        if "train" not in splits:
            raise SceneError(
                f"No training image has a mask, but others have, not {lacking[0]}. Add masks, or "
                "drop them: --masks=none."
            )
    frames = tuple(capture.frames[number] for number in kept)
    return capture._replace(frames=frames, splits=splits), lacking


def with_masks(capture: Capture, folder: Path) -> Capture:
    """Returns a capture with the masks of a folder; some frames may have none.

    The mask of `photo.jpg` is `photo.jpg.png`, as in COLMAP, or `photo.png`, in the same subfolder.

    Raises:
      SceneError: if no frame has one, or one has another size than its image.
    """
    found = []
    for frame in capture.frames:
        name = Path(frame.name)
        # nerfstudio's names begin with the folder of the images: images, images_2, ...
        inner = name.parts[0].startswith("images") and len(name.parts) > 1
        tries = [folder / name, *([folder / Path(*name.parts[1:])] if inner else [])]
        files = [each.with_name(each.name + ".png") for each in tries]
        files += [each.with_suffix(".png") for each in tries]
        mask = next((file for file in files if file.is_file()), None)
        found.append(frame._replace(mask=mask))
    if all(frame.mask is None for frame in found):
        raise SceneError(
            f"{folder} has no mask of {found[0].name}, nor of any other image. Name the masks like "
            "the images, with the ending .png."
        )
    check_sizes(found)
    return capture._replace(frames=tuple(found))


def check_sizes(frames: Sequence[CaptureFrame]) -> None:
    """Checks the sizes of masks by their headers.

    Raises:
      SceneError: if a mask is broken, or has another size than its image.
    """
    for frame in frames:
        if frame.mask is None:
            continue
        height, width = image_files.read_size(frame.mask)
        if (width, height) != frame.intrinsics[4:]:
            raise SceneError(
                f"The mask {frame.mask} is {width} x {height} pixels, but its image "
                f"{frame.intrinsics.width} x {frame.intrinsics.height}. Resize it without "
                "interpolation."
            )


def read_mask(path: Path, *, white: str) -> Bool[np.ndarray, "h w"]:
    """Returns the pixels of the object; JPEG masks are thresholded at mid-grey.

    Args:
      path: path of the mask.
      white: meaning of white, `object` or `background`.
    """
    if path.suffix.lower() in (".jpg", ".jpeg"):
        marked = image_files.read_rgb(path).max(axis=-1) >= _WHITE
    else:
        marked = image_files.read_mask(path)
    return marked if white == "object" else ~marked


def read_points(path: Path) -> PointCloud:
    """Reads the points of a PLY; they are grey if they have no colours.

    Raises:
      SceneError: if it cannot be read.
    """
    try:
        cloud = trimesh.load(path, process=False)
        positions = np.asarray(cloud.vertices, np.float64)
        colours = np.asarray(getattr(cloud, "colors", np.empty((0, 4))), np.uint8)
    except Exception as error:  # trimesh raises whatever its readers do
        raise SceneError(
            f"{path} cannot be read as a PLY of points ({error}). Copy it again, or remove "
            "ply_file_path."
        ) from error
    if not np.all(np.isfinite(positions)):
        raise SceneError(f"{path} has a point that is not finite. Remove it, or ply_file_path.")
    if colours.shape[:1] != positions.shape[:1]:
        colours = np.full((len(positions), 3), 128, np.uint8)
    return PointCloud(positions, colours[:, :3])


def write_points(path: Path, points: PointCloud) -> None:
    """Writes points as PLY."""
    trimesh.PointCloud(points.positions, colors=points.colours).export(path)
