"""Where camera rays first meet an object: the geometry of an image, with no light in it.

Rays go in tiles of fixed size, so that memory is bounded and nothing is compiled twice: this is one
of the modules that call `jax.jit`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from refref_jax.geometry import bvh
from refref_jax.geometry.rays import Rays
from refref_jax.geometry.surfaces import Surfaces, surface_point
from refref_jax.render import tiles

TILE = 65536
"""Rays cast at once."""

NO_PART = -1

_INSTEAD = "Call it outside, or cast single rays with bvh.closest_hits."


class FirstSurface(NamedTuple):
    """What rays meet first. The leading axes are those of the rays.

    Attributes:
      distances: arc length from the ray's origin, world units; `inf` where it meets nothing.
      normals: unit shading normal, out of the body; zero where the ray meets nothing.
      parts: index of the mesh part, or `NO_PART`.
    """

    distances: Float[np.ndarray, "*rays"]
    normals: Float[np.ndarray, "*rays 3"]
    parts: Int[np.ndarray, "*rays"]


def find_first_surface(surfaces: Surfaces, rays: Rays, *, tile: int = TILE) -> FirstSurface:
    """Casts rays and returns the first surface of each.

    Args:
      surfaces: the scene.
      rays: any leading axes, usually `[height, width]`; unit directions.
      tile: rays cast at once.

    Raises:
      ValueError: if a tile holds no ray.
    """
    if tile < 1:
        raise ValueError(f"A tile of {tile} rays casts nothing. Give 1 or more.")
    surfaces = jax.device_put(surfaces)
    empty = np.zeros((0, 3), jax.dtypes.canonicalize_dtype(rays.radii.dtype))
    return tiles.in_tiles(
        lambda part, *_: FirstSurface(*_cast(surfaces, part)),
        rays,
        tile=tiles.size_for(rays.radii.size, most=tile),
        nothing=FirstSurface(empty[:, 0], empty, np.zeros(0, np.int32)),
        instead=_INSTEAD,
    )


@jax.jit
def _cast(
    surfaces: Surfaces, rays: Rays
) -> tuple[Float[Array, " rays"], Float[Array, "rays 3"], Int[Array, " rays"]]:
    limits = jnp.full_like(rays.radii, jnp.inf)
    leaving = jnp.full(rays.radii.shape, bvh.NO_SLOT, jnp.int32)
    hits = bvh.closest_hits(surfaces.bvh, rays, limits=limits, leaving=leaving)
    found = hits.slots != bvh.NO_SLOT
    points = jax.vmap(surface_point, in_axes=(None, 0, 0))(surfaces, hits.slots, hits.barycentrics)
    normals = jnp.where(found[:, None], points.shading_normal, 0.0)
    return hits.distances, normals, jnp.where(found, points.part, NO_PART)
