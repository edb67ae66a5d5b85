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
from refref_jax.optics import light_paths, path_tracing
from refref_jax.optics.budgets import Budget
from refref_jax.optics.light_paths import PathEnds
from refref_jax.optics.wavefront import Geometry
from refref_jax.render import colour, tiles
from refref_jax.render.backgrounds import Radiance

TILE = 65536
"""Rays traced at once."""

_SMALLEST_TILE = 1024

# Paths that are looked up at once.
_CHUNK = 4096


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
    geometry: Geometry,
    radiance: Radiance,
    rays: Rays,
    *,
    budget: Budget,
    inside: Int[np.ndarray, "*rays slots"] | None = None,
    tile: int = TILE,
) -> KnownRendering:
    """Renders any number of rays in front of a known background; 0 rays give an empty rendering.

    Args:
      geometry: the scene.
      radiance: what one ray sees of the background, see the module.
      rays: camera rays with any leading axes, usually `[height, width]`.
      budget: which light to follow.
      inside: the parts that each ray starts in, for the rule `priority` (see
        `data.containment.parts_around`); by default none.
      tile: rays traced at once: the option to lower when memory runs out. A budget's room is that
        of its tile: the fewer rays share it, the sooner light is lost.

    Raises:
      ValueError: if a tile holds no ray.
    """
    if tile < 1:
        raise ValueError(f"A tile of {tile} rays renders nothing. Give 1 or more.")
    if jax.tree.structure(radiance) == jax.tree.structure(0):
        radiance = jax.tree_util.Partial(radiance)  # a leaf is no argument of a compiled function
    rays, inside = jax.tree.map(np.asarray, (rays, inside))
    shape = rays.radii.shape
    count = rays.radii.size
    # Few rays need no large tile, but a budget's room must not be that of a ray or two.
    tile = min(tile, max(_SMALLEST_TILE, 1 << max(count - 1, 0).bit_length()))
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[len(shape) :]), (rays, inside))
    # On the device once, not once a tile.
    geometry, radiance = jax.device_put((geometry, radiance))
    parts = [jax.device_get(_blank())]
    for start in range(0, count, tile):
        part = tiles.cut_out(*flat, start, tile)
        parts.append(jax.device_get(_render_tile(geometry, radiance, *part, budget=budget)))
    casts = sum(int(each.casts) for each in parts)
    fields = [np.concatenate(field)[:count] for field in zip(*(p[:-1] for p in parts), strict=True)]
    fields = [field.reshape(*shape, *field.shape[1:]) for field in fields]
    # Each ray that fills up the last tile misses, which takes one cast if any are made.
    return KnownRendering(*fields, casts - (-count % tile) * (budget.bends > 0))


def _blank() -> _Tile:
    nothing = jnp.zeros((0, 3))
    return _Tile(nothing, nothing, jnp.zeros(0, jnp.int32), nothing, casts=jnp.zeros((), jnp.int32))


@functools.partial(jax.jit, static_argnames="budget")
def _render_tile(
    geometry: Geometry,
    radiance: Radiance,
    rays: Rays,
    inside: Int[Array, "rays slots"] | None,
    *,
    budget: Budget,
) -> _Tile:
    count = rays.radii.shape[0]
    traced = path_tracing.trace_ends(geometry, rays, budget=budget, inside=inside)
    ends = traced.ends
    linear = _sum_light(radiance, ends, count)
    exists = light_paths.exists(ends).astype(jnp.int32)
    return _Tile(
        rgb=jnp.clip(colour.linear_to_srgb(linear), 0.0, 1.0),
        linear=linear,
        paths=jax.ops.segment_sum(exists, ends.rays, num_segments=count),
        lost=traced.lost,
        casts=traced.casts,
    )


def _sum_light(radiance: Radiance, ends: PathEnds, rays: int) -> Float[Array, "rays 3"]:
    """Returns the light of each ray, looked up in chunks that end where the paths do.

    The list has room for more paths than there are, and looking up a texture costs about as much as
    casting a ray.
    """
    slots = ends.rays.shape[0]
    chunk = min(_CHUNK, slots)
    count = jnp.sum(light_paths.exists(ends), dtype=jnp.int32)

    def add(state: tuple[Array, Array]) -> tuple[Array, Array]:
        start, linear = state
        index = start + jnp.arange(chunk, dtype=jnp.int32)
        part = jax.tree.map(lambda x: x[jnp.minimum(index, slots - 1)], ends)
        seen = jax.vmap(radiance)(part.origins, part.directions)
        light = jnp.where((index < count)[:, None], part.weights * seen, 0.0)
        return start + chunk, linear.at[part.rays].add(light)

    begin = jnp.zeros((), jnp.int32), jnp.zeros((rays, 3), ends.weights.dtype)
    return jax.lax.while_loop(lambda state: state[0] < count, add, begin)[1]
