"""Writes models of COLMAP as text and binary, by its documentation and not by our reader."""

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

NUMBERS = {
    "SIMPLE_PINHOLE": 0,
    "PINHOLE": 1,
    "SIMPLE_RADIAL": 2,
    "RADIAL": 3,
    "OPENCV": 4,
    "OPENCV_FISHEYE": 5,
    "FULL_OPENCV": 6,
    "FOV": 7,
    "SIMPLE_RADIAL_FISHEYE": 8,
    "RADIAL_FISHEYE": 9,
    "THIN_PRISM_FISHEYE": 10,
}


class Camera(NamedTuple):
    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


class Image(NamedTuple):
    pose: np.ndarray  # camera to world, OpenGL, 3 x 4
    camera: int
    name: str


def to_colmap(pose):
    """Quaternion (w, x, y, z) and translation from world to camera, y down."""
    to_camera = (pose[:, :3] * [1.0, -1.0, -1.0]).T
    m = to_camera
    # Bar-Itzhack's symmetric matrix (its lower half), whose largest eigenvector is (x, y, z, w).
    k = np.array(
        [
            [m[0, 0] - m[1, 1] - m[2, 2], 0, 0, 0],
            [m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], 0, 0],
            [m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1], 0],
            [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], np.trace(m)],
        ]
    )
    _, vectors = np.linalg.eigh(k)
    x, y, z, w = vectors[:, -1]
    return (w, x, y, z), -to_camera @ pose[:, 3]


def write_text(folder: Path, cameras, images, points=()):
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["# Camera list with one line of data per camera:"]
    for number, camera in cameras.items():
        numbers = " ".join(repr(float(value)) for value in camera.parameters)
        lines.append(f"{number} {camera.model} {camera.width} {camera.height} {numbers}")
    (folder / "cameras.txt").write_text("\n".join(lines) + "\n")
    lines = ["# Image list with two lines of data per image:"]
    for number, image in enumerate(images, 1):
        rotation, translation = to_colmap(image.pose)
        numbers = " ".join(repr(float(value)) for value in (*rotation, *translation))
        features = "1.5 2.5 -1 3.5 4.5 7" if number % 2 else ""  # without any, the line is empty
        lines += [f"{number} {numbers} {image.camera} {image.name}", features]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    rows = []
    for number, (place, colour) in enumerate(points, 1):
        words = [repr(float(value)) for value in place] + [str(value) for value in colour]
        rows.append(" ".join([str(number), *words, "0.5 1 0 2 3"]))
    (folder / "points3D.txt").write_text("\n".join(["# 3D point list", *rows]) + "\n")
    return folder


def write_binary(folder: Path, cameras, images, points=()):
    folder.mkdir(parents=True, exist_ok=True)
    content = struct.pack("<Q", len(cameras))
    for number, camera in cameras.items():
        model = NUMBERS[camera.model]
        content += struct.pack("<IiQQ", number, model, camera.width, camera.height)
        content += struct.pack(f"<{len(camera.parameters)}d", *camera.parameters)
    (folder / "cameras.bin").write_bytes(content)
    content = struct.pack("<Q", len(images))
    for number, image in enumerate(images, 1):
        rotation, translation = to_colmap(image.pose)
        content += struct.pack("<I7dI", number, *rotation, *translation, image.camera)
        content += image.name.encode() + b"\0"
        features = [(1.5, 2.5, -1), (3.5, 4.5, 7)] if number % 2 else []
        content += struct.pack("<Q", len(features))
        content += b"".join(struct.pack("<ddq", *each) for each in features)
    (folder / "images.bin").write_bytes(content)
    content = struct.pack("<Q", len(points))
    for number, (place, colour) in enumerate(points, 1):
        content += struct.pack("<Q3d3Bd", number, *place, *colour, 0.5)
        content += struct.pack("<Q", 2) + struct.pack("<iiii", 1, 0, 2, 3)
    (folder / "points3D.bin").write_bytes(content)
    return folder
