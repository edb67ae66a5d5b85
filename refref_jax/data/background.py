"""Reads the background of a scene: its geometry and its images (NumPy only).

`scene.json` may describe it; the data set's own scenes have none.

    "background": {"type": "cube", "half_extent": 7.3, "faces": {NAME: {"image": FILE,
                   "normal": [x, y, z], "u_axis": [x, y, z], "v_axis": [x, y, z]}, ...}}
    "background": {"type": "sphere", "radius": 7.3, "image": FILE}
    "background": {"type": "env", "image": FILE}

An image is a PNG of 8-bit sRGB, or an EXR of linear RGB; its name is relative to the scene folder.
`render.backgrounds` defines how it is mapped onto the background.
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from refref_jax.choices import Space
from refref_jax.data import SceneError, image_files, scene_folder, scene_names
from refref_jax.numerics import host_array
from refref_jax.render.backgrounds import (
    Background,
    CubeBackground,
    Environment,
    LinearTexture,
    SphereBackground,
    SrgbTexture,
    Texture,
)

_FILE = "scene.json"
_WALLS = 6

# Axes are stored with at least six digits.
_AXES_TOLERANCE = 1e-3

_SPACES: dict[str, Space] = {"cube": "bounded", "sphere": "spherical", "env": "unbounded"}


def space(scene: Path) -> Space:
    """Returns `unbounded` if the background is an environment map, `spherical` if it is a sphere.

    `scene.json` decides if it describes the background. Otherwise the scene's name does: in the
    data set it starts with `env`, or with `cube` or `sphere` for a bounded background. The name
    does not contain the radius of a sphere, so a cube around it is used (`bounded`).
    """
    kind = _background(scene).get("type")
    if kind is None:
        name = scene_names.of_folder(scene)
        return "unbounded" if name.split("_")[0] == "env" else "bounded"
    if not isinstance(kind, str) or kind not in _SPACES:
        raise SceneError(
            f"The type of the background is {kind!r} in {scene / _FILE}, not one of "
            f"{', '.join(_SPACES)}. Correct it, or remove the file: it is optional."
        )
    return _SPACES[kind]


def is_described(scene: Path) -> bool:
    """Returns whether `scene.json` states the type of the background."""
    return "type" in _background(scene)


def half_extent(scene: Path) -> float | None:
    """Returns half the edge of the background cube, or the radius of the sphere, if known."""
    record = _background(scene)
    key = "radius" if record.get("type") == "sphere" else "half_extent"
    extent = record.get(key)
    return None if extent is None else _positive(extent, key, scene)


def read_background(scene: Path) -> Background:
    """Reads the background that `scene.json` describes, with its images.

    Returns:
      The background, as NumPy arrays.

    Raises:
      SceneError: if the file does not describe the background, or an image is missing or broken.
    """
    record = _background(scene)
    kind = record.get("type")
    if not isinstance(kind, str) or kind not in _READERS:
        raise SceneError(
            f"The background is unknown: its type in {scene / _FILE} is not one of "
            f"{', '.join(_READERS)}. Describe it there, or use a scene with a background."
        )
    return _READERS[kind](record, scene)


def _read_cube(record: dict[str, Any], scene: Path) -> CubeBackground:
    path = scene / _FILE
    half = _positive(scene_folder.get(record, "half_extent", path), "half_extent", scene)
    faces = scene_folder.get(record, "faces", path)
    if not isinstance(faces, dict) or len(faces) != _WALLS:
        raise SceneError(f"The background in {path} does not have six faces. Describe all six.")
    walls = list(faces.values())
    axes = np.stack([_axes(wall, name, path) for name, wall in faces.items()])
    towards = axes[:, 0] @ axes[:, 0].T
    if np.max(np.abs(np.sort(towards, axis=1) - [-1.0, 0.0, 0.0, 0.0, 0.0, 1.0])) > _AXES_TOLERANCE:
        raise SceneError(
            f"The normals of the faces in {path} do not form a cube. Give six, two along each of "
            "three perpendicular axes."
        )
    axes = axes.astype(np.float32)
    texture = _stack([_read_texture(wall, scene) for wall in walls], path)
    normals, across, along = (host_array(axes[:, i]) for i in range(3))
    return CubeBackground(texture, normals, across, along, host_array(np.float32(half)))


def _read_sphere(record: dict[str, Any], scene: Path) -> SphereBackground:
    radius = _positive(scene_folder.get(record, "radius", scene / _FILE), "radius", scene)
    return SphereBackground(_read_texture(record, scene), host_array(np.float32(radius)))


def _read_environment(record: dict[str, Any], scene: Path) -> Environment:
    return Environment(_read_texture(record, scene))


_READERS: dict[str, Callable[[dict[str, Any], Path], Background]] = {
    "cube": _read_cube,
    "sphere": _read_sphere,
    "env": _read_environment,
}


def _read_texture(record: Any, scene: Path) -> Texture:
    """Reads the image of a record: EXR as linear RGB, other formats as 8-bit sRGB."""
    path = scene / scene_folder.get_text(record, "image", scene / _FILE)
    if path.suffix.lower() != ".exr":
        texels = (image_files.read_rgb(path) / 255.0).astype(np.float32)
        return SrgbTexture(host_array(texels))
    texels = image_files.read_exr(path)
    if texels.ndim != 3:
        raise SceneError(f"{path} has one channel, but a background has three. Export R, G and B.")
    if not np.all(np.isfinite(texels)):
        raise SceneError(f"{path} has a colour that is not finite. Export it again.")
    return LinearTexture(host_array(texels))


def _stack(textures: list[Texture], path: Path) -> Texture:
    kinds = {type(texture) for texture in textures}
    if len(kinds) > 1 or len({texture.texels.shape for texture in textures}) > 1:
        raise SceneError(
            f"The images of the faces in {path} differ in size or format. Use images "
            "of one size, all PNG or all EXR."
        )
    return kinds.pop()(host_array(np.stack([texture.texels for texture in textures])))


def _axes(wall: Any, name: str, path: Path) -> Float[np.ndarray, "3 3"]:
    """Returns the normal, u axis and v axis of a face as rows: unit vectors, perpendicular."""
    values = [scene_folder.get(wall, key, path) for key in ("normal", "u_axis", "v_axis")]
    try:
        axes = np.asarray(values, np.float64)
    except (TypeError, ValueError):
        axes = np.empty(0)
    if axes.shape != (3, 3) or not np.max(np.abs(axes @ axes.T - np.eye(3))) < _AXES_TOLERANCE:
        raise SceneError(
            f"The normal, u_axis and v_axis of face {name!r} are not perpendicular unit vectors in "
            f"{path}. Correct them."
        )
    return axes


def _positive(value: Any, name: str, scene: Path) -> float:
    if not isinstance(value, (int, float)) or not 0.0 < value < math.inf:
        raise SceneError(
            f"The {name} of the background is {value!r} in {scene / _FILE}. Give a positive number."
        )
    return float(value)


def _background(scene: Path) -> dict[str, Any]:
    path = scene / _FILE
    background = scene_folder.read_json(path).get("background", {}) if path.is_file() else {}
    if not isinstance(background, dict):
        raise SceneError(
            f"The background is {background!r} in {path}, not an object. Correct it, or remove the "
            "file: it is optional."
        )
    return background
