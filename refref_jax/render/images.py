"""Renders images in tiles and chunks of fixed size, so that programs compile once.

Rays are traced in *tiles*. The paths of a tile are sorted so that empty slots come last, and are
then rendered in *chunks*: a pixel that misses the objects costs one path, not two. The loops over
tiles and chunks run on the host, so they cannot be part of a transformed function. This is one of
the modules that call `jax.jit`.

With several rays per pixel, a pixel is divided into `side x side` smaller ones. Each has its own
ray, with a footprint smaller by the same factor, so the fields are queried for finer detail too.
Colours are averaged as linear light and encoded afterwards, as a camera does.

`find_first_surface` casts rays without light: distances, normals and parts.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from refref_jax import numerics
from refref_jax.choices import side_of
from refref_jax.compilation import at_once, fetch, jit_quickly, refuse_tracers, runs_on_cpu
from refref_jax.geometry import bvh
from refref_jax.geometry import cameras as pinholes
from refref_jax.geometry.cameras import Cameras, box_filter, pixel_rays, supersample
from refref_jax.geometry.rays import Rays
from refref_jax.geometry.surfaces import LevelSet, Surfaces, closest, meet, surface_point
from refref_jax.numerics import host_array
from refref_jax.optics import light_paths, path_tracing
from refref_jax.optics.light_paths import Branch
from refref_jax.optics.media import EMPTY_SLOT, Scene, in_one_precision
from refref_jax.optics.path_settings import STRAIGHT, Detail, PathSettings
from refref_jax.render import backdrop, learned_media, pixels
from refref_jax.render.backdrop import Mips
from refref_jax.render.model import Model, ModelConfig, Params, is_backdrop, path_detail, surface_of
from refref_jax.render.model import Rendering as Rendering
from refref_jax.render.pixels import ALL, BRANCHES, BackdropEnds, TilePaths
from refref_jax.sampling.scene_bounds import OccupancyGrid, meets_occupied

# Padding rays start this far away and point away: they hit nothing, and need no path buffers.
_OUT_OF_REACH = 1e9

_SMALLEST_TILE = 1024  # smaller ones would have too little capacity for the paths of a ray

_Tree = TypeVar("_Tree")

TILE = 16384
"""Number of rays traced at once on a CPU; see `on_this_device`."""

CHUNK = 4096
"""Number of paths rendered at once on a CPU; see `on_this_device`."""

_MOST_PARTS = 16  # that a tile is divided into, if its paths do not fit the buffers
# An accelerator takes as many times the rays and paths, since the host waits for each tile.
_TIMES = 16

NO_PART = -1

_CAST_INSTEAD = "Call it outside, or cast single rays with bvh.closest_hits."
_INSTEAD = "Call it outside, or use render_rays, which is a pure function."

backdrop_ends = jit_quickly(
    pixels.backdrop_ends,
    static_argnames=("settings", "domain", "resolution", "most_taps", "axes", "tally", "fields"),
)
mipmap = jit_quickly(backdrop.mipmap, static_argnames="space")
_finish = jit_quickly(pixels.finish)
_meets_occupied = jit_quickly(jax.vmap(meets_occupied, in_axes=(None, 0)))

RAYS_OF_A_BAND = 1 << 18
"""Maximum number of rays held at once, unless one row of pixels has more."""


def in_tiles(
    see: Callable[[Rays, Int[np.ndarray, "tile slots"] | None, int], _Tree],
    rays: Rays,
    *,
    tile: int,
    nothing: _Tree,
    instead: str,
    interior_list: Int[np.ndarray, "*rays slots"] | None = None,
) -> _Tree:
    """Renders rays tile by tile, two tiles at once on CPUs, to NumPy arrays.

    Args:
      see: function that renders a tile, given its rays, their interior lists, and the number of
        rays that are not padding.
      rays: camera rays with any leading axes, which the result has, too.
      tile: number of rays per tile.
      nothing: result for 0 rays.
      instead: advice at the end of the error message.
      interior_list: interior list of each ray's origin, if known.

    Raises:
      TypeError: if an array is a tracer, see `compilation.refuse_tracers`.
    """
    rays, interior_list = fetch((rays, interior_list), instead=instead)
    shape, count = rays.radii.shape, rays.radii.size
    axes = len(shape)
    flat, listed = jax.tree.map(lambda x: x.reshape(-1, *x.shape[axes:]), (rays, interior_list))

    def part(start: int) -> Any:
        real = min(tile, count - start)
        return _see_tile(see, *crop(flat, listed, start, tile), real, instead)

    parts = at_once(part, range(0, count, tile))
    joined = join(parts or [nothing])
    return jax.tree.map(lambda x: x[:count].reshape((*shape, *x.shape[1:])), joined)


def _see_tile(
    see: Callable[..., Any], rays: Rays, listed: np.ndarray | None, real: int, instead: str
) -> Any:
    """Renders a tile; in halves, if light was dropped because its paths did not fit the buffers."""
    seen = fetch(see(rays, listed, real), instead=instead)
    lost, tile, half = np.sum(getattr(seen, "dropped", 0.0)), rays.radii.size, -(-real // 2)
    if not lost or real <= tile // _MOST_PARTS:
        return seen
    first, second = (
        _see_tile(see, *crop(*_select((rays, listed), part), 0, tile), count, instead)
        for part, count in ((slice(half), half), (slice(half, real), real - half))
    )
    whole = join([_select(first, slice(half)), _select(second, slice(tile - half))])
    # Truncated paths that are black are dropped, too: fewer rays at once do not help.
    return whole if np.sum(whole.dropped) < lost else seen


def _select(tree: _Tree, which: Any) -> _Tree:
    """Returns some of the values of all arrays of a pytree."""
    return jax.tree.map(lambda x: host_array(x[which]), tree)


def on_this_device(size: int) -> int:
    """Returns the size of a tile or chunk on this process's devices: larger off CPUs."""
    return size if runs_on_cpu() else _TIMES * size


def size_for(rays: int, *, most: int) -> int:
    """Returns the tile size for a number of rays: smaller tiles for few rays."""
    return min(most, max(_SMALLEST_TILE, 1 << max(rays - 1, 0).bit_length()))


def tile_for(rays: int) -> int:
    """Returns the number of rays to trace at once on this process's devices."""
    return size_for(rays, most=on_this_device(TILE))


def join(parts: Sequence[_Tree]) -> _Tree:
    """Concatenates the arrays of several pytrees, as NumPy arrays."""
    return jax.tree.map(lambda *each: np.concatenate(each), *parts)


def crop(
    rays: Rays, interior_list: Int[np.ndarray, "rays slots"] | None, start: int, tile: int
) -> tuple[Rays, Int[np.ndarray, "tile slots"] | None]:
    """Returns one tile of rays; the last tile is padded with rays that hit nothing.

    Args:
      rays: all rays, as NumPy arrays.
      interior_list: interior list of each ray's origin, if known.
      start: index of the first ray of the tile.
      tile: number of rays per tile.
    """
    part, within = jax.tree.map(lambda x: x[start : start + tile], (rays, interior_list))
    missing = tile - part.radii.shape[0]
    away = np.tile(np.eye(3, dtype=part.directions.dtype)[:1], (missing, 1))
    filling = Rays(
        host_array(_OUT_OF_REACH * away),
        host_array(away),
        host_array(np.ones(missing, part.radii.dtype)),
        None if part.strata is None else host_array(np.ones((missing, 3), part.strata.dtype)),
    )
    nowhere = jax.tree.map(lambda x: np.full((missing, x.shape[1]), EMPTY_SLOT, x.dtype), within)
    return jax.tree.map(lambda a, b: np.concatenate([a, b]), (part, within), (filling, nowhere))


def render_image(
    model: Model, rays: Rays, *, chunk: int | None = None, branch: Branch = "both"
) -> Rendering:
    """Renders any number of rays in chunks of fixed size; 0 rays give an empty rendering.

    Args:
      model: trained model.
      rays: camera rays with any leading axes, usually `[height, width]`.
      chunk: number of paths rendered at once, by default 4096, and 65,536 off CPUs; lower it if
        memory runs out. A backdrop renders those of a tile.
      branch: selection of paths by their branch at the first surface. The linear colours of
        `transmitted` and `reflected` sum to those of `both`. All three use one compiled program.

    Returns:
      NumPy arrays, with the leading axes of the rays.

    Raises:
      ValueError: if `chunk` is less than 1, or `branch` is unknown.
      TypeError: if it is called in a function that JAX transforms.
    """
    if branch not in BRANCHES:
        raise ValueError(f"branch is {branch!r}, unknown. Use one of {', '.join(BRANCHES)}.")
    chunk = on_this_device(CHUNK) if chunk is None else chunk
    if chunk < 1:
        raise ValueError(f"chunk is {chunk}, but a chunk needs paths. Give 1 or more.")
    refuse_tracers((model.params, model.scene), instead=_INSTEAD)
    rays = jax.tree.map(np.float32, fetch(rays, instead=_INSTEAD))
    nothing = jax.device_get(pixels.blank(jax.device_put(np.zeros((0, 3), np.float32))))
    how: dict[str, Any] = {"tile": tile_for(max(rays.radii.size, TILE)), "nothing": nothing}

    def render(some: Rays) -> Rendering:
        return in_tiles(
            lambda tile, _, real: _render_tile(model, tile, real, chunk, branch),
            some,
            **how,
            instead=_INSTEAD,
        )

    if model.config.backdrop is None or branch != "both":
        return render(rays)
    # A field in front of a backdrop is on or inside objects, or in the hull of the masks.
    ball, behind = model.config.backdrop.field_ball, _backdrop_renderer(model, how)
    hull = None if ball is None else OccupancyGrid(model.params.field.hull, ball)
    met, hits, misses = split_by_hit(model.scene.surfaces, rays, grid=hull)
    seen = behind(hits, model.settings) if is_backdrop(model.config) else render(hits)
    return jax.tree.map(functools.partial(merged, met), seen, behind(misses, STRAIGHT))


def _backdrop_renderer(
    model: Model, how: dict[str, Any]
) -> Callable[[Rays, PathSettings], Rendering]:
    """Returns a function of rays and path settings that renders a backdrop without a field."""
    shape, config = model.config.backdrop, model.config
    assert shape is not None
    params, scene = jax.device_put((model.params, model.scene))
    mips = mipmap(surface_of(params), config.space)
    look = functools.partial(
        backdrop_ends,
        scene,
        domain=config.domain,
        resolution=shape.resolution,
        most_taps=shape.most_taps,
        axes=shape.axes,
        tally=path_detail(config, model.settings).tally,
        fields=(),
        faint=0.0,
    )

    def render(some: Rays, settings: PathSettings) -> Rendering:
        return in_tiles(
            lambda tile, *_: _of_backdrop(params, mips, *look(tile, settings=settings)),
            some,
            **how,
            instead=_INSTEAD,
        )

    return render


def split_by_hit(
    surfaces: Surfaces | LevelSet,
    rays: Rays,
    *,
    tile: int | None = None,
    grid: OccupancyGrid | None = None,
    instead: str = _INSTEAD,
) -> tuple[Bool[np.ndarray, "*rays"], Rays, Rays]:
    """Returns which rays meet an object, these rays and the others; `merged` joins their values.

    Rays that meet an occupied cell of `grid` count, too.
    """
    refuse_tracers(surfaces, instead=instead)
    rays = fetch(rays, instead=instead)
    met = np.isfinite(find_first_surface(surfaces, rays, tile=tile).distances)
    if grid is not None:
        grid = jax.device_put(OccupancyGrid(grid.occupancy, np.asarray(grid.ball, np.float32)))
        how: Any = {"tile": size_for(rays.radii.size, most=TILE), "nothing": np.zeros(0, bool)}
        met |= in_tiles(lambda some, *_: _meets_occupied(grid, some), rays, **how, instead=instead)
    return met, _select(rays, met), _select(rays, ~met)


def merged(met: np.ndarray, some: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Returns values of all rays from those of the rays that meet an object, and of the others."""
    whole = np.empty((*met.shape, *some.shape[1:]), some.dtype)
    whole[met], whole[~met] = some, others
    return whole


@jit_quickly
def _of_backdrop(
    params: Params, mips: Mips, ends: BackdropEnds, dropped: Float[Array, "rays 3"]
) -> Rendering:
    """Renders rays in front of a backdrop, given its mipmap and the ends of their paths."""
    lookups, count = ends.lookups, dropped.shape[0]
    share = jnp.mean(lookups.throughput, axis=-1)
    heaviest = light_paths.heaviest(share, lookups.pixels, ends.distances > 0.0, rays=count)
    if params.tints is not None:
        left = learned_media.transmittance(params.tints, ends.crossings)
        lookups = lookups._replace(throughput=lookups.throughput * left)
    sums = pixels.blank(dropped)
    target = jnp.where(heaviest, lookups.pixels, count)
    distance = sums.distance.at[target].set(ends.distances, mode="drop")
    share = jnp.mean(lookups.throughput, axis=-1)
    return pixels.finish(
        sums._replace(
            distance=distance,
            mean_distance=distance,
            accumulation=sums.accumulation.at[lookups.pixels].add(share),
            linear=backdrop.colours(mips, lookups, pixels=count),
        )
    )


def _render_tile(model: Model, rays: Rays, real: int, chunk: int, branch: Branch) -> Rendering:
    detail = path_detail(model.config, model.settings)
    which = BRANCHES.index(branch)
    tile = _trace_tile(model.scene, rays, real, which, settings=model.settings, detail=detail)
    sums = pixels.blank(tile.dropped)
    count = int(fetch(tile.count, instead=_INSTEAD))
    if model.config.backdrop is not None:  # every chunk builds its mipmap
        chunk = tile.paths.radii.size
    for start in range(0, count, chunk):
        sums = _render_chunk(model.params, tile, sums, start, config=model.config, chunk=chunk)
    return _finish(sums)


@functools.partial(jit_quickly, static_argnames=("settings", "detail"))
def _trace_tile(
    scene: Scene,
    rays: Rays,
    real: Int[Array, ""],
    which: int | Int[Array, ""] = ALL,
    *,
    settings: PathSettings,
    detail: Detail,
) -> TilePaths:
    traced = path_tracing.trace(scene, rays, settings=settings, detail=detail)
    return pixels.sort_paths(traced, real, which=which)


@functools.partial(jit_quickly, static_argnames=("config", "chunk"))
def _render_chunk(
    params: Params,
    tile: TilePaths,
    sums: Rendering,
    start: Int[Array, ""],
    *,
    config: ModelConfig,
    chunk: int,
) -> Rendering:
    # Slots past the end repeat the last path with throughput 0.
    index = start + jnp.arange(chunk)
    held = jnp.minimum(index, tile.count - 1)
    paths = jax.tree.map(lambda x: x[held], tile.paths)
    real = index < tile.count
    paths = paths._replace(throughput=jnp.where(real[:, None], paths.throughput, 0.0))
    return pixels.add_paths(params, paths, tile.heaviest[held] & real, sums, config=config)


def render_camera(
    model: Model,
    cameras: Cameras,
    view: int,
    *,
    rays_per_pixel: int = 1,
    chunk: int | None = None,
    band: int = RAYS_OF_A_BAND,
) -> Rendering:
    """Renders one camera's image, with one or several rays in every pixel.

    Rows of pixels are rendered band by band, so that memory does not grow with the image. Gaussian
    splats are rendered at once, also those of pixels of a size that they were not trained with.

    Args:
      model: trained model.
      cameras: cameras with the resolution of the image.
      view: index of the camera.
      rays_per_pixel: number of rays in each pixel, a square: 1, 4, 9, 16.
      chunk: number of paths rendered at once, as in `render_image`.
      band: number of rays held at once; at least one row of pixels is.

    Returns:
      NumPy arrays as `[height, width]`, see `average`.

    Raises:
      ValueError: if the rays of a pixel do not make a square grid, or several are requested of
        Gaussian splats of kind `classic`.
      TypeError: if it is called in a function that JAX transforms.
    """
    side = side_of(rays_per_pixel)
    fine = supersample(cameras, side)
    if model.config.splats is not None:
        return average(pixels.render_splats(model, fine, view, side=side), side)
    bands = [
        average(render_image(model, rays, chunk=chunk), side)
        for rays in pinholes.bands(fine, view, rows=side * max(1, band // (side * fine.width)))
    ]
    return join(bands)


def warm_up(model: Model, cameras: Cameras, *, rays_per_pixel: int, chunk: int | None) -> None:
    """Compiles all programs of `render_camera`, so that later timings are of rendering alone."""
    on_cpu = runs_on_cpu() and model.config.splats is None
    if on_cpu and model.config.backdrop is None:  # one tile size serves all images
        render_image(model, pixel_rays(cameras, *np.zeros((3, 1), np.int64)), chunk=chunk)
    else:
        render_camera(model, cameras, 0, rays_per_pixel=rays_per_pixel, chunk=chunk)


def average(fine: Rendering, side: int) -> Rendering:
    """Averages the small pixels of a supersampled camera.

    Colours are averaged as linear light, and then encoded and clipped. The distance is the lower
    median: at an edge it is that of one of the two surfaces, never one between them.
    """

    def filtered(values: Array | np.ndarray) -> Any:
        return host_array(box_filter(np.asarray(values), side))

    linear = filtered(fine.linear)
    return Rendering(
        rgb=np.clip(jax.device_get(pixels.linear_to_srgb(jax.device_put(linear))), 0.0, 1.0),
        distance=host_array(pinholes.lower_median(np.asarray(fine.distance), side)),
        mean_distance=filtered(fine.mean_distance),
        accumulation=filtered(fine.accumulation),
        linear=linear,
        dropped=filtered(fine.dropped),
    )


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


def find_first_surface(
    surfaces: Surfaces | LevelSet, rays: Rays, *, tile: int | None = None
) -> FirstSurface:
    """Casts rays and returns the first surface of each.

    Args:
      surfaces: surfaces of the scene.
      rays: rays with any leading axes, usually `[height, width]`, and unit directions.
      tile: number of rays cast at once, by default 16,384, and 262,144 off CPUs.

    Raises:
      ValueError: if `tile` is less than 1.
    """
    tile = on_this_device(TILE) if tile is None else tile
    if tile < 1:
        raise ValueError(f"tile is {tile}, but a tile needs rays. Give 1 or more.")
    refuse_tracers(surfaces, instead=_CAST_INSTEAD)
    surfaces = jax.device_put(surfaces)
    empty = np.zeros((0, 3), jax.dtypes.canonicalize_dtype(rays.radii.dtype))
    return in_tiles(
        lambda part, *_: FirstSurface(*_cast_tile(surfaces, part)),
        rays,
        tile=size_for(rays.radii.size, most=tile),
        nothing=FirstSurface(empty[:, 0], empty, np.zeros(0, np.int32)),
        instead=_CAST_INSTEAD,
    )


@jit_quickly
def _cast_tile(
    surfaces: Surfaces | LevelSet, rays: Rays
) -> tuple[Float[Array, " rays"], Float[Array, "rays 3"], Int[Array, " rays"]]:
    surfaces, rays = in_one_precision(surfaces, rays)
    if isinstance(surfaces, LevelSet):
        return jax.vmap(_meet_level_set, in_axes=(None, 0))(surfaces, rays)
    limits = jnp.full_like(rays.radii, jnp.inf)
    exclude_primitive = jnp.full(rays.radii.shape, bvh.NO_PRIMITIVE, jnp.int32)
    hits = bvh.closest_hits(surfaces.bvh, rays, limits=limits, exclude_primitive=exclude_primitive)
    found = hits.primitive_ids != bvh.NO_PRIMITIVE
    point = functools.partial(surface_point, surfaces)
    points = jax.vmap(point)(hits.primitive_ids, hits.barycentrics)
    normals = jnp.where(found[:, None], points.shading_normal, 0.0)
    return hits.distances, normals, jnp.where(found, points.part, NO_PART)


def _meet_level_set(
    surface: LevelSet, ray: Rays
) -> tuple[Float[Array, ""], Float[Array, "3"], Int[Array, ""]]:
    """Returns distance, normal and part of the first hit of one ray."""
    limit, nothing = jnp.full_like(ray.radii, jnp.inf), jnp.int32(bvh.NO_PRIMITIVE)
    stretch = closest(surface, ray.origins, ray.directions, limit, nothing)
    point = meet(surface, stretch, ray.origins, ray.directions)
    found = stretch != bvh.NO_PRIMITIVE
    distance = jnp.where(found, numerics.length(point.position - ray.origins), jnp.inf)
    normal = jnp.where(found, point.shading_normal, 0.0)
    return distance, normal, jnp.where(found, point.part, NO_PART)
