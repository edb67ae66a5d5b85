"""Colours of pixels from the light paths of a batch.

Paths are rendered in parallel; the colour of a pixel is the weighted sum over its paths in linear
RGB (paper, arXiv 2505.05848, Fresnel blend), and is converted to sRGB at the end, by the transfer
function of IEC 61966-2-1.

`render_ray` renders one ray, from pixel to colour: the whole method on one page, written to be
read. `render_image` and training compute the same for many rays at once, compiled; a test compares
them (`tests/render/test_one_ray.py`). Its symbols are those of the paper (section 4): a light path
is `r(t) = p_i + (t - tau_i) d_i`; interval `i` of its samples has density `sigma_i`, colour `c_i`
and length `delta_i`, and `T_i = exp(-sum_{j<i} sigma_j delta_j)` is its transmittance. `s` in
`[0, 1]` is the normalised coordinate in which samples are drawn (Zip-NeRF, section 4); `x` are
multisamples of intervals.
"""

import functools
from collections.abc import Iterator
from typing import NamedTuple, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from refref_jax.fields import registry
from refref_jax.fields.base import Radiance
from refref_jax.geometry.cameras import Cameras, image_rays
from refref_jax.geometry.rays import Rays
from refref_jax.numerics import host_array
from refref_jax.optics import light_paths, path_tracing
from refref_jax.optics.light_paths import Branch, LightPaths, PathEnds, PathStatus, reflected_first
from refref_jax.optics.media import Scene
from refref_jax.optics.path_settings import Detail, PathSettings, Tally
from refref_jax.optics.path_tracing import Traced
from refref_jax.render import backdrop, learned_media, volume_rendering
from refref_jax.render.backdrop import Lookups
from refref_jax.render.model import (
    Model,
    ModelConfig,
    Params,
    Rendering,
    has_foreground,
    path_detail,
    surface_of,
)
from refref_jax.render.volume_rendering import Composite, Histogram, Jitter, PathRadiance
from refref_jax.sampling import scene_bounds
from refref_jax.sampling.scene_bounds import Domain

# Thresholds between the linear and the power segment of the transfer function.
_LINEAR_KNEE = 0.0031308
_SRGB_KNEE = 0.04045

BRANCHES: tuple[Branch, ...] = get_args(Branch)
"""Selections of paths by their branch at the first surface; `ALL` is the index of the first."""
ALL, _TRANSMITTED, _REFLECTED = range(len(BRANCHES))


class Light(NamedTuple):
    """The linear colours of a batch of rays, or the contribution of some of its paths.

    Attributes:
      linear: linear RGB colours.
      paths: radiance of each path, for the losses.
    """

    linear: Float[Array, "rays 3"]
    paths: PathRadiance


class Pixels(NamedTuple):
    """A batch of rendered rays.

    Attributes:
      rgb: sRGB colours, not clipped.
      paths: radiance of each path, for the losses.
    """

    rgb: Float[Array, "rays 3"]
    paths: PathRadiance


def render_pixels(
    params: Params,
    config: ModelConfig,
    paths: LightPaths,
    jitter: Jitter,
    *,
    rays: int,
    anneal: Float[Array, ""],
) -> Pixels:
    """Renders a batch of rays from all of their paths.

    Args:
      params: parameters of the model.
      config: configuration of the model.
      paths: light paths, in any order.
      jitter: jitter of each path.
      rays: number of rays in the batch.
      anneal: exponent on the proposals' weights, see `volume_rendering.path_radiance`.
    """
    light = gather_light(params, config, paths, jitter, rays=rays, anneal=anneal)
    return Pixels(linear_to_srgb(light.linear), light.paths)


def gather_light(
    params: Params,
    config: ModelConfig,
    paths: LightPaths,
    jitter: Jitter,
    *,
    rays: int,
    anneal: Float[Array, ""],
    progress: Float[Array, ""] | None = None,
) -> Light:
    """Sums the contributions of paths to their rays.

    Arguments are those of `render_pixels`, and the progress of `volume_rendering.path_radiance`.
    """
    seen = render_paths(params, config, paths, jitter, anneal=anneal, progress=progress)
    paths = learned_media.attenuate(params.tints, paths, radius=config.radius)
    linear = jax.ops.segment_sum(
        paths.throughput * seen.composite.rgb, paths.rays, num_segments=rays
    )
    return Light(linear, seen)


def render_paths(
    params: Params,
    config: ModelConfig,
    paths: LightPaths,
    jitter: Jitter,
    *,
    anneal: Float[Array, ""],
    progress: Float[Array, ""] | None = None,
) -> PathRadiance:
    """Renders each path of a batch independently; arguments as in `path_radiance`."""
    if config.backdrop is not None:
        seen = _see_backdrop(params, config, paths)
        if not has_foreground(config):
            return PathRadiance(seen, (), jnp.ones((paths.radii.shape[0], 0), bool))
        render = jax.vmap(volume_rendering.foreground_radiance, in_axes=(None, None, 0, 0, None))
        front = render(params, config, paths, jitter, anneal)
        behind = jax.vmap(volume_rendering.in_front_of)(front.composite, seen.rgb, seen.mean)
        return front._replace(composite=behind)
    one = functools.partial(volume_rendering.path_radiance, progress=progress)
    return jax.vmap(one, in_axes=(None, None, 0, 0, None))(params, config, paths, jitter, anneal)


def _see_backdrop(params: Params, config: ModelConfig, paths: LightPaths) -> Composite:
    """Returns what each path sees of the backdrop, at the distance where it ends there."""
    assert config.backdrop is not None
    ends, bounds = light_paths.ends_of(paths), config.domain
    resolution, count = config.backdrop.resolution, paths.radii.shape[0]
    alone = ends._replace(throughput=jnp.ones_like(ends.throughput))
    lookups = backdrop.locate(
        bounds,
        alone,
        jnp.arange(count, dtype=jnp.int32),
        resolution=resolution,
        most_taps=config.backdrop.most_taps,
        axes=config.backdrop.axes,
    )
    surface = surface_of(params)
    if has_foreground(config):  # only the field in front of it is trained
        surface = jax.lax.stop_gradient(surface)
    mips = backdrop.mipmap(surface, config.space)
    distance = _up_to_bounds(bounds, ends)
    return Composite(
        rgb=backdrop.radiance(mips, lookups),
        accumulation=jnp.ones_like(paths.radii),
        median=distance,
        mean=distance,
    )


def _up_to_bounds(domain: Domain, ends: PathEnds) -> Float[Array, " paths"]:
    """Returns the arc length of paths from the camera to the scene bounds."""
    leave = jax.vmap(functools.partial(scene_bounds.exit_distance, domain))
    return ends.tau + leave(ends.origins, ends.directions)


class TilePaths(NamedTuple):
    """The paths of a tile, with the selected paths first.

    Attributes:
      paths: light paths.
      heaviest: whether a path is the heaviest of its ray.
      count: number of selected paths.
      dropped: dropped throughput of each ray.
    """

    paths: LightPaths
    heaviest: Bool[Array, " paths"]
    count: Int[Array, ""]  # type: ignore[assignment]  # hides tuple.count
    dropped: Float[Array, "rays 3"]


def render_rays(model: Model, rays: Rays) -> Rendering:
    """Renders rays in one piece: a pure function, to be jitted or differentiated by the caller.

    A trained model is in single precision, and so are its renderings.

    Args:
      model: trained model.
      rays: camera rays `[n]`. They share the path buffers, so with few rays, throughput is dropped
        sooner.
    """
    rays = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), rays)
    detail = path_detail(model.config, model.settings)
    traced = path_tracing.trace(model.scene, rays, settings=model.settings, detail=detail)
    tile, sums = sort_paths(traced, traced.dropped.shape[0]), blank(traced.dropped)
    return finish(add_paths(model.params, tile.paths, tile.heaviest, sums, config=model.config))


def blank(dropped: Float[Array, "rays 3"]) -> Rendering:
    """Returns the initial rendering, before any path is added."""
    black = jnp.zeros_like(dropped)
    zeros = black[:, 0]
    return Rendering(black, zeros, zeros, zeros, linear=black, dropped=dropped)


def sort_paths(
    traced: Traced, real: int | Int[Array, ""], *, which: int | Int[Array, ""] = ALL
) -> TilePaths:
    """Moves the selected paths to the front and marks the heaviest path of each ray.

    Args:
      traced: traced paths of a tile.
      real: number of rays in the tile that are not padding.
      which: index of the selected branch in `BRANCHES`.
    """
    paths, rays = traced.paths, traced.dropped.shape[0]
    branch = jnp.where(reflected_first(paths), _REFLECTED, _TRANSMITTED)
    exists = light_paths.exists(paths) & (paths.rays < real)
    exists &= (which == ALL) | (which == branch)
    order = jnp.argsort(~exists, stable=True)
    share = jnp.mean(paths.throughput, axis=-1)
    heaviest = light_paths.heaviest(share, paths.rays, exists, rays=rays)
    sorted_paths = jax.tree.map(lambda x: x[order], paths)
    return TilePaths(sorted_paths, heaviest[order], jnp.sum(exists), traced.dropped)


def add_paths(
    params: Params,
    paths: LightPaths,
    heaviest: Bool[Array, " paths"],
    sums: Rendering,
    *,
    config: ModelConfig,
) -> Rendering:
    """Adds some paths to the linear colours and distances of their rays."""
    jitter = no_jitter(config, paths.radii.shape[0])
    one = jnp.ones((), paths.radii.dtype)
    seen = render_paths(params, config, paths, jitter, anneal=one).composite
    paths = learned_media.attenuate(params.tints, paths, radius=config.radius)
    share = jnp.mean(paths.throughput, axis=-1)
    rays = sums.distance.shape[0]
    # Writes to an index past the end are dropped.
    target = jnp.where(heaviest, paths.rays, rays)
    return sums._replace(
        linear=sums.linear.at[paths.rays].add(paths.throughput * seen.rgb),
        distance=sums.distance.at[target].set(seen.median, mode="drop"),
        mean_distance=sums.mean_distance.at[target].set(seen.mean, mode="drop"),
        accumulation=sums.accumulation.at[paths.rays].add(share * seen.accumulation),
    )


def finish(sums: Rendering) -> Rendering:
    """Returns a rendering whose linear colours are complete, with their sRGB."""
    return sums._replace(rgb=jnp.clip(linear_to_srgb(sums.linear), 0.0, 1.0))


class BackdropEnds(NamedTuple):
    """Where the light paths of rays end on a backdrop.

    Attributes:
      lookups: points of the backdrop; their pixels are the indices of the rays.
      crossings: hits and lengths per part, for learned tints (`learned_media.crossings`).
      hidden: whether a path meets something in front of the backdrop.
      distances: arc length of each path up to the backdrop, world units; 0 in empty slots.
    """

    lookups: Lookups
    crossings: Float[Array, "paths unknowns"]
    hidden: Bool[Array, " paths"]
    distances: Float[Array, " paths"]


def backdrop_ends(
    scene: Scene,
    rays: Rays,
    *,
    settings: PathSettings,
    domain: Domain,
    resolution: int,
    most_taps: int,
    axes: int,
    tally: Tally,
    fields: tuple[int, ...],
    faint: float | Float[Array, ""],
) -> tuple[BackdropEnds, Float[Array, "rays 3"]]:
    """Traces rays up to a backdrop.

    Args:
      scene: the scene.
      rays: camera rays.
      settings: path settings.
      domain: scene bounds; their `space` is the kind of the backdrop.
      resolution: number of cells per side of a face.
      most_taps: largest number of taps along each axis of a ray's footprint.
      axes: number of axes of the direction that the radiance depends on, 0 or 3.
      tally: `parts` if tints and absorption are learned.
      fields: parts whose inside is a field, which hides what is behind it.
      faint: throughput below which a path has only one tap (`backdrop.locate`).

    Returns:
      The ends of the light paths, and the dropped throughput of each ray.
    """
    parts = scene.interfaces.index_inside.shape[0]
    unknowns = 2 * parts if tally == "parts" else 0
    if (unknowns or fields) and settings.max_bends:
        # The first and the last segment are the fewest that can be stored.
        detail = Detail("outside", 2, "differential", "parts")
        traced = path_tracing.trace(scene, rays, settings=settings, detail=detail)
        paths, ends = traced.paths, light_paths.ends_of(traced.paths)
        crossings = learned_media.crossings(paths, radius=domain.radius)[:, :unknowns]
        hidden = jnp.any(paths.path_lengths[:, jnp.asarray(fields, jnp.int32)] > 0.0, axis=1)
        dropped = traced.dropped
    else:
        found = path_tracing.trace_ends(scene, rays, settings=settings, footprint="differential")
        ends, dropped = found.ends, found.dropped
        crossings = jnp.zeros((ends.rays.shape[0], unknowns), ends.tau.dtype)
        hidden = jnp.zeros(ends.rays.shape, bool)
    if ends.stop is not None:
        hidden |= jnp.isfinite(ends.stop.tau)
    exists = light_paths.exists(ends)
    ends = ends._replace(throughput=jnp.where(exists[:, None], ends.throughput, 0.0))
    locate = functools.partial(backdrop.locate, resolution=resolution, most_taps=most_taps)
    lookups = locate(domain, ends, ends.rays, axes=axes, faint=faint)
    distances = jnp.where(exists, _up_to_bounds(domain, ends), 0.0)
    return BackdropEnds(lookups, crossings, hidden, distances), dropped


def random_jitter(key: Array, config: ModelConfig, slots: Int[Array, " paths"]) -> Jitter:
    """Draws one offset and one rotation for every sampling level of every path.

    The noise of each slot depends only on the key and its index, so it is the same if the list is
    longer or is split among devices.

    Args:
      key: random key of the batch.
      config: configuration of the model.
      slots: index of each path in the batch's list.
    """
    shape = (2, volume_rendering.levels(config))
    draw = jax.vmap(lambda slot: jax.random.uniform(jax.random.fold_in(key, slot), shape))
    drawn = draw(slots)
    return Jitter(drawn[:, 0] - 0.5, 2.0 * jnp.pi * drawn[:, 1])


def no_jitter(config: ModelConfig, paths: int) -> Jitter:
    """Returns zero jitter, for rendering without noise, in single precision like the fields."""
    zeros = jnp.zeros((paths, volume_rendering.levels(config)), jnp.float32)
    return Jitter(zeros, zeros)


def linear_to_srgb(linear: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Applies the sRGB opto-electronic transfer function; 0 maps to 0 and 1 to 1.

    Negative values use the linear segment and values above 1 the power segment, so that neither
    value nor gradient is clipped. The gradient is finite everywhere: 12.92 at and below 0.

    Source: IEC 61966-2-1.
    """
    curved = linear > _LINEAR_KNEE
    power = jnp.where(curved, linear, 1.0) ** (1.0 / 2.4)
    return jnp.where(curved, 1.055 * power - 0.055, 12.92 * linear)


def srgb_to_linear(srgb: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Inverts `linear_to_srgb`."""
    curved = srgb > _SRGB_KNEE
    power = ((jnp.where(curved, srgb, 1.0) + 0.055) / 1.055) ** 2.4
    return jnp.where(curved, power, srgb / 12.92)


def render_splats(model: Model, cameras: Cameras, view: int, *, side: int = 1) -> Rendering:
    """Renders Gaussian splats from a camera, as NumPy arrays `[height, width]`.

    Where they stay transparent, distances are those of the scene bounds or the far plane.

    Args:
      model: model with Gaussian splats.
      cameras: cameras with the resolution of the image.
      view: index of the camera.
      side: number of pixels of the image along each edge of those that it will be averaged to.

    Raises:
      ValueError: if there are several, but splats of kind `classic` are wider in larger pixels.
    """
    from refref_jax.splats import images  # costs nothing without splats

    config = model.config
    assert config.splats is not None
    if side > 1 and config.splats.kernel == "classic":
        raise ValueError(
            "Splats with splat_filter=classic are thinner in smaller pixels, so that several rays "
            "per pixel would show others than were trained. Use 1 ray per pixel."
        )
    rays = jax.device_put(image_rays(cameras, view))
    exits = jax.vmap(functools.partial(scene_bounds.exit_distance, config.domain))
    flat = exits(rays.origins.reshape(-1, 3), rays.directions.reshape(-1, 3))
    beyond = jax.device_get(jnp.where(jnp.isfinite(flat), flat, config.far))
    beyond = beyond.reshape(rays.radii.shape)
    kernel = config.splats.kernel
    seen = images.render(model.params.field, cameras, view, kernel=kernel, beyond=beyond)
    linear = jax.device_get(srgb_to_linear(jnp.asarray(seen.rgb)))
    return Rendering(
        rgb=jax.device_get(jnp.clip(seen.rgb, 0.0, 1.0)),
        distance=host_array(seen.distance),
        mean_distance=host_array(seen.mean_distance),
        accumulation=host_array(seen.accumulation),
        linear=linear,
        dropped=jax.device_get(jnp.zeros_like(linear)),
    )


def render_ray(model: Model, ray: Rays) -> Float[Array, "3"]:
    """Returns the sRGB colour of one camera ray, not clipped; runs uncompiled, in seconds.

    Args:
      model: fields, scene and path settings.
      ray: one camera ray, without leading axes.

    Raises:
      ValueError: if the model has a backdrop instead of fields, or its field has sub-spaces, a
        surface or a deformation.
    """
    config, params = model.config, model.params
    if config.backdrop is not None:
        raise ValueError("This page shows fields, but the model has a backdrop. Use render_rays.")
    others = registry.has_sub_spaces, registry.has_surface, registry.has_deformation
    if any(has(config.field) for has in others):
        raise ValueError(
            f"This page shows fields with density and one colour at a point, but the field is of "
            f"kind {config.field.kind}. Use render_rays."
        )
    density = jax.vmap(registry.density, in_axes=(None, None, 0))
    radiance = jax.vmap(registry.radiance, in_axes=(None, None, 0, 0))
    middle = functools.partial(
        volume_rendering.sample, jitter=Jitter(jnp.zeros(()), jnp.zeros(())), anneal=jnp.ones(())
    )
    colour = jnp.zeros(3)

    # Trace: Snell's law, total internal reflection and Fresnel's equations at every surface.
    for path in _light_paths(model, ray):
        r = volume_rendering.polyline(config, path)
        warp = volume_rendering.distance_warp(config, r)

        # Sample: each proposal level draws from the histogram of the level before.
        draw = functools.partial(middle, config, r, warp)
        histograms: list[Histogram] = []
        for proposal, learned in zip(config.proposals, params.proposals, strict=True):
            s, t, x, *_ = draw(histograms, proposal.samples)
            sigma = density(learned, proposal.field, x)
            histograms.append(Histogram(s, _weights(sigma, jnp.diff(t) / config.radius)))

        # Query: density and colour of the multisamples, seen along the local direction.
        s, t, x, points, _ = draw(histograms, config.samples)
        seen = radiance(params.field, config.field, x, points.direction)
        assert isinstance(seen, Radiance)
        sigma, c = seen

        # Composite: the volume rendering integral along the path.
        w = _weights(sigma, jnp.diff(t) / config.radius)
        # Combine: the weight of a path is the product of its Fresnel factors and tints.
        colour += path.throughput * jnp.sum(w[:, None] * c, axis=0)

    # Encode: radiance adds up linearly, images are sRGB.
    return linear_to_srgb(colour)


def _light_paths(model: Model, ray: Rays) -> Iterator[LightPaths]:
    """Yields the light paths of one ray, the heaviest first."""
    batch = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32)[None], ray)
    detail = path_detail(model.config, model.settings)
    paths = path_tracing.trace(model.scene, batch, settings=model.settings, detail=detail).paths
    paths = learned_media.attenuate(model.params.tints, paths, radius=model.config.radius)
    for i, status in enumerate(paths.statuses):
        if status != PathStatus.EMPTY:
            yield jax.tree.map(lambda x, i=i: x[i], paths)


def _weights(
    sigma: Float[Array, " samples"], delta: Float[Array, " samples"]
) -> Float[Array, " samples"]:
    """Returns `w_i = T_i (1 - exp(-sigma_i delta_i))`; the last interval is opaque."""
    depth = jnp.concatenate([jnp.zeros(1), jnp.cumsum(sigma * delta)])
    w = jnp.exp(-depth[:-1]) * (1.0 - jnp.exp(-sigma * delta))
    return w.at[-1].set(1.0 - jnp.sum(w[:-1]))
