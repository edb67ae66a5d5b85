"""Renders scenes whose background is known: nothing is learned, only light paths count.

Every path's last segment is looked up in a radiance function, and a ray's colour is the weighted
sum over its paths. Any function of one ray that JAX can trace serves, `radiance(origin, direction)`
to linear RGB: a background (`backgrounds.radiance_of`), or one of the user's own. As a pytree, such
as `jax.tree_util.Partial(function, arrays)`, its arrays are arguments of the compiled program; what
a plain function closes over are constants of it, and each new function compiles anew.

Rays go in tiles of fixed size, so that memory is bounded and nothing is compiled twice: this is one
of the modules that call `jax.jit`.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from refref_jax.geometry.rays import Rays
from refref_jax.optics.budgets import Budget
from refref_jax.optics.ends_stand_in import trace_ends
from refref_jax.optics.light_paths import PathStatus
from refref_jax.optics.wavefront import Geometry
from refref_jax.render import colour
from refref_jax.render.backgrounds import Radiance

TILE = 16384
"""Rays traced at once."""

# Where a tile is filled up, a ray starts this far out and goes away: it meets nothing.
_OUT_OF_REACH = 1e9


class KnownRendering(NamedTuple):
    """What rays see. The leading axes are those of the rays.

    Attributes:
      rgb: sRGB in `[0, 1]`.
      linear: the same light as linear RGB, not clipped.
      paths: number of light paths that carry a ray's colour.
      lost: share of a ray's light that no path carries, for want of room.
      casts: closest-hit queries, all rays together.
    """

    rgb: Float[np.ndarray, "*rays 3"]
    linear: Float[np.ndarray, "*rays 3"]
    paths: Int[np.ndarray, "*rays"]
    lost: Float[np.ndarray, "*rays 3"]
    casts: int


class _Tile(NamedTuple):
    """What the rays of a tile see; fields as in `KnownRendering`."""

    rgb: Float[Array, "rays 3"]
    linear: Float[Array, "rays 3"]
    paths: Int[Array, " rays"]
    lost: Float[Array, "rays 3"]
    casts: Int[Array, ""]


def render_known(
    geometry: Geometry, radiance: Radiance, rays: Rays, *, budget: Budget, tile: int = TILE
) -> KnownRendering:
    """Renders any number of rays in front of a known background; 0 rays give an empty rendering.

    Args:
      geometry: the scene.
      radiance: what one ray sees of the background, see the module.
      rays: camera rays with any leading axes, usually `[height, width]`.
      budget: which light to follow.
      tile: rays traced at once: the option to lower when memory runs out.

    Raises:
      ValueError: if a tile holds no ray.
    """
    if tile < 1:
        raise ValueError(f"A tile of {tile} rays renders nothing. Give 1 or more.")
    if jax.tree.structure(radiance) == jax.tree.structure(0):
        radiance = jax.tree_util.Partial(radiance)  # a leaf is no argument of a compiled function
    rays = jax.tree.map(np.asarray, rays)
    shape = rays.radii.shape
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[len(shape) :]), rays)
    count = flat.radii.shape[0]
    # On the device once, not once a tile.
    geometry, radiance = jax.device_put((geometry, radiance))
    tiles = [jax.tree.map(np.asarray, _blank())]
    for start in range(0, count, tile):
        part = _slice_rays(flat, start, tile)
        tiles.append(jax.device_get(_render_tile(geometry, radiance, part, budget=budget)))
    casts = sum(int(each.casts) for each in tiles)
    fields = [np.concatenate(field)[:count] for field in zip(*(t[:-1] for t in tiles), strict=True)]
    fields = [field.reshape(*shape, *field.shape[1:]) for field in fields]
    filled_up = -count % tile
    # Each ray that fills up the last tile misses, which takes one cast if any are made.
    return KnownRendering(*fields, casts - filled_up * (budget.bends > 0))


def _slice_rays(rays: Rays, start: int, tile: int) -> Rays:
    """Returns one tile of rays, filled up with rays that meet nothing."""
    part = jax.tree.map(lambda x: x[start : start + tile], rays)
    missing = tile - part.radii.shape[0]
    away = np.tile(np.eye(3, dtype=part.directions.dtype)[:1], (missing, 1))
    filling = Rays(_OUT_OF_REACH * away, away, np.ones(missing, part.radii.dtype))
    return Rays(*(np.concatenate(pair) for pair in zip(part, filling, strict=True)))


def _blank() -> _Tile:
    nothing = jnp.zeros((0, 3))
    return _Tile(nothing, nothing, jnp.zeros(0, jnp.int32), nothing, casts=jnp.zeros((), jnp.int32))


@functools.partial(jax.jit, static_argnames="budget")
def _render_tile(geometry: Geometry, radiance: Radiance, rays: Rays, *, budget: Budget) -> _Tile:
    count = rays.radii.shape[0]
    traced = trace_ends(geometry, rays, budget=budget)
    ends = traced.ends
    seen = jax.vmap(radiance)(ends.origins, ends.directions)
    linear = jax.ops.segment_sum(ends.weights * seen, ends.rays, num_segments=count)
    exists = (ends.statuses != PathStatus.EMPTY).astype(jnp.int32)
    return _Tile(
        rgb=jnp.clip(colour.linear_to_srgb(linear), 0.0, 1.0),
        linear=linear,
        paths=jax.ops.segment_sum(exists, ends.rays, num_segments=count),
        lost=traced.lost,
        casts=traced.casts,
    )
