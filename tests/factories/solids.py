"""Small solids that the tests of `data` examine."""

from collections.abc import Sequence

import numpy as np
import trimesh

from refref_jax.data.meshes import MeshPart


def as_part(mesh: trimesh.Trimesh, name: str, *, index: float = 1.5) -> MeshPart:
    """Makes a part of a mesh."""
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    return MeshPart(name, vertices, faces, index, "auto")


def ball(
    name: str = "ball_glass",
    *,
    radius: float = 1.0,
    centre: Sequence[float] = (0.0, 0.0, 0.0),
    index: float = 1.5,
) -> MeshPart:
    """A ball of 320 triangles."""
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    return as_part(mesh.apply_translation(centre), name, index=index)


def box(
    name: str = "box_glass",
    *,
    size: Sequence[float] = (1.0, 1.0, 1.0),
    centre: Sequence[float] = (0.0, 0.0, 0.0),
    index: float = 1.5,
) -> MeshPart:
    """A box of 12 triangles along the axes."""
    mesh = trimesh.creation.box(size)
    return as_part(mesh.apply_translation(centre), name, index=index)


def inverted(part: MeshPart) -> MeshPart:
    """The same surface with its faces turned inwards."""
    return part._replace(faces=part.faces[:, ::-1])


def joined(name: str, *parts: MeshPart) -> MeshPart:
    """One part made of the surfaces of several."""
    starts = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)])
    vertices = np.concatenate([part.vertices for part in parts])
    return MeshPart(name, vertices, faces, parts[0].index, parts[0].shading)


def shell(name: str = "jar_glass", *, outer: float = 2.0, inner: float = 1.5) -> MeshPart:
    """A hollow ball: its cavity is outside of it."""
    return joined(name, ball(radius=outer), inverted(ball(radius=inner)))
