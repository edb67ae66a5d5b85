"""Traces the light paths of batches of rays.

All rays are traced in one wavefront (see `wavefront`); then the paths of each batch are packed into
a list of fixed capacity, in the order of its rays, the heaviest path of each ray first.

Light paths are constants for differentiation: field parameters have gradients along them, but rays
and the scene do not, and differentiating with respect to these is an error (use
`differentiable_paths`).

In a scene with dispersion, each ray is traced three times, for red, green and blue light with its
own indices; the throughput of a path is then 0 in two channels. Other scenes have one trace.

A scene whose surface is a level set has no wavefront: its rays follow their main branches
(`differentiable_paths`), with gradients. The rest of their light is dropped, and counted as such.

Source: paper (arXiv 2505.05848), section 4.2. Symbols as in `light_paths`.
"""

import functools
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from refref_jax.choices import Footprint
from refref_jax.geometry.rays import Rays
from refref_jax.geometry.surfaces import LevelSet
from refref_jax.optics import media, path_settings, path_tree
from refref_jax.optics.differentiable_paths import follow_main_branches
from refref_jax.optics.light_paths import (
    LightPaths,
    PathEnds,
    PathStatus,
    ends_of,
    exists,
    straight,
    straight_ends,
)
from refref_jax.optics.media import Scene, in_one_precision
from refref_jax.optics.path_settings import Detail, PathSettings, capacities
from refref_jax.optics.wavefront import follow

# Largest number of reflections that are followed at a level set.
_MOST_REFLECTIONS = 3


class Traced(NamedTuple):
    """The light paths of one batch of rays.

    Attributes:
      paths: paths in the order of their rays, the heaviest of each ray first; empty slots last.
      dropped: dropped throughput of each ray, linear RGB, because a buffer was full or truncated
        paths are black. The throughput of a ray's paths and its dropped throughput sum to 1, minus
        absorption by tints and media.
    """

    paths: LightPaths
    dropped: Float[Array, "rays 3"]


class TracedEnds(NamedTuple):
    """The last segments of the light paths of some rays.

    Attributes:
      ends: last segment of each path.
      dropped: dropped throughput of each ray, as in `Traced`.
      casts: number of rays that were cast.
    """

    ends: PathEnds
    dropped: Float[Array, "rays 3"]
    casts: Int[Array, ""]


_Traced = TypeVar("_Traced", Traced, TracedEnds)


class Survey(NamedTuple):
    """Path statistics of a scene.

    Attributes:
      mean: mean number of paths per ray.
      deviation: standard deviation of the number of paths over rays.
      hit_fraction: fraction of rays that hit a surface.
    """

    mean: Float[Array, ""]
    deviation: Float[Array, ""]
    hit_fraction: Float[Array, ""]


def trace_ends(
    scene: Scene,
    rays: Rays,
    *,
    settings: PathSettings,
    interior_list: Int[Array, "rays slots"] | None = None,
    footprint: Footprint = "cone",
    block: int | None = None,
) -> TracedEnds:
    """Traces rays, and returns only the last segments of their paths.

    Args:
      scene: the scene.
      rays: camera rays.
      settings: path settings.
      interior_list: interior list of each camera, where rays carry one (see
        `media.interior_length` and `data.mesh_queries.parts_around`); none by default.
      footprint: `differential` carries derivatives across the pixel.
      block: number of rays cast at once; by default what suits the platform.
    """
    scene, rays = in_one_precision(scene, rays)
    if _needs_no_tracing(rays, settings):
        lines = straight_ends(rays, footprint=footprint)
        return TracedEnds(lines, jnp.zeros_like(rays.origins), jnp.zeros((), jnp.int32))
    if isinstance(scene.surfaces, LevelSet):
        paths, lost = trace_level_set(scene, rays, settings=settings, footprint=footprint)
        casts = rays.radii.size * (settings.max_bends + 1)
        return TracedEnds(ends_of(paths), lost, jnp.int32(casts))
    interior_list = _inside(scene, rays, interior_list)
    times = _traces(scene)
    if times > 1:
        rays, interior_list = jax.tree.map(
            lambda x: jnp.repeat(x, times, axis=0), (rays, interior_list)
        )
    tree = follow(
        scene,
        rays,
        interior_list,
        settings=settings,
        footprint=footprint,
        block=block,
        segments="last",
    )
    ends = path_tree.listed(tree, capacities(settings, rays.radii.shape[0]).paths)
    last = path_tree.last_segments(tree.segments.items, ends)
    traced = TracedEnds(last, tree.dropped, tree.casts)
    return traced if times == 1 else _of_one_ray(traced, times)


def trace(
    scene: Scene,
    rays: Rays,
    *,
    settings: PathSettings,
    capacity: int | None = None,
    detail: Detail | None = None,
    interior_list: Int[Array, "rays slots"] | None = None,
) -> Traced:
    """Traces one batch of rays: a pure function, to be jitted and mapped by the caller.

    Args:
      scene: the scene.
      rays: camera rays.
      settings: path settings.
      capacity: capacity for paths; by default that of the path settings for this number of rays,
        which is more than most scenes need, see `path_settings.capacity_for`. Unused if max bends
        is 0 or there are no rays.
      detail: parts of the paths to store; by default every segment, and nothing else.
      interior_list: interior list of each camera, as in `trace_ends`.

    Example:
      Light that hits a glass surface head-on: 4 % is reflected, the rest is transmitted.

      >>> import functools
      >>> import jax, numpy as np, trimesh
      >>> import refref_jax
      >>> glass = refref_jax.single_object(trimesh.creation.box(), index=1.5)
      >>> towards = np.array([[1.0, 0.0, 0.0]])
      >>> rays = refref_jax.Rays(np.array([[-2.0, 0.1, 0.2]]), towards, np.full(1, 1e-3))
      >>> settings = refref_jax.PathSettings(max_bends=1, reflections="all")
      >>> trace = jax.jit(functools.partial(refref_jax.trace, settings=settings))
      >>> paths = trace(glass, rays).paths  # each ray's heaviest path first
      >>> print(np.round(paths.throughput[:2, 0], 2), paths.num_bends[:2], paths.tau[0, :2])
      [0.96 0.04] [1 1] [0.  1.5]
    """
    batch = jax.tree.map(lambda x: x[None], rays)
    if interior_list is not None:
        interior_list = interior_list[None]
    traced = trace_batches(
        scene,
        batch,
        settings=settings,
        capacity=capacity,
        detail=detail,
        interior_list=interior_list,
    )
    return jax.tree.map(lambda x: x[0], traced)


def trace_batches(
    scene: Scene,
    rays: Rays,
    *,
    settings: PathSettings,
    capacity: int | None = None,
    detail: Detail | None = None,
    interior_list: Int[Array, "batches rays slots"] | None = None,
) -> Traced:
    """Traces many batches in one wavefront, which amortises the latency of the traversal loop.

    Args:
      scene: the scene.
      rays: camera rays `[batches, rays]`.
      settings: path settings.
      capacity: capacity for the paths of each batch, as in `trace`.
      detail: parts of the paths to store, as in `trace`.
      interior_list: interior list of each camera, as in `trace_ends`.

    Returns:
      The paths of each batch, stacked; ray indices count within a batch.
    """
    scene, rays = in_one_precision(scene, rays)
    if _needs_no_tracing(rays, settings):
        return jax.vmap(lambda batch: Traced(straight(batch), jnp.zeros_like(batch.origins)))(rays)
    if isinstance(scene.surfaces, LevelSet):
        carried = detail.footprint if detail else "cone"
        return jax.vmap(
            lambda batch: trace_level_set(scene, batch, settings=settings, footprint=carried)
        )(rays)
    (batches, count), times = rays.radii.shape, _traces(scene)
    count *= times
    capacity = capacities(settings, count).paths if capacity is None else capacity
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rays)
    if interior_list is not None:
        interior_list = interior_list.reshape(rays.radii.size, interior_list.shape[-1])
    detail = detail or path_settings.everything(settings.max_bends)
    interior_list = _inside(scene, flat, interior_list)
    if times > 1:
        flat, interior_list = jax.tree.map(
            lambda x: jnp.repeat(x, times, axis=0), (flat, interior_list)
        )
    tree = follow(scene, flat, interior_list, settings=settings, footprint=detail.footprint)
    ends, dropped = path_tree.pack(tree, batches, count, capacity)
    paths = path_tree.polylines(
        tree.segments.items,
        ends,
        flat.radii[ends.rays],
        detail=detail,
        parts=scene.interfaces.index_inside.shape[0],
    )
    paths = jax.tree.map(lambda x: x.reshape(batches, capacity, *x.shape[1:]), paths)
    traced = Traced(paths._replace(rays=paths.rays % count), dropped.reshape(batches, count, 3))
    return traced if times == 1 else _of_one_ray(traced, times)


def branches_of(settings: PathSettings) -> int:
    """Returns the number of paths of a ray in a scene whose surface is a level set."""
    most = {"none": 0, "first": 1, "all": _MOST_REFLECTIONS}[settings.reflections]
    return 1 + min(most, settings.max_bends)


def trace_level_set(
    scene: Scene, rays: Rays, *, settings: PathSettings, footprint: Footprint = "cone"
) -> Traced:
    """Traces a batch of rays along their main branches, with gradients.

    Args:
      scene: scene whose surface is a level set.
      rays: camera rays.
      settings: path settings.
      footprint: `differential` carries derivatives across the pixel.

    Returns:
      `branches_of(settings)` paths of each ray, with all segments; those that do not exist are
      empty.
    """
    count, branches = rays.radii.shape[0], branches_of(settings)
    follow = functools.partial(
        follow_main_branches,
        scene,
        settings=settings,
        reflections=branches - 1,
        footprint=footprint,
    )
    paths = jax.tree.map(
        lambda x: x.reshape(count * branches, *x.shape[2:]), jax.vmap(follow)(rays)
    )
    paths = paths._replace(rays=jnp.repeat(jnp.arange(count, dtype=jnp.int32), branches))
    total = jnp.sum(paths.throughput.reshape(count, branches, 3), axis=1)
    return Traced(paths, jnp.maximum(1.0 - total, 0.0))


def survey(scene: Scene, rays: Rays, *, settings: PathSettings) -> Survey:
    """Measures the path statistics that determine the capacity for batches of rays."""
    count = rays.radii.shape[0]
    ends = trace_ends(scene, rays, settings=settings).ends
    one = exists(ends).astype(jnp.float32)
    paths = jax.ops.segment_sum(one, ends.rays, num_segments=count)
    untraced = (ends.statuses == PathStatus.NOT_TRACED) & (ends.num_bends == 0)
    missing = jnp.sum((ends.statuses == PathStatus.MISSED) | untraced, dtype=jnp.float32)
    traced = count if _needs_no_tracing(rays, settings) else count * _traces(scene)
    return Survey(jnp.mean(paths), jnp.std(paths), 1.0 - missing / traced)


def _traces(scene: Scene) -> int:
    """Returns how often each ray is traced: once for each colour channel with dispersion."""
    return 3 if media.has_dispersion(scene.interfaces) else 1


def _of_one_ray(traced: _Traced, times: int) -> _Traced:
    """Returns traced paths with the indices of rays before they were repeated."""
    paths: Any = traced[0]
    shape = (*traced.dropped.shape[:-2], -1, times, traced.dropped.shape[-1])
    dropped = jnp.sum(traced.dropped.reshape(shape), axis=-2)
    return type(traced)(paths._replace(rays=paths.rays // times), dropped, *traced[2:])


def _needs_no_tracing(rays: Rays, settings: PathSettings) -> bool:
    return settings.max_bends == 0 or rays.radii.size == 0


def _inside(
    scene: Scene, rays: Rays, interior_list: Int[Array, "rays slots"] | None
) -> Int[Array, "rays slots"]:
    if interior_list is not None:
        return interior_list
    nowhere = media.empty_interior_list(scene.interfaces)
    return jnp.broadcast_to(nowhere, (rays.radii.shape[0], nowhere.shape[0]))
