"""Writes the background of a scene, and describes it for `refref_jax.data.scene_properties`.

A *kind* is `cube` (six different of the 24 faces), `sphere` (one of the 13) or `env` (one of the
environments). An equirectangular image has +x in its middle column and -x at its seam: a unit
direction lies at `u = 0.5 - atan2(y, x) / (2 pi)`, `v = 0.5 + asin(z) / pi`, `v` from the bottom.
A wall's point lies at `half_extent (normal + (2u - 1) u_axis + (2v - 1) v_axis)`.
"""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, UInt8

from experiments.dataset.landscapes import ENVIRONMENTS, make_environment
from experiments.dataset.textures.faces import FACES, make_face
from experiments.dataset.textures.spheres import SPHERES, make_sphere
from refref_jax import atomic_files
from refref_jax.data import image_files

Kind = Literal["cube", "sphere", "env"]

KINDS: tuple[Kind, ...] = ("cube", "sphere", "env")

HALF_EXTENT = 7.3
"""Half the edge of the cube, and radius of the sphere, world units."""

FOLDER = "background"

# Names of the cube's faces, with normal, u axis and v axis.
_WALLS: dict[str, tuple[tuple[float, ...], ...]] = {
    "+x": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "-x": ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0)),
    "+y": ((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "-y": ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "+z": ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    "-z": ((0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (0.0, -1.0, 0.0)),
}

_WALL_MAPPING = (
    "point = half_extent*(normal + (2u-1)*u_axis + (2v-1)*v_axis); v = 0 is the image's bottom "
    "row; texels are sRGB"
)
_AROUND = (
    "u = 0.5 - atan2(y, x)/(2 pi) mod 1, v = 0.5 + asin(z)/pi for a unit direction {where}; v = 0 "
    "is the image's bottom row; bilinear; {texels}"
)
_SPHERE_MAPPING = _AROUND.format(where="from the origin to the wall", texels="texels are sRGB")
_ENVIRONMENT_MAPPING = _AROUND.format(where="", texels="linear RGB, infinitely distant").replace(
    " ;", ";"
)


def write_background(scene: Path, kind: Kind, *, seed: int, size: int) -> dict[str, Any]:
    """Writes the images of a background into `scene/background/`.

    Files are written atomically. The images of a name and size are deterministic, and are computed
    once per process.

    Args:
      scene: folder of the scene; created if needed.
      kind: kind of background.
      seed: non-negative integer that selects the images.
      size: rows of each image, 16 or more.

    Returns:
      The record `background` of `scene.json`; its `texture` is the name of the image.

    Raises:
      ValueError: if the kind does not exist, or the size is below 16.
    """
    if kind not in KINDS:
        raise ValueError(f"There is no background {kind!r}. Choose from {', '.join(KINDS)}.")
    rng = np.random.default_rng(seed)
    (scene / FOLDER).mkdir(parents=True, exist_ok=True)
    return {"cube": _write_cube, "sphere": _write_sphere, "env": _write_environment}[kind](
        scene, rng, size
    )


def _write_cube(scene: Path, rng: np.random.Generator, size: int) -> dict[str, Any]:
    names = rng.choice(list(FACES), len(_WALLS), replace=False).tolist()
    faces = {}
    for (wall, (normal, u_axis, v_axis)), name in zip(_WALLS.items(), names, strict=True):
        image = f"{FOLDER}/face_{wall}.png"
        _replace(scene / image, image_files.write_rgb, _face(name, size) / 255.0)
        faces[wall] = {
            "image": image,
            "normal": list(normal),
            "u_axis": list(u_axis),
            "v_axis": list(v_axis),
            "texture": name,
        }
    return {"type": "cube", "half_extent": HALF_EXTENT, "faces": faces, "mapping": _WALL_MAPPING}


def _write_sphere(scene: Path, rng: np.random.Generator, size: int) -> dict[str, Any]:
    name, image = str(rng.choice(list(SPHERES))), f"{FOLDER}/sphere.png"
    _replace(scene / image, image_files.write_rgb, _sphere(name, size) / 255.0)
    record = {"type": "sphere", "radius": HALF_EXTENT, "image": image, "texture": name}
    return record | {"mapping": _SPHERE_MAPPING}


def _write_environment(scene: Path, rng: np.random.Generator, size: int) -> dict[str, Any]:
    name, image = str(rng.choice(list(ENVIRONMENTS))), f"{FOLDER}/env.exr"
    _replace(scene / image, image_files.write_exr, _environment(name, size))
    return {"type": "env", "image": image, "texture": name, "mapping": _ENVIRONMENT_MAPPING}


def _replace(
    path: Path, write: Callable[[Path, np.ndarray], None], pixels: Float[np.ndarray, "h w 3"]
) -> None:
    """Writes a file under a temporary name, and renames it when it is complete."""
    with atomic_files.written_file(path) as draft:
        write(draft, pixels)


# 8-bit images, since a worker keeps those of all its scenes.
@functools.cache
def _face(name: str, size: int) -> UInt8[np.ndarray, "size size 3"]:
    return image_files.to_bytes(make_face(name, size))


@functools.cache
def _sphere(name: str, height: int) -> UInt8[np.ndarray, "height width 3"]:
    return image_files.to_bytes(make_sphere(name, height))


@functools.cache
def _environment(name: str, height: int) -> Float[np.ndarray, "height width 3"]:
    return make_environment(name, height)
