"""Makes an object of the data set from the user's own meshes (NumPy only)."""

import hashlib
import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh

from experiments.dataset.parts import RADIUS, Category, Object, ObjectPart
from refref_jax.data import meshes
from refref_jax.geometry.triangle_meshes import is_watertight, volume

# Largest distance of a vertex from the origin after scaling, as a share of `RADIUS`.
_FILLED = 0.9

# Largest angle in radians between neighbouring faces of a smooth part.
_CREASE = math.radians(30.0)

# Largest share by which a convex mesh and its convex hull may differ in volume.
_CONVEX = 1e-3

# Smallest volume of a mesh, as a share of that of its bounding box.
_FLAT = 1e-6


def read_object(paths: Sequence[Path], materials: Sequence[str]) -> Object:
    """Reads meshes as the parts of one object, centred and scaled to fit between the cameras.

    All parts are moved and scaled together, so that their bounding box is around the origin and
    the farthest vertex at 0.9 of the largest radius of an object. A part is shaded with vertex
    normals if no edge is sharper than 30 degrees.

    Args:
      paths: mesh files that trimesh reads, such as PLY, OBJ, STL and GLB; their units and place
        are arbitrary, with z up.
      materials: material of each mesh, or one for all.

    Raises:
      ValueError: if a file is not a closed mesh, a material is unknown, or their numbers differ.
    """
    if len(materials) not in (1, len(paths)):
        raise ValueError(
            f"There are {len(materials)} materials for {len(paths)} meshes. Give one for each "
            "mesh, in their order, or one for all."
        )
    if unknown := [each for each in materials if each not in meshes.INDEX_OF_REFRACTION]:
        known = ", ".join(meshes.INDEX_OF_REFRACTION)
        raise ValueError(f"There is no material {unknown[0]!r}. Choose from {known}.")
    read = [_read(path) for path in paths]
    corners = np.concatenate([vertices for vertices, _ in read])
    centre = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    scale = _FILLED * RADIUS / np.linalg.norm(corners - centre, axis=-1).max()
    named = [materials[number % len(materials)] for number in range(len(paths))]
    parts = [
        ObjectPart(
            f"part{number}", material, scale * (vertices - centre), faces, _smooth(vertices, faces)
        )
        for number, ((vertices, faces), material) in enumerate(zip(read, named, strict=True))
    ]
    return Object(_name_of(paths[0]), _category(parts), lambda detail: parts)


def digest(paths: Sequence[Path], materials: Sequence[str]) -> str:
    """Returns the SHA-256 of mesh files and their materials."""
    whole = hashlib.sha256(",".join(materials).encode())
    for path in paths:
        whole.update(path.read_bytes())
    return whole.hexdigest()


def _read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Returns the vertices and the faces of a closed mesh that is oriented outwards."""
    try:
        mesh = trimesh.load(path, force="mesh", process=False)
        vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    except Exception as error:  # trimesh raises whatever its readers do
        raise ValueError(f"{path} is not a mesh ({error}). Give a PLY, OBJ, STL or GLB.") from error
    if not len(faces) or not np.all(np.isfinite(vertices)):
        raise ValueError(f"{path} has no triangles, or a vertex that is not finite.")
    vertices, faces = meshes.merge_corners(path.name, vertices, faces)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.update_faces(mesh.nondegenerate_faces())
    mesh.remove_unreferenced_vertices()
    if not is_watertight(mesh.faces):
        raise ValueError(
            f"{path} is not closed: light would enter it and never leave. Fill its holes, or give "
            "a thin object two sides."
        )
    trimesh.repair.fix_normals(mesh, multibody=False)
    if volume(mesh.vertices, mesh.faces) <= _FLAT * np.prod(np.ptp(mesh.vertices, axis=0)):
        raise ValueError(f"{path} encloses no volume. Give a thin object some thickness.")
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def _name_of(path: Path) -> str:
    """Returns a name that scenes can have: lower case letters, digits and underscores."""
    name = re.sub(r"\W+", "_", path.stem.lower(), flags=re.ASCII).strip("_")
    if not name:
        raise ValueError(f"{path} has no letter or digit in its name. Rename the file.")
    return name


def _category(parts: Sequence[ObjectPart]) -> Category:
    if len(parts) > 1:
        return "mmncvx"
    mesh = trimesh.Trimesh(parts[0].vertices, parts[0].faces, process=False)
    hull = mesh.convex_hull.volume
    return "smcvx" if abs(hull - mesh.volume) <= _CONVEX * hull else "smncvx"


def _smooth(vertices: np.ndarray, faces: np.ndarray) -> bool:
    angles = trimesh.Trimesh(vertices, faces, process=False).face_adjacency_angles
    return bool(angles.size) and float(angles.max()) <= _CREASE
