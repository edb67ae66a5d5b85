"""Surfaces of a scene: packed on the host (NumPy), evaluated at ray hits on the device.

A surface point has a position, two normals and the part of the scene that it belongs to. The
*geometric* normal is that of the triangle and determines the side that a ray is on. The *shading*
normal is interpolated between the corners and determines the directions of the reflected and
refracted rays; on a flat part both normals agree. Both point out of the object.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from refref_jax import numerics
from refref_jax.geometry import bvh_build
from refref_jax.geometry.bvh import BVH
from refref_jax.geometry.rays import geometric_normal, interpolate
from refref_jax.geometry.triangle_meshes import Mesh


class Surfaces(NamedTuple):
    """All surfaces of a scene, indexed by the primitives of their BVH.

    Attributes:
      bvh: the BVH, which also holds the corners.
      normals: outward unit shading normals at the three corners.
      parts: index of each triangle's mesh part.
      radiance: linear RGB radiance of opaque parts at the three corners, meaningless elsewhere;
        empty if it is unknown, or no part is opaque.
    """

    bvh: BVH
    normals: Float[Array, "primitives 3 3"]
    parts: Int[Array, " primitives"]
    radiance: Float[Array, "radiating 3 3"]


class SurfacePoint(NamedTuple):
    """A point on a surface.

    Attributes:
      position: point on the triangle's plane, world units.
      geometric_normal: outward unit normal of the triangle.
      shading_normal: outward unit normal, interpolated between the corners.
      part: index of the mesh part.
      scale: largest absolute coordinate of the triangle, which sets the rounding error of
        `position`.
      radiance: linear RGB radiance of the surface, `None` if it is unknown.
    """

    position: Float[Array, "3"]
    geometric_normal: Float[Array, "3"]
    shading_normal: Float[Array, "3"]
    part: Int[Array, ""]
    scale: Float[Array, ""]
    radiance: Float[Array, "3"] | None = None


def surface_point(
    surfaces: Surfaces, primitive_id: Int[Array, ""], barycentric: Float[Array, "2"]
) -> SurfacePoint:
    """Returns the point of one triangle at barycentric coordinates.

    The position is computed from the corners, not from a distance along a ray, so its error does
    not grow with the length of the ray.

    Args:
      surfaces: surfaces of the scene.
      primitive_id: index of a triangle; for `NO_PRIMITIVE` the result is finite but meaningless.
      barycentric: weights of the second and third corner.
    """
    corners = surfaces.bvh.triangles[primitive_id]
    geometric = geometric_normal(corners)
    blended = interpolate(surfaces.normals[primitive_id], barycentric)
    shading = numerics.normalize(blended)
    opposed = numerics.dot(shading, geometric) <= 0.0
    radiance = None
    if surfaces.radiance.shape[0]:
        radiance = interpolate(surfaces.radiance[primitive_id], barycentric)
    return SurfacePoint(
        position=interpolate(corners, barycentric),
        geometric_normal=geometric,
        shading_normal=jnp.where(opposed, geometric, shading),
        part=surfaces.parts[primitive_id],
        scale=numerics.largest_component(corners.reshape(9)),
        radiance=radiance,
    )


def pack_meshes(
    meshes: Sequence[Mesh], *, radiance: Sequence[Float[np.ndarray, "_ 3 3"]] = ()
) -> Surfaces:
    """Packs meshes for the device; none may be empty, and parts are numbered in their order.

    Args:
      meshes: meshes of the parts.
      radiance: linear RGB radiance at the corners of each mesh, or nothing.
    """
    return build_surfaces(
        np.concatenate([np.zeros((0, 3, 3)), *(mesh.vertices[mesh.faces] for mesh in meshes)]),
        np.concatenate([np.zeros((0, 3, 3)), *(mesh.normals for mesh in meshes)]),
        np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes]),
        radiance=np.concatenate([np.zeros((0, 3, 3)), *radiance]),
    )


def build_surfaces(
    triangles: Float[np.ndarray, "faces 3 3"],
    normals: Float[np.ndarray, "faces 3 3"],
    parts: Int[np.ndarray, " faces"],
    *,
    radiance: Float[np.ndarray, "radiating 3 3"] | None = None,
) -> Surfaces:
    """Builds the `Surfaces` of a triangle soup, in single precision.

    Args:
      triangles: corners, counter-clockwise seen from outside, world units. May be empty.
      normals: outward unit shading normals at the corners.
      parts: part index of each triangle.
      radiance: linear RGB radiance at the corners of all triangles, or of none.

    Returns:
      The surfaces, in the leaf order of their tree.
    """
    if radiance is None or len(radiance) == 0:
        radiance = np.zeros((0, 3, 3))
    bvh, primitive_ids = bvh_build.build(triangles.astype(np.float32))
    if len(triangles) == 0:
        return Surfaces(
            bvh,
            numerics.host_array(np.zeros_like(bvh.triangles)),
            numerics.host_array(primitive_ids),
            numerics.host_array(radiance.astype(np.float32)),
        )
    return Surfaces(
        bvh,
        numerics.host_array(normals[primitive_ids].astype(np.float32)),
        numerics.host_array(parts[primitive_ids].astype(np.int32)),
        numerics.host_array(
            (radiance[primitive_ids] if len(radiance) else radiance).astype(np.float32)
        ),
    )
