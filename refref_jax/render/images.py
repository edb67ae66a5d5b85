"""Renders images in tiles and chunks of fixed size, so that programs compile once.

Rays are traced in tiles. The paths of a tile are sorted so that empty slots come last, and are then
rendered in chunks: a pixel that misses the objects costs one path, not two. This is one of the
modules that call `jax.jit`.
"""

import functools
from typing import NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from refref_jax.geometry.rays import Rays
from refref_jax.optics import light_paths, path_tracing
from refref_jax.optics.budgets import Budget
from refref_jax.optics.details import Detail
from refref_jax.optics.first_branches import Branch, reflected_first
from refref_jax.optics.light_paths import LightPaths
from refref_jax.optics.path_tracing import Traced
from refref_jax.optics.scene import Scene
from refref_jax.render import colour, dyes, pixels, tiles
from refref_jax.render.config import ModelConfig, path_detail
from refref_jax.render.model import Model, Params

TILE = 16384
"""Number of rays traced at once."""

CHUNK = 4096
"""Number of paths rendered at once. Lower it if memory runs out."""

_INSTEAD = "Call it outside, or use render_rays, which is a pure function."
_BRANCHES: tuple[Branch, ...] = get_args(Branch)
_ALL, _PASSED, _MIRRORED = range(len(_BRANCHES))


class Rendering(NamedTuple):
    """Rendered rays. The leading axes are those of the rays.

    Attributes:
      rgb: sRGB colours in `[0, 1]`.
      distance: median distance along the ray's heaviest path, as arc length from the camera in
        world units.
      mean_distance: mean distance along the ray's heaviest path.
      accumulation: sum of the weights, 1 with an opaque background.
      linear: linear RGB colours, not clipped, for averaging the rays of a pixel.
      lost: dropped throughput of each ray, because a path buffer was full.
    """

    rgb: Float[Array, "*rays 3"]
    distance: Float[Array, "*rays"]
    mean_distance: Float[Array, "*rays"]
    accumulation: Float[Array, "*rays"]
    linear: Float[Array, "*rays 3"]
    lost: Float[Array, "*rays 3"]


class _Tile(NamedTuple):
    """The paths of a tile, with the selected paths first.

    Attributes:
      paths: light paths.
      heaviest: whether a path is the heaviest of its ray.
      count: number of selected paths.
      lost: dropped throughput of each ray.
    """

    paths: LightPaths
    heaviest: Bool[Array, " paths"]
    count: Int[Array, ""]
    lost: Float[Array, "rays 3"]


def render_rays(model: Model, rays: Rays) -> Rendering:
    """Renders rays in one piece: a pure function, to be jitted or differentiated by the caller.

    A trained model is in single precision, and so are its renderings.

    Args:
      model: trained model.
      rays: camera rays `[n]`. They share the path buffers, so with few rays, throughput is dropped
        sooner.
    """
    rays = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), rays)
    detail = path_detail(model.config, model.budget)
    traced = path_tracing.trace(model.geometry, rays, budget=model.budget, detail=detail)
    tile = _sort(traced, traced.lost.shape[0])
    sums = _blank(tile.lost)
    return _finish(_add(model.params, tile.paths, tile.heaviest, sums, config=model.config))


def render_image(
    model: Model, rays: Rays, *, chunk: int = CHUNK, branch: Branch = "both"
) -> Rendering:
    """Renders any number of rays in chunks of fixed size; 0 rays give an empty rendering.

    Args:
      model: trained model.
      rays: camera rays with any leading axes, usually `[height, width]`.
      chunk: number of paths rendered at once.
      branch: selection of paths by their branch at the first surface. The linear colours of
        `transmitted` and `reflected` sum to those of `both`. All three use one compiled program.

    Returns:
      NumPy arrays, with the leading axes of the rays.

    Raises:
      ValueError: if `chunk` is less than 1, or `branch` is unknown.
      TypeError: if it is called in a function that JAX transforms.
    """
    if branch not in _BRANCHES:
        raise ValueError(f"branch is {branch!r}, unknown. Use one of {', '.join(_BRANCHES)}.")
    if chunk < 1:
        raise ValueError(f"chunk is {chunk}, but a chunk needs paths. Give 1 or more.")
    rays = jax.tree.map(np.float32, tiles.fetch(rays, instead=_INSTEAD))
    nothing = jax.device_get(_blank(jax.device_put(np.zeros((0, 3), np.float32))))
    return tiles.in_tiles(
        lambda tile, _, real: _render_tile(model, tile, real, chunk, branch),
        rays,
        tile=TILE,
        nothing=nothing,
        instead=_INSTEAD,
    )


def _render_tile(model: Model, rays: Rays, real: int, chunk: int, branch: Branch) -> Rendering:
    detail = path_detail(model.config, model.budget)
    which = _BRANCHES.index(branch)
    tile = _trace_tile(model.geometry, rays, real, which, budget=model.budget, detail=detail)
    sums = _blank(tile.lost)
    count = int(tiles.fetch(tile.count, instead=_INSTEAD))
    for start in range(0, count, chunk):
        sums = _render_chunk(model.params, tile, sums, start, config=model.config, chunk=chunk)
    return _finish_tile(sums)


def _blank(lost: Float[Array, "rays 3"]) -> Rendering:
    """Returns the initial rendering, before any path is added."""
    black = jnp.zeros_like(lost)
    zeros = black[:, 0]
    return Rendering(black, zeros, zeros, zeros, linear=black, lost=lost)


@functools.partial(jax.jit, static_argnames=("budget", "detail"))
def _trace_tile(
    geometry: Scene,
    rays: Rays,
    real: Int[Array, ""],
    which: Int[Array, ""] = _ALL,
    *,
    budget: Budget,
    detail: Detail,
) -> _Tile:
    traced = path_tracing.trace(geometry, rays, budget=budget, detail=detail)
    return _sort(traced, real, which)


@functools.partial(jax.jit, static_argnames=("config", "chunk"))
def _render_chunk(
    params: Params,
    tile: _Tile,
    sums: Rendering,
    start: Int[Array, ""],
    *,
    config: ModelConfig,
    chunk: int,
) -> Rendering:
    # Slots past the end repeat the last path with weight 0.
    index = start + jnp.arange(chunk)
    held = jnp.minimum(index, tile.count - 1)
    paths = jax.tree.map(lambda x: x[held], tile.paths)
    real = index < tile.count
    paths = paths._replace(weights=jnp.where(real[:, None], paths.weights, 0.0))
    return _add(params, paths, tile.heaviest[held] & real, sums, config=config)


@jax.jit
def _finish_tile(sums: Rendering) -> Rendering:
    return _finish(sums)


def _sort(traced: Traced, real: int | Int[Array, ""], which: int | Int[Array, ""] = _ALL) -> _Tile:
    """Moves the selected paths to the front and marks the heaviest path of each ray.

    Args:
      traced: traced paths of a tile.
      real: number of rays in the tile that are not padding.
      which: index of the selected branch in `_BRANCHES`.
    """
    paths, rays = traced.paths, traced.lost.shape[0]
    mirrored = jnp.where(reflected_first(paths), _MIRRORED, _PASSED)
    exists = light_paths.exists(paths) & (paths.rays < real)
    exists &= (which == _ALL) | (which == mirrored)
    order = jnp.argsort(~exists, stable=True)
    weight = jnp.mean(paths.weights, axis=-1)
    most = jax.ops.segment_max(weight, paths.rays, num_segments=rays)
    heaviest = exists & (weight >= most[paths.rays])
    sorted_paths = jax.tree.map(lambda x: x[order], paths)
    return _Tile(sorted_paths, heaviest[order], jnp.sum(exists), traced.lost)


def _add(
    params: Params,
    paths: LightPaths,
    heaviest: Bool[Array, " paths"],
    sums: Rendering,
    *,
    config: ModelConfig,
) -> Rendering:
    """Adds some paths to the linear colours and distances of their rays."""
    jitter = pixels.no_jitter(config, paths.radii.shape[0])
    one = jnp.ones((), paths.radii.dtype)
    seen = pixels.render_paths(params, config, paths, jitter, anneal=one).composite
    paths = dyes.dye(params.dyes, paths, radius=config.radius)
    share = jnp.mean(paths.weights, axis=-1)
    rays = sums.distance.shape[0]
    # Writes to an index past the end are dropped.
    target = jnp.where(heaviest, paths.rays, rays)
    return sums._replace(
        linear=sums.linear.at[paths.rays].add(paths.weights * seen.rgb),
        distance=sums.distance.at[target].set(seen.median, mode="drop"),
        mean_distance=sums.mean_distance.at[target].set(seen.mean, mode="drop"),
        accumulation=sums.accumulation.at[paths.rays].add(share * seen.accumulation),
    )


def _finish(sums: Rendering) -> Rendering:
    return sums._replace(rgb=jnp.clip(colour.linear_to_srgb(sums.linear), 0.0, 1.0))
