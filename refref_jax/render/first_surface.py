"""First surface hit by each camera ray: distances, normals and parts, without light.

Rays are cast in tiles of fixed size, so that memory is bounded and programs compile once: this is
one of the modules that call `jax.jit`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from refref_jax.geometry import bvh
from refref_jax.geometry.rays import Rays
from refref_jax.geometry.surfaces import Surfaces, surface_point
from refref_jax.render import images

TILE = 65536
"""Number of rays cast at once."""

NO_PART = -1

_INSTEAD = "Call it outside, or cast single rays with bvh.closest_hits."


class FirstSurface(NamedTuple):
    """First surface hit by each ray. The leading axes are those of the rays.

    Attributes:
      distances: arc length from the ray's origin, world units; `inf` for a miss.
      normals: unit shading normal, out of the object; zero for a miss.
      parts: index of the mesh part, or `NO_PART`.
    """

    distances: Float[np.ndarray, "*rays"]
    normals: Float[np.ndarray, "*rays 3"]
    parts: Int[np.ndarray, "*rays"]


def find_first_surface(surfaces: Surfaces, rays: Rays, *, tile: int = TILE) -> FirstSurface:
    """Casts rays and returns the first surface of each.

    Args:
      surfaces: surfaces of the scene.
      rays: rays with any leading axes, usually `[height, width]`, and unit directions.
      tile: number of rays cast at once.

    Raises:
      ValueError: if `tile` is less than 1.
    """
    if tile < 1:
        raise ValueError(f"tile is {tile}, but a tile needs rays. Give 1 or more.")
    surfaces = jax.device_put(surfaces)
    empty = np.zeros((0, 3), jax.dtypes.canonicalize_dtype(rays.radii.dtype))
    return images.in_tiles(
        lambda part, *_: FirstSurface(*_cast(surfaces, part)),
        rays,
        tile=images.size_for(rays.radii.size, most=tile),
        nothing=FirstSurface(empty[:, 0], empty, np.zeros(0, np.int32)),
        instead=_INSTEAD,
    )


@jax.jit
def _cast(
    surfaces: Surfaces, rays: Rays
) -> tuple[Float[Array, " rays"], Float[Array, "rays 3"], Int[Array, " rays"]]:
    limits = jnp.full_like(rays.radii, jnp.inf)
    exclude_primitive = jnp.full(rays.radii.shape, bvh.NO_PRIMITIVE, jnp.int32)
    hits = bvh.closest_hits(surfaces.bvh, rays, limits=limits, exclude_primitive=exclude_primitive)
    found = hits.primitive_ids != bvh.NO_PRIMITIVE
    points = jax.vmap(surface_point, in_axes=(None, 0, 0))(
        surfaces, hits.primitive_ids, hits.barycentrics
    )
    normals = jnp.where(found[:, None], points.shading_normal, 0.0)
    return hits.distances, normals, jnp.where(found, points.part, NO_PART)
