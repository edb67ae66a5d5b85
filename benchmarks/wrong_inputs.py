"""Inputs that are wrong by a known amount: indices, shapes, places, cameras and backgrounds.

Errors of shape are smooth: sixteen waves in random directions, a quarter of the object's diagonal
long.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from experiments.r3f.alignment import rotation
from refref_jax.data import scene_folder
from refref_jax.data.meshes import MeshPart
from refref_jax.data.scene_assembly import shaded_mesh
from refref_jax.data.scene_properties import SceneProperties

_WAVES, _WAVELENGTH = 16, 0.25


class Inputs(NamedTuple):
    """What a rendering needs: everything that may be wrong."""

    parts: tuple[MeshPart, ...]
    frames: scene_folder.Frames
    properties: SceneProperties


class Error(NamedTuple):
    """An input that may be wrong.

    Attributes:
      unit: unit of its error.
      amounts: errors, in ascending order; the first is small.
      perturb: function of the inputs, an error and a random generator to wrong inputs.
    """

    unit: str
    amounts: tuple[float, ...]
    perturb: Callable[[Inputs, float, np.random.Generator], Inputs]


def _of_index(inputs: Inputs, amount: float, draw: np.random.Generator) -> Inputs:
    """Adds to the index of all parts that are not empty."""
    del draw
    parts = tuple(
        part._replace(index=part.index + amount) if part.index > 1.0 else part
        for part in inputs.parts
    )
    return inputs._replace(parts=parts)


def _of_vertices(inputs: Inputs, amount: float, draw: np.random.Generator) -> Inputs:
    """Moves vertices along their normals, by percents of the diagonal (root mean square)."""
    centre, diagonal = _extent(inputs.parts)
    wave = _waves(centre, diagonal, draw)
    parts = []
    for part in inputs.parts:
        normals = np.zeros_like(part.vertices)
        np.add.at(normals, part.faces, shaded_mesh(part).normals)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        height = 0.01 * amount * diagonal * wave(part.vertices)[:, :1]
        parts.append(part._replace(vertices=part.vertices + height * normals))
    return inputs._replace(parts=tuple(parts))


def _of_normals(inputs: Inputs, amount: float, draw: np.random.Generator) -> Inputs:
    """Tilts shading normals, by degrees (root mean square); vertices stay."""
    wave = _waves(*_extent(inputs.parts), draw)
    parts = []
    for part in inputs.parts:
        normals = shaded_mesh(part).normals
        tilt = wave(part.vertices)[part.faces]
        tilt -= np.sum(tilt * normals, axis=-1, keepdims=True) * normals
        # Two of three components of unit variance are left.
        tilted = normals + math.tan(math.radians(amount)) / math.sqrt(2.0) * tilt
        tilted /= np.maximum(np.linalg.norm(tilted, axis=-1, keepdims=True), 1e-12)
        parts.append(part._replace(normals=tilted))
    return inputs._replace(parts=tuple(parts))


def _of_scale(inputs: Inputs, amount: float, draw: np.random.Generator) -> Inputs:
    """Enlarges the object about its centre, by percents."""
    del draw
    return _moved(inputs, (1.0 + 0.01 * amount) * np.eye(3), np.zeros(3))


def _of_rotation(inputs: Inputs, amount: float, draw: np.random.Generator) -> Inputs:
    """Turns the object about its centre, by degrees."""
    return _moved(inputs, _turn(amount, draw), np.zeros(3))


def _of_place(inputs: Inputs, amount: float, draw: np.random.Generator) -> Inputs:
    """Moves the object, by percents of its diagonal."""
    diagonal = _extent(inputs.parts)[1]
    return _moved(inputs, np.eye(3), 0.01 * amount * diagonal * _direction(draw))


def _of_aim(inputs: Inputs, amount: float, draw: np.random.Generator) -> Inputs:
    """Turns each camera about its centre, by degrees."""
    poses = inputs.frames.cameras.poses.copy()
    for pose in poses:
        pose[:, :3] = pose[:, :3] @ _turn(amount, draw)
    return _with_poses(inputs, poses)


def _of_position(inputs: Inputs, amount: float, draw: np.random.Generator) -> Inputs:
    """Moves each camera, by percents of its distance from the object."""
    poses, centre = inputs.frames.cameras.poses.copy(), _extent(inputs.parts)[0]
    for pose in poses:
        pose[:, 3] += 0.01 * amount * np.linalg.norm(pose[:, 3] - centre) * _direction(draw)
    return _with_poses(inputs, poses)


def _of_background(inputs: Inputs, amount: float, draw: np.random.Generator) -> Inputs:
    """Enlarges the background, by percents; an environment has no size."""
    del draw
    background, known = inputs.properties.background, inputs.properties.background.extent
    if known is None:
        return inputs
    background = dataclasses.replace(background, extent=(1.0 + 0.01 * amount) * known)
    return inputs._replace(properties=dataclasses.replace(inputs.properties, background=background))


def _of_mask(inputs: Inputs, amount: float, draw: np.random.Generator) -> Inputs:
    """Leaves everything as it is: `_psnr` widens the mask."""
    del amount, draw
    return inputs


ERRORS = {
    "index": Error("", (0.001, 0.003, 0.01, 0.03, 0.1), _of_index),
    "vertices": Error("% of the diagonal", (0.01, 0.03, 0.1, 0.3, 1.0), _of_vertices),
    "normals": Error("degrees", (0.1, 0.3, 1.0, 3.0, 10.0), _of_normals),
    "size of the object": Error("%", (0.1, 0.3, 1.0, 3.0, 10.0), _of_scale),
    "rotation of the object": Error("degrees", (0.1, 0.3, 1.0, 3.0, 10.0), _of_rotation),
    "place of the object": Error("% of the diagonal", (0.1, 0.3, 1.0, 3.0, 10.0), _of_place),
    "rotation of the cameras": Error("degrees", (0.03, 0.1, 0.3, 1.0, 3.0), _of_aim),
    "place of the cameras": Error("% of the distance", (0.03, 0.1, 0.3, 1.0, 3.0), _of_position),
    "size of the background": Error("%", (0.1, 0.3, 1.0, 3.0, 10.0), _of_background),
    "mask": Error("pixels", (1.0, 2.0, 4.0), _of_mask),
}
"""Inputs that may be wrong, by name."""


def _extent(parts: Sequence[MeshPart]) -> tuple[Float[np.ndarray, "3"], float]:
    """Returns the centre and the diagonal of the box around all parts."""
    vertices = np.concatenate([part.vertices for part in parts])
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return 0.5 * (low + high), float(np.linalg.norm(high - low))


def _waves(
    centre: Float[np.ndarray, "3"], diagonal: float, draw: np.random.Generator
) -> Callable[[np.ndarray], np.ndarray]:
    """Returns a function from points to three smooth random values of unit variance."""
    towards = draw.normal(size=(_WAVES, 3))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    phases, heights = draw.uniform(0.0, 2.0 * np.pi, _WAVES), draw.normal(size=(_WAVES, 3))
    heights *= np.sqrt(2.0 / np.sum(np.square(heights), axis=0))
    number = 2.0 * np.pi / (_WAVELENGTH * diagonal) * towards

    def wave(points: np.ndarray) -> np.ndarray:
        return np.sin((points - centre) @ number.T + phases) @ heights

    return wave


def _moved(
    inputs: Inputs, linear: Float[np.ndarray, "3 3"], shift: Float[np.ndarray, "3"]
) -> Inputs:
    """Maps the object about its centre; given shading normals are computed again."""
    centre = _extent(inputs.parts)[0]
    parts = tuple(
        part._replace(vertices=(part.vertices - centre) @ linear.T + centre + shift, normals=None)
        for part in inputs.parts
    )
    return inputs._replace(parts=parts)


def _with_poses(inputs: Inputs, poses: Float[np.ndarray, "views 3 4"]) -> Inputs:
    cameras = inputs.frames.cameras._replace(poses=poses)
    return inputs._replace(frames=inputs.frames._replace(cameras=cameras))


def _direction(draw: np.random.Generator) -> Float[np.ndarray, "3"]:
    towards = draw.normal(size=3)
    return towards / np.linalg.norm(towards)


def _turn(degrees: float, draw: np.random.Generator) -> Float[np.ndarray, "3 3"]:
    """Returns a rotation about a random axis."""
    return rotation(math.radians(degrees) * _direction(draw))[0]
