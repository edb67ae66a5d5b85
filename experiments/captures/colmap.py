"""Reads the model folder of COLMAP, as text or binary (NumPy only).

    cameras.{txt,bin}     models and parameters of the cameras, which images may share
    images.{txt,bin}      pose, camera and name of each image, and the image points of its features
    points3D.{txt,bin}    points with colours; optional here

Poses are from world to camera, as a quaternion `(w, x, y, z)` and a translation; the camera looks
along +z, y down. Here they are from camera to world, looking along -z, y up. The centre of the
first pixel is at (0.5, 0.5), as here. Numbers of binary files are little-endian.

Source: https://colmap.github.io/format.html; `src/colmap/sensor/models.h` for models.
"""

import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from experiments.captures.capture import (
    Capture,
    CaptureFrame,
    PointCloud,
    missing_photographs,
)
from experiments.captures.lenses import Distortion, Intrinsics, Lens
from refref_jax.data import FARTHEST, SceneError, file_inside, image_files

# COLMAP's models by number, with the names of their parameters.
_MODELS = {
    0: ("SIMPLE_PINHOLE", "f cx cy"),
    1: ("PINHOLE", "fx fy cx cy"),
    2: ("SIMPLE_RADIAL", "f cx cy k1"),
    3: ("RADIAL", "f cx cy k1 k2"),
    4: ("OPENCV", "fx fy cx cy k1 k2 p1 p2"),
    5: ("OPENCV_FISHEYE", "fx fy cx cy k1 k2 k3 k4"),
    6: ("FULL_OPENCV", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    7: ("FOV", "fx fy cx cy omega"),
    8: ("SIMPLE_RADIAL_FISHEYE", "f cx cy k1"),
    9: ("RADIAL_FISHEYE", "f cx cy k1 k2"),
    10: ("THIN_PRISM_FISHEYE", "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1"),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", "fx fy cx cy k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3"),
}
_NUMBERS = {name: number for number, (name, _) in _MODELS.items()}
_REFUSED = ("FOV", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE")

_FLIP = np.array([1.0, -1.0, -1.0])

# Places of the model in a folder, in the order in which they are tried.
_PLACES = (".", "sparse/0", "sparse", "colmap/sparse/0", "0")

# Bytes of an image point, of an entry of a track, and the longest name.
_FEATURE, _TRACK, _LONGEST_NAME = 24, 8, 1024

# Largest deviation of a quaternion's length from 1.
_UNIT = 1e-3


class _Image(NamedTuple):
    rotation: tuple[float, ...]
    translation: tuple[float, ...]
    camera: int
    name: str


def find_model(source: Path) -> Path | None:
    """Returns the folder of the model in a capture, or `None` if there is none."""
    for place in _PLACES:
        if any((source / place / f"cameras.{end}").is_file() for end in ("bin", "txt")):
            return source / place
    return None


def other_models(model: Path) -> list[Path]:
    """Returns the models beside one; COLMAP's mapper numbers those that it could not join."""
    if not model.name.isdecimal():
        return []
    numbered = (each for each in model.parent.iterdir() if each.name.isdecimal())
    return sorted(each for each in numbered if each != model and find_model(each) == each)


def read_capture(model: Path, images: Path) -> Capture:
    """Reads a model, and the size of each of its images, but no pixels.

    Args:
      model: folder of the model; binary files are preferred.
      images: folder of the images.

    Raises:
      SceneError: if a file is missing or broken, or a camera's model is not supported.
    """
    is_binary = (model / "cameras.bin").is_file()
    end = "bin" if is_binary else "txt"
    paths = [model / f"{name}.{end}" for name in ("cameras", "images", "points3D")]
    for path in paths[:2]:
        if not path.is_file():
            raise SceneError(f"{path} does not exist. Copy all files of the COLMAP model.")
    read = (
        (_binary_cameras, _binary_images, _binary_points)
        if is_binary
        else (_text_cameras, _text_images, _text_points)
    )
    lenses = read[0](paths[0])
    records = sorted(read[1](paths[1]), key=lambda image: image.name)
    if not records:
        raise SceneError(f"{paths[1]} has no images. Run COLMAP's mapper again.")
    photographs = {record.name: _photograph(record, images, paths[1]) for record in records}
    missing = missing_photographs(photographs, paths[1])
    frames = tuple(
        _frame(record, lenses, photographs[record.name], paths[1])
        for record in records
        if record.name not in missing
    )
    points = read[2](paths[2]) if paths[2].is_file() else None
    return Capture(frames, None, np.eye(4)[:3], 1.0, False, points, missing)


def lens_of(model: str, size: tuple[int, int], parameters: list[float], path: Path) -> Lens:
    """Returns the lens of a camera.

    Args:
      model: name of COLMAP's model.
      size: width and height in pixels.
      parameters: parameters in COLMAP's order.
      path: file that states them, for messages.

    Raises:
      SceneError: if the model is not supported, or a parameter is impossible.
    """
    if model not in _NUMBERS or model in _REFUSED:
        known = ", ".join(name for name in _NUMBERS if name not in _REFUSED)
        raise SceneError(
            f"{path} has a camera of the model {model}, which is not read. Read are {known}: "
            "undistort with `colmap image_undistorter`, or calibrate again."
        )
    names = _MODELS[_NUMBERS[model]][1].split()
    if len(parameters) != len(names):
        raise SceneError(
            f"{path} has a camera {model} with {len(parameters)} parameters, not the {len(names)} "
            f"of that model ({' '.join(names)}). Export the model again."
        )
    found = dict(zip(names, parameters, strict=True))
    focal = (found.get("fx", found.get("f", 0.0)), found.get("fy", found.get("f", 0.0)))
    finite = all(math.isfinite(value) for value in parameters)
    if not finite or min(focal) <= 0.0 or min(size) < 1:
        shown = ", ".join(f"{name} = {value:g}" for name, value in found.items())
        raise SceneError(
            f"{path} has a camera {model} of {size[0]} x {size[1]} pixels with {shown}. Sizes and "
            "focal lengths are positive, and all numbers finite: export the model again."
        )
    radial = tuple(found.get(f"k{number}", 0.0) for number in range(1, 7))
    tangential = (found.get("p1", 0.0), found.get("p2", 0.0))
    distortion = Distortion(model.endswith("FISHEYE"), radial, tangential)
    return Lens(Intrinsics(*focal, found["cx"], found["cy"], *size), distortion)


def pose_of(rotation: tuple[float, ...], translation: tuple[float, ...]) -> np.ndarray:
    """Returns the camera-to-world matrix, 3 x 4, of COLMAP's quaternion and translation."""
    w, x, y, z = np.array(rotation) / np.linalg.norm(rotation)
    to_camera = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    position = -to_camera.T @ np.array(translation)
    return np.concatenate([to_camera.T * _FLIP, position[:, None]], axis=-1)


def _photograph(record: _Image, images: Path, path: Path) -> Path:
    return file_inside([images], record.name, where="the name of an image", path=path)


def _frame(record: _Image, lenses: dict[int, Lens], image: Path, path: Path) -> CaptureFrame:
    if record.camera not in lenses:
        raise SceneError(
            f"{path}: {record.name} has the camera {record.camera}, which the file of cameras "
            "lacks. Copy all files of one model."
        )
    numbers = np.array([*record.rotation, *record.translation])
    length = float(np.linalg.norm(numbers[:4]))
    if not np.all(np.isfinite(numbers)) or not abs(length - 1.0) <= _UNIT:
        raise SceneError(
            f"{path}: the pose of {record.name} is {numbers.tolist()}, whose first four numbers "
            "are no unit quaternion. Export the model again."
        )
    lens, (height, width) = lenses[record.camera], image_files.read_size(image)
    if (width, height) != lens.intrinsics[4:]:
        raise SceneError(
            f"{image} is {width} x {height} pixels, but its camera in {path.parent} is "
            f"{lens.intrinsics.width} x {lens.intrinsics.height}. Use the images that COLMAP read "
            "(without their turn by EXIF), or those of its undistorter with its model."
        )
    pose = pose_of(record.rotation, record.translation)
    if np.abs(pose[:, 3]).max() > FARTHEST:
        raise SceneError(
            f"{path}: {record.name} is at {pose[:, 3]}. Coordinates are at most {FARTHEST:g}: "
            "scale the model with COLMAP's model_transformer."
        )
    return CaptureFrame(record.name, image, None, pose, *lens)


def _lines(path: Path) -> Iterator[str]:
    try:
        text = path.read_text(encoding="utf-8")
    except ValueError as error:
        raise SceneError(f"{path} is no text ({error}). Copy it again.") from error
    return (line for line in text.splitlines() if not line.startswith("#"))


def _numbers(words: list[str], kind: Any, path: Path, line: str) -> list[Any]:
    try:
        return [kind(word) for word in words]
    except ValueError as error:
        raise SceneError(
            f"{path} has the line {line[:80]!r} ({error}). Export the model again."
        ) from error


def _text_cameras(path: Path) -> dict[int, Lens]:
    found = {}
    for line in _lines(path):
        words = line.split()
        if not words:
            continue
        if len(words) < 4:
            raise SceneError(f"{path} has the line {line[:80]!r}. Export the model again.")
        number, width, height = _numbers([words[0], *words[2:4]], int, path, line)
        parameters = _numbers(words[4:], float, path, line)
        found[number] = lens_of(words[1], (width, height), parameters, path)
    return found


def _text_images(path: Path) -> list[_Image]:
    """Reads two lines for each image; the second, of its features, may be empty."""
    lines, found = _lines(path), []
    for line in lines:
        if not line.strip():
            continue
        words = line.split(maxsplit=9)
        if len(words) < 10:
            raise SceneError(f"{path} has the line {line[:80]!r}. Export the model again.")
        values = _numbers(words[1:8], float, path, line)
        camera = _numbers(words[8:9], int, path, line)[0]
        found.append(_Image(tuple(values[:4]), tuple(values[4:]), camera, words[9].strip()))
        next(lines, "")
    return found


def _text_points(path: Path) -> PointCloud:
    rows = [_numbers(line.split()[1:7], float, path, line) for line in _lines(path) if line.strip()]
    if any(len(row) != 6 for row in rows):
        raise SceneError(f"{path} has points without position or colour. Export the model again.")
    return _cloud(np.array(rows).reshape(-1, 6), path)


class _Bytes:
    """Reads a binary file from its beginning to its end."""

    def __init__(self, path: Path) -> None:
        self._path, self._content, self._place = path, path.read_bytes(), 0

    def take(self, form: str) -> tuple[Any, ...]:
        """Returns the next numbers."""
        return struct.unpack("<" + form, self.skip(struct.calcsize("<" + form)))

    def skip(self, count: int) -> bytes:
        """Returns the next bytes."""
        start, self._place = self._place, self._place + count
        if self._place > len(self._content):
            raise SceneError(
                f"{self._path} ends after {len(self._content)} bytes, in the middle of an entry. "
                "Copy it again."
            )
        return self._content[start : self._place]

    def word(self) -> str:
        """Returns the next name, which a zero byte ends."""
        end = self._content.find(b"\0", self._place, self._place + _LONGEST_NAME)
        if end < 0:
            raise SceneError(f"{self._path} has a name without an end. Copy it again.")
        try:
            return self.skip(end + 1 - self._place)[:-1].decode("utf-8")
        except ValueError as error:
            raise SceneError(f"{self._path} has a name that is no text. Copy it again.") from error


def _binary_cameras(path: Path) -> dict[int, Lens]:
    file, found = _Bytes(path), {}
    for _ in range(file.take("Q")[0]):
        number, model, width, height = file.take("iiQQ")
        if model not in _MODELS:
            lens_of(f"number {model}", (width, height), [], path)
        name, words = _MODELS[model]
        parameters = list(file.take(f"{len(words.split())}d"))
        found[number] = lens_of(name, (width, height), parameters, path)
    return found


def _binary_images(path: Path) -> list[_Image]:
    file, found = _Bytes(path), []
    for _ in range(file.take("Q")[0]):
        values = file.take("i7di")
        found.append(_Image(values[1:5], values[5:8], values[8], file.word()))
        file.skip(_FEATURE * file.take("Q")[0])
    return found


def _binary_points(path: Path) -> PointCloud:
    file, rows = _Bytes(path), []
    for _ in range(file.take("Q")[0]):
        values = file.take("Q3d3Bd")
        rows.append(values[1:7])
        file.skip(_TRACK * file.take("Q")[0])
    return _cloud(np.array(rows, np.float64).reshape(-1, 6), path)


def _cloud(rows: Float[np.ndarray, "points 6"], path: Path) -> PointCloud:
    if not np.all(np.isfinite(rows)):
        raise SceneError(f"{path} has points that are not finite. Export the model again.")
    return PointCloud(rows[:, :3], np.clip(rows[:, 3:], 0, 255).astype(np.uint8))
