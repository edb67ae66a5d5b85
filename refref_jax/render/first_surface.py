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

_SMALLEST_TILE = 1024


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
    rays = jax.tree.map(np.asarray, rays)
    shape, count = rays.radii.shape, rays.radii.size
    tile = min(tile, max(_SMALLEST_TILE, 1 << max(count - 1, 0).bit_length()))
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[len(shape) :]), rays)
    surfaces = jax.device_put(surfaces)
    starts = range(0, max(count, 1), tile)  # no ray makes one empty tile, which has the right types
    parts = [jax.device_get(_cast(surfaces, tiles.cut_out(flat, None, i, tile)[0])) for i in starts]
    fields = [np.concatenate(field)[:count] for field in zip(*parts, strict=True)]
    return FirstSurface(*(field.reshape(*shape, *field.shape[1:]) for field in fields))


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
