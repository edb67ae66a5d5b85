"""Mesh files that keep the shading normals they were written with (NumPy only).

A reconstructed surface knows its normals better than its triangles do: from the gradient of a
field, or averaged within patches of its own. PLY keeps one normal a vertex, so a vertex is written
once for each normal that faces have there; the reader of meshes merges equal positions again.
Numbers are in double precision, and come back as they were.

Only a file with the very header that is written here is trusted: normals of other programs may be
anything, and what such a program writes again has another header.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

_HEADER = """ply
format binary_little_endian 1.0
comment shading normals of refref_jax
element vertex {}
property double x
property double y
property double z
property double nx
property double ny
property double nz
element face {}
property list uchar int vertex_indices
end_header
"""

_VERTEX = np.dtype([("position", "<f8", 3), ("normal", "<f8", 3)])
_FACE = np.dtype([("corners", "u1"), ("vertices", "<i4", 3)])

_LONGEST_HEADER = len(_HEADER) + 40


def write_mesh(
    path: Path,
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    normals: Float[np.ndarray, "faces 3 3"],
) -> None:
    """Writes a mesh as PLY.

    Args:
      path: of the file.
      vertices: world units.
      faces: counter-clockwise seen from outside.
      normals: outward unit shading normals at the corners of the faces.
    """
    corners = np.concatenate([vertices[faces], normals], axis=-1).reshape(-1, 6)
    split, index = np.unique(corners, axis=0, return_inverse=True)
    points = np.zeros(len(split), _VERTEX)
    points["position"], points["normal"] = split[:, :3], split[:, 3:]
    triangles = np.zeros(len(faces), _FACE)
    triangles["corners"], triangles["vertices"] = 3, index.reshape(-1, 3)
    header = _HEADER.format(len(points), len(triangles)).encode()
    path.write_bytes(header + points.tobytes() + triangles.tobytes())


def read_normals(path: Path) -> Float[np.ndarray, "faces 3 3"] | None:
    """Returns the normals at the corners of a file's faces, or `None` if it keeps none of ours."""
    content = path.read_bytes()
    end = content.find(b"end_header\n", 0, _LONGEST_HEADER) + len(b"end_header\n")
    words = content[:end].decode("ascii", "replace").split()
    counts = [int(word) for word in words if word.isdecimal()]
    if len(counts) != 2 or content[:end] != _HEADER.format(*counts).encode():
        return None
    middle = end + counts[0] * _VERTEX.itemsize
    if len(content) != middle + counts[1] * _FACE.itemsize:
        return None
    points = np.frombuffer(content[end:middle], _VERTEX)
    triangles = np.frombuffer(content[middle:], _FACE)
    return points["normal"][triangles["vertices"]]
