"""One frame of nerfstudio's `transforms.json`: its files, its pose, and its camera (NumPy only).

Cameras must be pinholes without distortion. What all frames share stands at the top of the file;
else each frame has its own.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import imageio.v3 as iio
import numpy as np
from jaxtyping import Float

from refref_jax.data import transforms
from refref_jax.data.errors import SceneError
from refref_jax.geometry.cameras import focal_length

MODEL = "OPENCV"
"""The camera model that is written, with no distortion."""

_PINHOLES = (MODEL, "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")

DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
"""Coefficients of the models that nerfstudio knows; all must be 0."""

_UNDISTORT = (
    "Only pinholes without distortion can be used: undistort the images first, as `colmap "
    "image_undistorter` does, and convert what it writes (see docs/data_formats.md)."
)


class Intrinsics(NamedTuple):
    """What a pinhole camera makes of the scene, in pixels.

    Attributes:
      focal_x, focal_y: focal lengths along rows and along columns.
      centre_x, centre_y: the principal point, from the image's upper left corner.
      width, height: of the image.
    """

    focal_x: float
    focal_y: float
    centre_x: float
    centre_y: float
    width: int
    height: int


class CaptureFrame(NamedTuple):
    """One image of a capture.

    Attributes:
      name: of the image, as the file has it.
      image: PNG or JPEG.
      mask: of the same size, or `None` where the frame has none.
      pose: camera to world, as the file has it.
      intrinsics: of its camera.
    """

    name: str
    image: Path
    mask: Path | None
    pose: Float[np.ndarray, "3 4"]
    intrinsics: Intrinsics


def read_frame(content: dict[str, Any], record: Any, path: Path) -> CaptureFrame:
    """Reads a frame, and the size of its image, but no pixels.

    Args:
      content: of the whole file.
      record: of the frame.
      path: of the file.

    Raises:
      SceneError: if a file is missing, the pose is not a rigid motion, or the camera is not a
        pinhole without distortion.
    """
    name = transforms.get_text(record, "file_path", path)
    # Instant NGP leaves the ending out.
    image = path.parent / (name if Path(name).suffix else f"{name}.png")
    matrix = transforms.get(record, "transform_matrix", path)
    mask = None
    if "mask_path" in record:
        mask = path.parent / transforms.get_text(record, "mask_path", path)
    _check_model(content, record, name, path)
    for file in (image, mask):
        if file is not None and not file.is_file():
            raise SceneError(
                f"{file} does not exist, but {path} names it. Copy it there, or remove the frame."
            )
    return CaptureFrame(
        name=name,
        image=image,
        mask=mask,
        pose=transforms.rigid_motion(matrix, name, path),
        intrinsics=_intrinsics(content, record, image, path),
    )


def read_number(records: Sequence[dict[str, Any]], name: str, path: Path) -> float | None:
    """Returns a finite number that one of some records has, or `None`.

    Raises:
      SceneError: if it is none, or if two records contradict each other.
    """
    values = [record[name] for record in records if name in record]
    for value in values:
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if not is_number or not math.isfinite(value):
            raise SceneError(f"{name} is {value!r} in {path}. Give a finite number.")
    if len(set(values)) > 1:
        raise SceneError(
            f"{name} is {values[0]} for all frames of {path}, and {values[1]} in one of them. "
            "Remove one of the two."
        )
    return float(values[0]) if values else None


def _check_model(content: dict[str, Any], record: dict[str, Any], name: str, path: Path) -> None:
    both = (content, record)
    for each in both:
        model = each.get("camera_model", MODEL)
        if model not in _PINHOLES or each.get("is_fisheye", False):
            wrong = model if model not in _PINHOLES else "a fisheye"
            raise SceneError(f"The camera of {name} in {path} is {wrong}. {_UNDISTORT}")
    for key in DISTORTION:
        value = read_number(both, key, path)
        if value:
            raise SceneError(
                f"The camera of {name} in {path} has distortion, {key} = {value:g}. {_UNDISTORT}"
            )


def _intrinsics(
    content: dict[str, Any], record: dict[str, Any], image: Path, path: Path
) -> Intrinsics:
    given = {
        key: read_number((content, record), key, path)
        for key in ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x", "camera_angle_y")
    }
    width, height = _image_size(image)
    declared = (given["w"] or width, given["h"] or height)
    if declared != (width, height):
        raise SceneError(
            f"{image} is {width} x {height} pixels, but {path} says {declared[0]:g} x "
            f"{declared[1]:g}. Use the images that the file was made for, or make it again."
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
    if pixels is None and 0.0 < angle < math.pi:
        return focal_length(size, angle)
    wrong = f"angle of view is {angle:g}" if pixels is None else f"focal length is {pixels:g}"
    raise SceneError(
        f"The {wrong} for {image.name} in {path}. Give a positive fl_x and fl_y in pixels, or "
        "angles in radians between 0 and pi."
    )


def _image_size(path: Path) -> tuple[int, int]:
    try:
        height, width = iio.improps(path, plugin="pillow").shape[:2]
    except Exception as error:  # Pillow raises OSError, SyntaxError and its own
        raise SceneError(
            f"{path} can not be read as an image ({error}). Copy or convert it again."
        ) from error
    return width, height
