"""Packs meshes into `Surfaces`, on the host (NumPy only)."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from refref_jax.geometry import bvh_build
from refref_jax.geometry.surfaces import Surfaces
from refref_jax.geometry.triangle_meshes import Mesh


def pack_meshes(meshes: Sequence[Mesh]) -> Surfaces:
    """Builds the device record of meshes; parts have the numbers of their places, none is empty."""
    return build_surfaces(
        np.concatenate([np.zeros((0, 3, 3)), *(mesh.vertices[mesh.faces] for mesh in meshes)]),
        np.concatenate([np.zeros((0, 3, 3)), *(mesh.normals for mesh in meshes)]),
        np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes]),
    )


def build_surfaces(
    triangles: Float[np.ndarray, "faces 3 3"],
    normals: Float[np.ndarray, "faces 3 3"],
    parts: Int[np.ndarray, " faces"],
) -> Surfaces:
    """Builds the `Surfaces` of a triangle soup, in single precision.

    Args:
      triangles: corners, counter-clockwise seen from outside, world units. May be empty.
      normals: outward unit shading normals at the corners.
      parts: part index of each triangle.

    Returns:
      The surfaces, in the leaf order of their tree.
    """
    bvh, slots = bvh_build.build(triangles.astype(np.float32))
    if len(triangles) == 0:
        return Surfaces(bvh, np.zeros_like(bvh.triangles), slots)
    return Surfaces(bvh, normals[slots].astype(np.float32), parts[slots].astype(np.int32))
