"""Renders scenes with a known background, without learned fields.

The radiance function is evaluated at the last segment of every path, and the colour of a ray is the
weighted sum over its paths. Paths that end on an opaque surface have its radiance instead. The
function can be any JAX function of one ray, `radiance(origin, direction)` to linear RGB: a
background (`backgrounds.radiance_of`) or a custom function. If it is a
pytree, such as `jax.tree_util.Partial(function, arrays)`, its arrays are arguments of the compiled
program; values that a plain function closes over are constants, and every new function triggers a
compilation.

Rays are rendered in tiles, so that memory is bounded. The size of a tile is a power of two, chosen
by the number of rays that meet objects: a new one is compiled. This is one of the modules that call
`jax.jit`.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from refref_jax.choices import side_of
from refref_jax.compilation import fetch, is_transforming, jit_quickly, refuse_tracers, threads
from refref_jax.geometry import cameras as pinholes
from refref_jax.geometry.cameras import Cameras
from refref_jax.geometry.rays import Rays
from refref_jax.optics import light_paths, path_tracing
from refref_jax.optics.media import Scene
from refref_jax.optics.path_settings import STRAIGHT, PathSettings
from refref_jax.render import backgrounds, images, pixels
from refref_jax.render.backgrounds import Radiance

TILE = 65536
"""Largest number of rays traced at once."""

_INSTEAD = (
    "Call it outside, or use trace or follow_main_branches and shade, which are pure functions."
)

# Number of first rays of a pixel beside the objects, where others are refined: one ray would miss
# edges of the background between pixels, and four cost less than a fifth of a bent one.
_FEWEST_BESIDE = 4

# The squared error of a pixel's mean over stratified rays falls with this power of their number,
# where edges pass through it (Mitchell, Consequences of Stratified Sampling in Graphics, 1996).
_ERROR_FALLS = 1.5

# Largest number of rays for the background of a pixel that is refined to fewer.
_MOST_STRAIGHT = 144


class KnownRendering(NamedTuple):
    """Rendered rays. The leading axes are those of the rays.

    Attributes:
      rgb: sRGB colours in `[0, 1]`.
      linear: linear RGB colours, not clipped.
      paths: number of light paths of each ray.
      dropped: dropped throughput of each ray, because a path buffer was full or truncated paths are
        black.
      casts: total number of closest-hit queries along paths.
    """

    rgb: Float[np.ndarray, "*rays 3"]
    linear: Float[np.ndarray, "*rays 3"]
    paths: Int[np.ndarray, "*rays"]
    dropped: Float[np.ndarray, "*rays 3"]
    casts: int


class KnownImage(NamedTuple):
    """A rendered image: means over the rays of each pixel, weighted where pixels were refined.

    Attributes:
      rgb: sRGB colours in `[0, 1]`.
      linear: linear RGB colours, not clipped.
      rays: number of rays that give each pixel its colour, with those of the background alone.
      dropped: dropped throughput, as in `KnownRendering`, the same mean.
      casts: total number of closest-hit queries, with those of replaced rays.
    """

    rgb: Float[np.ndarray, "h w 3"]
    linear: Float[np.ndarray, "h w 3"]
    rays: Int[np.ndarray, "h w"]
    dropped: Float[np.ndarray, "h w 3"]
    casts: int


class _Tile(NamedTuple):
    """Rendered rays of a tile; fields as in `KnownRendering`."""

    rgb: Float[Array, "rays 3"]
    linear: Float[Array, "rays 3"]
    paths: Int[Array, " rays"]
    dropped: Float[Array, "rays 3"]


def render_known(
    scene: Scene,
    radiance: Radiance,
    rays: Rays,
    *,
    settings: PathSettings,
    interior_list: Int[np.ndarray, "*rays slots"] | None = None,
    tile: int = TILE,
) -> KnownRendering:
    """Renders any number of rays in front of a known background; 0 rays give an empty rendering.

    Rays that meet no object are straight, and are not traced, unless `interior_list` is given.

    Args:
      scene: the scene.
      radiance: function of origin and direction that returns the background's linear RGB.
      rays: camera rays with any leading axes, usually `[height, width]`.
      settings: path settings.
      interior_list: interior list of each ray's origin, where rays carry one (see
        `media.interior_length` and `data.mesh_queries.parts_around`); none by default.
      tile: largest number of rays traced at once. Lower it if memory runs out. The rays of a tile
        share the path buffers: a tile that drops light is rendered again in halves.

    Raises:
      ValueError: if `tile` is less than 1, the radiance function does not return three numbers, or
        the radiance of an opaque part is unknown.
      TypeError: if it is called in a function that JAX transforms; see `shade`.

    Example:
      >>> import trimesh
      >>> import refref_jax
      >>> from refref_jax.render import render_known
      >>> glass = refref_jax.single_object(trimesh.creation.box(), index=1.5)
      >>> camera = refref_jax.orbit(1, distance=4.0, elevation=0.3, size=4, angle_x=0.5)
      >>> rays = refref_jax.image_rays(camera, 0)
      >>> sky = lambda origin, direction: 0.5 + 0.5 * direction
      >>> image = render_known(glass, sky, rays, settings=refref_jax.PATH_PRESETS["straight"])
      >>> image.rgb.shape, image.casts
      ((4, 4, 3), 0)
    """
    return _render(scene, radiance, rays, settings, interior_list, tile)[0]


def _render(
    scene: Scene,
    radiance: Radiance,
    rays: Rays,
    settings: PathSettings,
    interior_list: Int[np.ndarray, "*rays slots"] | None,
    tile: int,
) -> tuple[KnownRendering, Bool[np.ndarray, "*rays"]]:
    """Returns what `render_known` does, and which rays meet an object, if they can bend."""
    if tile < 1:
        raise ValueError(f"tile is {tile}, but a tile needs rays. Give 1 or more.")
    scene, radiance = jax.device_put((scene, _as_argument(radiance)))
    refuse_tracers(scene, instead=_INSTEAD)
    if is_transforming():  # what a function refers to is not among its leaves
        known = jax.make_jaxpr(radiance)(*np.zeros((2, 3), rays.directions.dtype)).consts
        refuse_tracers(known, instead=_INSTEAD)
    render = functools.partial(_in_tiles, scene, radiance, tile=tile)
    if interior_list is not None or settings.max_bends == 0:
        met = np.full(rays.radii.shape, settings.max_bends > 0)
        return render(rays, interior_list, settings=settings), met
    met, hits, misses = images.split_by_hit(scene.surfaces, rays, tile=tile, instead=_INSTEAD)
    bent, straight = render(hits, None, settings=settings), render(misses, None, settings=STRAIGHT)
    pairs = zip(bent[:-1], straight[:-1], strict=True)
    rgb, linear, paths, dropped = (images.merged(met, *each) for each in pairs)
    return KnownRendering(rgb, linear, paths, dropped, bent.casts + misses.radii.size), met


def _in_tiles(
    scene: Scene,
    radiance: Radiance,
    rays: Rays,
    interior_list: Int[np.ndarray, "*rays slots"] | None,
    *,
    settings: PathSettings,
    tile: int,
) -> KnownRendering:
    """Renders rays in as few tiles as keep all threads busy; arguments as in `render_known`."""
    tile, casts = images.size_for(-(-rays.radii.size // threads()), most=tile), []

    def see(rays: Rays, interior_list: Int[np.ndarray, "rays slots"] | None, real: int) -> _Tile:
        seen, count = _render_tile(scene, radiance, rays, interior_list, settings=settings)
        # Each padding ray misses, which counts as one cast if rays are cast at all.
        casts.append(int(fetch(count, instead=_INSTEAD)))
        casts.append((real - tile) * (settings.max_bends > 0))
        return seen

    black = np.zeros((0, 3), np.float32)
    nothing: Any = (black, black, np.zeros(0, np.int32), black)
    seen: Any = images.in_tiles(
        see,
        rays,
        tile=tile,
        nothing=_Tile(*nothing),
        instead=_INSTEAD,
        interior_list=interior_list,
    )
    return KnownRendering(seen.rgb, seen.linear, seen.paths, seen.dropped, sum(casts))


def render_known_camera(
    scene: Scene,
    radiance: Radiance,
    cameras: Cameras,
    view: int,
    *,
    settings: PathSettings,
    rays_per_pixel: int = 4,
    refined_rays_per_pixel: int | None = None,
    tolerance: float = 0.1,
    interior_list: Int[np.ndarray, " slots"] | None = None,
    tile: int = TILE,
) -> KnownImage:
    """Renders one camera's image in front of a known background, with several rays in every pixel.

    With `refined_rays_per_pixel`, a pixel is rendered again with that many rays if one of its rays
    and the eight rays around it, some of them of the next pixels, differ by more than `tolerance`.
    So edges, silhouettes and places where glass shrinks the background get many rays, and smooth
    places few. The first rays keep the weight that their number gives them. A straight ray costs a
    thirtieth of a bent one: pixels beside the objects have at least four first rays, and where a
    refined pixel shows the background past the objects, up to four times as many straight rays
    measure it and its share of the pixel, and replace the first ones; half of those that meet an
    object are bent, too. Where both numbers of rays are equal, only these are added, and pixels
    whose rays all meet an object stay as they are.

    Args:
      scene: the scene.
      radiance: function of origin and direction that returns the background's linear RGB.
      cameras: cameras with the resolution of the image.
      view: index of the camera.
      settings: path settings.
      rays_per_pixel: number of rays in each pixel, a square: 1, 4, 9, 16.
      refined_rays_per_pixel: number of rays in the pixels above the tolerance, a square that is not
        smaller; every pixel has `rays_per_pixel` by default, the background, too.
      tolerance: difference between the largest and the smallest sRGB value in `[0, 1]` of
        neighbouring rays, in the worst channel, up to which a pixel is not refined.
      interior_list: interior list of the camera's position, see `render_known`.
      tile: number of rays traced at once, see `render_known`.

    Raises:
      ValueError: if a number of rays is not a square, the refined number is smaller, the tolerance
        is negative, or `render_known` rejects its arguments.
      TypeError: if it is called in a function that JAX transforms.

    Example:
      >>> import trimesh
      >>> import refref_jax
      >>> from refref_jax.render import render_known_camera
      >>> glass = refref_jax.single_object(trimesh.creation.box(), index=1.5)
      >>> camera = refref_jax.orbit(1, distance=4.0, elevation=0.3, size=8, angle_x=1.2)
      >>> sky = lambda origin, direction: 0.5 + 0.5 * direction
      >>> settings = refref_jax.PATH_PRESETS["tree"]
      >>> image = render_known_camera(
      ...     glass, sky, camera, 0, settings=settings, refined_rays_per_pixel=16
      ... )
      >>> image.rgb.shape, sorted(set(image.rays.ravel().tolist()))
      ((8, 8, 3), [4, 64])
    """
    _check_refinement(rays_per_pixel, refined_rays_per_pixel, tolerance)
    scene, radiance = jax.device_put((scene, _as_argument(radiance)))
    camera = _Camera(scene, radiance, cameras, view, settings, interior_list, tile)
    refines = refined_rays_per_pixel is not None
    image, first = _first_image(camera, rays_per_pixel, _FEWEST_BESIDE if refines else 1)
    if refined_rays_per_pixel is not None:
        again = np.nonzero(_contrast(first.rgb) > tolerance)
        many = refined_rays_per_pixel if refined_rays_per_pixel > rays_per_pixel else None
        image = _refined(camera, image, first, again, many)
    rgb = np.clip(np.asarray(pixels.linear_to_srgb(jax.device_put(image.linear))), 0.0, 1.0)
    return image._replace(rgb=rgb)


def _as_argument(radiance: Radiance) -> Radiance:
    """Returns a radiance function as a pytree: a plain function cannot be an argument of jit."""
    plain = jax.tree_util.all_leaves([radiance])
    return jax.tree_util.Partial(radiance) if plain else radiance


def _check_refinement(count: int, refined: int | None, tolerance: float) -> None:
    for number in (count, refined):
        if number is not None:
            side_of(number)
    if not tolerance >= 0.0:
        raise ValueError(f"tolerance is {tolerance}. Give 0 or more.")
    if refined is not None and not count <= refined:
        raise ValueError(
            f"refined_rays_per_pixel is {refined}, less than rays_per_pixel, {count}. Give a "
            "square that is not smaller, or None."
        )


class _PixelRays(NamedTuple):
    """The rays of pixels, some repeated where a pixel has fewer; fields as in `KnownRendering`.

    Attributes:
      met: whether a ray meets an object.
    """

    rgb: Float[np.ndarray, "*pixels rays 3"]
    linear: Float[np.ndarray, "*pixels rays 3"]
    dropped: Float[np.ndarray, "*pixels rays 3"]
    met: Bool[np.ndarray, "*pixels rays"]


class _Camera(NamedTuple):
    """One camera in front of a scene; attributes are arguments of `render_known_camera`."""

    scene: Scene
    radiance: Radiance
    cameras: Cameras
    view: int
    settings: PathSettings
    interior_list: Int[np.ndarray, " slots"] | None
    tile: int

    def rays(self, row: np.ndarray, column: np.ndarray, count: int) -> Rays:
        """Returns a number of rays of each pixel, along the last axis."""
        return pinholes.rays_of_pixels(self.cameras, self.view, row, column, side=side_of(count))

    def render(self, row: np.ndarray, column: np.ndarray, count: int) -> tuple[_PixelRays, int]:
        """Returns these rays, rendered, and the number of casts."""
        rays, listed = self.rays(row, column, count), self.interior_list
        if listed is not None:
            listed = np.broadcast_to(listed, (*rays.radii.shape, *listed.shape))
        seen, met = _render(self.scene, self.radiance, rays, self.settings, listed, self.tile)
        return _PixelRays(seen.rgb, seen.linear, seen.dropped, met), seen.casts


def _first_image(camera: _Camera, count: int, fewest: int) -> tuple[KnownImage, _PixelRays]:
    """Returns an image that is not encoded yet, and its rays.

    Args:
      camera: camera and the scene that it sees.
      count: number of rays in each pixel.
      fewest: least number of rays in a pixel beside the objects; above 1, `count` must be 1, since
        rays of other pixels are repeated.
    """
    row, column = np.indices((camera.cameras.height, camera.cameras.width))
    first, casts = camera.render(row, column, count)
    rays = np.full(row.shape, count, np.int32)
    if count < fewest:  # a square below four: one
        beside = ~first.met.any(axis=2)
        finer, more = camera.render(row[beside], column[beside], fewest)
        casts, rays[beside] = casts + more, fewest
        first = _PixelRays(*(np.repeat(x, fewest, axis=2) for x in first))
        for values, better in zip(first, finer, strict=True):
            values[beside] = better
    linear, dropped = first.linear.mean(axis=2), first.dropped.mean(axis=2)
    return KnownImage(linear, linear, rays, dropped, casts), first


def _refined(
    camera: _Camera,
    image: KnownImage,
    first: _PixelRays,
    again: tuple[np.ndarray, ...],
    many: int | None,
) -> KnownImage:
    """Refines pixels; the arrays of the image change.

    Args:
      camera: camera and the scene that it sees.
      image: image of few rays in each pixel.
      first: its rays.
      again: rows and columns of the pixels.
      many: number of rays in each pixel that is rendered again; with None, only the background
        gets more.
    """
    few = many or first.met.shape[2]
    straight = max(few, min(4 * few, _MOST_STRAIGHT))
    band, casts = max(1, images.RAYS_OF_A_BAND // straight), image.casts
    for start in range(0, again[0].size, band):
        here = again[0][start : start + band], again[1][start : start + band]
        known = _PixelRays(*(x[here] for x in first))
        if many is not None:
            known, more = camera.render(*here, many)
            share = 1.0 / (1.0 + (image.rays[here] / many) ** _ERROR_FALLS)[:, None]
            for values, finer in (image.linear, known.linear), (image.dropped, known.dropped):
                values[here] = (1.0 - share) * values[here] + share * finer.mean(axis=1)
            image.rays[here] += many
            casts += more
        beside = ~known.met.all(axis=1) & (straight > few)
        here = here[0][beside], here[1][beside]
        known, rays = _PixelRays(*(x[beside] for x in known)), camera.rays(*here, straight)
        image.linear[here], image.dropped[here], more = _with_more_background(camera, rays, known)
        image.rays[here] = straight
        casts += more
    return image._replace(casts=casts)


def _contrast(rgb: Float[np.ndarray, "h w rays 3"]) -> Float[np.ndarray, "h w"]:
    """Returns the largest range of any ray of a pixel and its neighbours, in any channel."""
    height, width, count, _ = rgb.shape
    side = side_of(count)
    fine = rgb.reshape(height, width, side, side, 3).swapaxes(1, 2)
    fine = np.pad(fine.reshape(side * height, side * width, 3), ((1, 1), (1, 1), (0, 0)), "edge")
    high, low = (
        combine(combine(x[:-2], x[1:-1]), x[2:])
        for combine, y in ((np.maximum, fine), (np.minimum, fine))
        for x in [combine(combine(y[:, :-2], y[:, 1:-1]), y[:, 2:])]
    )
    spread = np.max(high - low, axis=-1)
    return spread.reshape(height, side, width, side).max(axis=(1, 3))


def _with_more_background(
    camera: _Camera, rays: Rays, known: _PixelRays
) -> tuple[Float[np.ndarray, "pixels 3"], Float[np.ndarray, "pixels 3"], int]:
    """Returns mean colours and dropped throughput over many rays, and the number of casts.

    Few rays of each pixel are known, and many rendered as straight ones. Those of many that meet an
    object count as straight where none of the few did. Elsewhere every second one is bent, as on a
    checkerboard, and all count as the mean of these and of the few that did in their pixel.

    Source: double sampling for stratification; Neyman, Contribution to the Theory of Sampling Human
    Populations (1938).
    """
    scene, tile, met = camera.scene, camera.tile, known.met
    straight = _in_tiles(scene, camera.radiance, rays, None, settings=STRAIGHT, tile=tile).linear
    hits, edges = np.zeros(rays.radii.shape, bool), met.any(axis=1)
    past = jax.tree.map(lambda x: x[edges], rays)
    hits[edges], _, _ = images.split_by_hit(scene.surfaces, past, tile=tile, instead=_INSTEAD)
    bent = hits & (np.indices((side_of(hits.shape[1]),) * 2).sum(axis=0).ravel() % 2 == 0)
    chosen = jax.tree.map(lambda x: x[bent], rays)
    more = _in_tiles(scene, camera.radiance, chosen, None, settings=camera.settings, tile=tile)
    glass, lost = (np.sum(x, axis=1, where=met[..., None]) for x in (known.linear, known.dropped))
    for total, added in (glass, more.linear), (lost, more.dropped):
        np.add.at(total, np.nonzero(bent)[0], added)
    share = hits.mean(axis=1) / np.maximum(1, met.sum(axis=1) + bent.sum(axis=1))
    share = share.astype(glass.dtype)[:, None]
    beside = np.sum(straight, axis=1, where=~hits[..., None]) / rays.radii.shape[1]
    linear = beside + np.where(share > 0.0, share * glass, 0.0)
    # What the bent ones meet first is known already, and counted once.
    return linear, share * lost, past.radii.size + more.casts - chosen.radii.size


@functools.partial(jit_quickly, static_argnames="settings")
def _render_tile(
    scene: Scene,
    radiance: Radiance,
    rays: Rays,
    interior_list: Int[Array, "rays slots"] | None,
    *,
    settings: PathSettings,
) -> tuple[_Tile, Int[Array, ""]]:
    """Returns rendered rays, and the number of casts."""
    count = rays.radii.shape[0]
    # Behind a rough surface, a ray stands for the facets between it and the pixel's other rays.
    rough = rays.strata is not None and scene.interfaces.alpha.shape[0] > 0
    traced = path_tracing.trace_ends(
        scene,
        rays,
        settings=settings,
        interior_list=interior_list,
        footprint="differential" if rough else "cone",
    )
    ends = traced.ends
    linear = backgrounds.sum_light(radiance, ends, count)
    exists = light_paths.exists(ends).astype(jnp.int32)
    seen = _Tile(
        rgb=jnp.clip(pixels.linear_to_srgb(linear), 0.0, 1.0),
        linear=linear,
        paths=jax.ops.segment_sum(exists, ends.rays, num_segments=count),
        dropped=traced.dropped,
    )
    return seen, traced.casts
