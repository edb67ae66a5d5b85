"""Whether a mesh bounds a body, and whether that is still the same one (NumPy only)."""

import math

import numpy as np

from refref_jax.geometry.triangle_meshes import Mesh, is_closed, pieces, volume
from refref_jax.reconstruct.errors import ReconstructionError


def check_body(mesh: Mesh) -> None:
    """Checks that a mesh bounds a body.

    Raises:
      ReconstructionError: if it is empty, open or turned inwards.
    """
    if len(mesh.faces) == 0:
        raise ReconstructionError("The mesh is empty. Check the masks and the level of the grid.")
    if not is_closed(mesh.faces):
        raise ReconstructionError(
            "The mesh is not closed. Cut it from a grid whose border is outside the body."
        )
    if volume(mesh.vertices, mesh.faces) <= 0.0:
        raise ReconstructionError(
            "The mesh is turned inwards. Exchange two corners of every face, or negate the grid."
        )


def objection(before: Mesh, after: Mesh, most: float) -> str:
    """Returns why what was made of a body is no body, or another one; or nothing.

    Args:
      before: a body.
      after: what was made of it.
      most: share of the volume by which the two may differ.
    """
    if len(after.faces) == 0:
        return "nothing would be left"
    if not is_closed(after.faces) or not np.all(np.isfinite(after.vertices)):
        return "the surface would be torn"
    old, new = (volume(mesh.vertices, mesh.faces) for mesh in (before, after))
    if not math.isclose(new, old, rel_tol=most):
        return f"the volume would go from {old:.4g} to {new:.4g}"
    if _count_pieces(after) > _count_pieces(before):
        return "the body would fall apart"
    return ""


def _count_pieces(mesh: Mesh) -> int:
    return len(np.unique(pieces(mesh.faces, len(mesh.vertices))[mesh.faces[:, 0]]))
