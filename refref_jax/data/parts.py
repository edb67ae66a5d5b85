"""Makes parts of meshes that belong to no scene folder: files, trimeshes, arrays (NumPy only)."""

import os
from pathlib import Path

import numpy as np
import trimesh

from refref_jax.choices import CLEAR, NO_ABSORPTION, Colour
from refref_jax.data import meshes
from refref_jax.data.errors import SceneError
from refref_jax.data.meshes import MeshPart
from refref_jax.data.part_descriptions import Shading

Arrays = tuple[np.ndarray, np.ndarray]
"""Vertices `[vertices, 3]` in world units; faces `[faces, 3]`, counter-clockwise from outside."""

MeshSource = str | os.PathLike[str] | trimesh.Trimesh | Arrays
"""What a part can be made of."""


def make_part(
    mesh: MeshSource,
    *,
    index: float,
    name: str | None = None,
    shading: Shading = "auto",
    tint: Colour = CLEAR,
    absorption: Colour = NO_ABSORPTION,
    priority: int = 0,
) -> MeshPart:
    """Makes one body of a mesh; `assemble` puts bodies together.

    Args:
      mesh: a file that trimesh reads (of a PLY file stored normals are taken), a `trimesh.Trimesh`,
        or vertices and faces.
      index: index of refraction inside.
      name: for messages; by default the file's stem, or `body`.
      shading: `smooth`, `flat`, or `auto` for smooth up to the crease angle.
      tint: factor of linear RGB light at every reflection and every crossing, 0 to 1.
      absorption: of the medium inside, linear RGB, per world unit.
      priority: where bodies overlap under the rule `priority`, the highest wins.

    Raises:
      SceneError: if the mesh is broken or empty, or a number has no physical meaning.

    Example:
      >>> import trimesh
      >>> import refref_jax
      >>> ball = refref_jax.make_part(trimesh.creation.icosphere(), index=1.5, name="ball")
      >>> ball.name, ball.faces.shape
      ('ball', (1280, 3))
    """
    if isinstance(mesh, str | os.PathLike):
        part = meshes.read_part(Path(mesh), index=index, shading=shading)
        part = part._replace(name=name or part.name)
    else:
        part = _of_arrays(mesh, index, name or "body", shading)
    meshes.check_index(part.name, index)
    if not all(0.0 <= channel <= 1.0 for channel in tint):
        raise SceneError(
            f"The tint of {part.name!r} is {tint}. Give three numbers from 0 to 1, since no "
            "surface adds light."
        )
    if not all(0.0 <= channel < np.inf for channel in absorption):
        raise SceneError(
            f"The absorption of {part.name!r} is {absorption}. Give three numbers that are 0 or "
            "positive, per world unit."
        )
    coloured = tuple(tint) != CLEAR or tuple(absorption) != NO_ABSORPTION
    return part._replace(tint=tint, absorption=absorption, priority=priority, colour_known=coloured)


def _of_arrays(
    mesh: trimesh.Trimesh | Arrays, index: float, name: str, shading: Shading
) -> MeshPart:
    vertices, faces = (mesh.vertices, mesh.faces) if isinstance(mesh, trimesh.Trimesh) else mesh
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces)
    if vertices.shape[1:] != (3,) or faces.shape[1:] != (3,) or faces.dtype.kind not in "iu":
        raise SceneError(
            f"{name} has vertices of shape {vertices.shape} and faces of shape {faces.shape} and "
            f"type {faces.dtype}. Give positions [vertices, 3] and whole numbers [faces, 3]."
        )
    vertices, faces = meshes.merge_corners(name, vertices, faces.astype(np.int64))
    return MeshPart(name, vertices, faces, index, shading)
