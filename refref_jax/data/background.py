"""Reads the images of a scene's background (NumPy only).

`scene_properties` reads its geometry and the names of its images. An image is a PNG of 8-bit sRGB,
or an EXR of linear RGB; `render.backgrounds` defines how it is mapped onto the background.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float

from refref_jax.data import SceneError, image_files, scene_properties
from refref_jax.data.scene_properties import Face, SceneProperties
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

_WALLS = 6

# Axes are stored with at least six digits.
_AXES_TOLERANCE = 1e-3


def read_background(scene: Path, *, properties: SceneProperties | None = None) -> Background:
    """Reads the background that the properties of a scene describe, with its images.

    Args:
      scene: folder of the scene.
      properties: properties of the scene; by default those of its `scene.json`.

    Returns:
      The background, as NumPy arrays.

    Raises:
      SceneError: if they do not describe the background, or an image is missing or broken.
    """
    found = scene_properties.read(scene) if properties is None else properties
    path = found.origins.get("background", scene / scene_properties.FILE)
    if found.background.kind is None:
        raise SceneError(
            f"The background is unknown: {path} does not describe it with one of the types "
            f"{', '.join(_READERS)}. Describe it there, or use a scene with a background."
        )
    return _READERS[found.background.kind](found, path)


def _read_cube(found: SceneProperties, path: Path) -> CubeBackground:
    half, faces = np.float32(_extent(found, "half_extent", path)), found.background.faces
    if len(faces) != _WALLS:
        raise SceneError(f"The background in {path} does not have six faces. Describe all six.")
    axes = np.stack([_axes(face, path) for face in faces])
    towards = axes[:, 0] @ axes[:, 0].T
    if np.max(np.abs(np.sort(towards, axis=1) - [-1.0, 0.0, 0.0, 0.0, 0.0, 1.0])) > _AXES_TOLERANCE:
        raise SceneError(
            f"The normals of the faces in {path} do not form a cube. Give six, two along each of "
            "three perpendicular axes."
        )
    axes = axes.astype(np.float32)
    texture = _stack([_read_texture(face.image, path) for face in faces], path)
    normals, across, along = (host_array(axes[:, i]) for i in range(3))
    return CubeBackground(texture, normals, across, along, host_array(half))


def _read_sphere(found: SceneProperties, path: Path) -> SphereBackground:
    radius = np.float32(_extent(found, "radius", path))
    return SphereBackground(_read_texture(found.background.image, path), host_array(radius))


def _read_environment(found: SceneProperties, path: Path) -> Environment:
    return Environment(_read_texture(found.background.image, path))


_READERS: dict[str, Callable[[SceneProperties, Path], Background]] = {
    "cube": _read_cube,
    "sphere": _read_sphere,
    "env": _read_environment,
}


def _extent(found: SceneProperties, key: str, path: Path) -> float:
    if found.background.extent is None:
        raise SceneError(f"The background in {path} lacks the key {key!r}. Add it.")
    return found.background.extent


def _read_texture(image: str | None, described: Path) -> Texture:
    """Reads an image: EXR as linear RGB, other formats as 8-bit sRGB."""
    if image is None:
        raise SceneError(f"The background in {described} lacks the key 'image'. Add it.")
    path = Path(image)
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


def _axes(face: Face, path: Path) -> Float[np.ndarray, "3 3"]:
    """Returns the normal, u axis and v axis of a face as rows: unit vectors, perpendicular."""
    missing = [key for key in ("normal", "u_axis", "v_axis") if getattr(face, key) is None]
    if missing:
        raise SceneError(f"The face {face.name!r} in {path} lacks the key {missing[0]!r}. Add it.")
    axes = np.asarray([face.normal, face.u_axis, face.v_axis], np.float64)
    if not np.max(np.abs(axes @ axes.T - np.eye(3))) < _AXES_TOLERANCE:
        raise SceneError(
            f"The normal, u_axis and v_axis of face {face.name!r} are not perpendicular unit "
            f"vectors in {path}. Correct them."
        )
    return axes
