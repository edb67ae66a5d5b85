"""Follows rays through the interfaces of a scene (the wavefront: all rays together).

A *budget* says which light is worth following. The paper's oracle follows one path of at most 10
bends, refracted wherever it can be and totally reflected elsewhere, and one reflection at the
first surface, which it does not trace any further. A plain NeRF follows no bend at all.

Tracing has two halves. `follow` walks any number of rays along their refracted paths, so it can
be called on a large pool. `pack` then gathers, per batch, those paths and the reflections worth
keeping into one list of fixed capacity: rays that miss the objects have no reflection and take
no room for one.

Source: paper, section 4.2. Letters as in `light_paths`.
"""

import dataclasses
import math
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from refref_jax import numerics
from refref_jax.geometry import bvh, surfaces
from refref_jax.geometry.rays import Rays
from refref_jax.optics import interaction
from refref_jax.optics.light_paths import LightPaths, PathStatus, straight
from refref_jax.optics.media import AMBIENT, Interfaces


@dataclasses.dataclass(frozen=True)
class Budget:
    """Which light to follow.

    Attributes:
      bends: most refractions and total reflections of a path.
      reflections: `first` adds the reflection at the first surface.
    """

    bends: int
    reflections: Literal["none", "first"]


STRAIGHT = Budget(bends=0, reflections="none")
PAPER = Budget(bends=10, reflections="first")

BUDGETS = {"straight": STRAIGHT, "paper": PAPER}


class Geometry(NamedTuple):
    """All that light meets: surfaces, and the interfaces that they stand for."""

    surfaces: surfaces.Surfaces
    interfaces: Interfaces


class Traced(NamedTuple):
    """Light paths of a batch of rays.

    Attributes:
      paths: the paths.
      dropped: the share of each ray's light that found no room in the list. Its refracted path
        carries it instead, so that weights still sum to 1.
    """

    paths: LightPaths
    dropped: Float[Array, " rays"]


class Followed(NamedTuple):
    """The refracted path of each ray, and what its first surface did.

    Attributes:
      paths: one path a ray, with full weight.
      hit: whether the ray met a surface.
      first: the first interaction, without meaning for rays that met nothing.
    """

    paths: LightPaths
    hit: Bool[Array, " rays"]
    first: interaction.Interaction


class _Walk(NamedTuple):
    """State of the loop: one live ray a path, and the record of where it has been.

    Attributes:
      bend: number of bends already made by the rays that are still inside.
      direction: current direction.
      position: start of the current segment.
      tau: arc length there.
      hits: what each ray meets next; a finite distance means that it is still alive.
      points, directions, taus, media: the record, segment by segment.
    """

    bend: Int[Array, ""]
    direction: Float[Array, "rays 3"]
    position: Float[Array, "rays 3"]
    tau: Float[Array, " rays"]
    hits: bvh.Hits
    points: Float[Array, "segments rays 3"]
    directions: Float[Array, "segments rays 3"]
    taus: Float[Array, "segments rays"]
    media: Int[Array, "segments rays"]


def trace(geometry: Geometry, rays: Rays, *, budget: Budget, capacity: int) -> Traced:
    """Traces one batch of rays.

    Args:
      geometry: the scene.
      rays: camera rays, outside every body.
      budget: which light to follow.
      capacity: room for reflections, at most the number of rays; see `capacity_for`.
    """
    batch = jax.tree.map(lambda x: x[None], rays)
    traced = trace_batches(geometry, batch, budget=budget, capacity=capacity)
    return jax.tree.map(lambda x: x[0], traced)


def trace_batches(geometry: Geometry, rays: Rays, *, budget: Budget, capacity: int) -> Traced:
    """Traces many batches in one pool, which amortises the latency of the traversal's loop.

    Args:
      geometry: the scene.
      rays: camera rays `[batches, rays]`, outside every body.
      budget: which light to follow.
      capacity: room for reflections in each batch, at most its number of rays.

    Returns:
      The paths of each batch, stacked; `rays` counts within a batch.
    """
    if budget.bends == 0:
        return jax.vmap(lambda batch: Traced(straight(batch), jnp.zeros_like(batch.radii)))(rays)
    shape = rays.radii.shape
    pool = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rays)
    followed = follow(geometry, pool, bends=budget.bends)
    batches = jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), followed)
    return jax.vmap(lambda batch: pack(batch, budget=budget, capacity=capacity))(batches)


def capacity_for(budget: Budget, rays: int, hit_fraction: float) -> int:
    """Returns a room for reflections that batches of a scene practically never outgrow.

    Six standard deviations above the mean number of hits in a random batch, rounded up to 64.

    Args:
      budget: which light to follow.
      rays: rays in a batch.
      hit_fraction: share of the scene's camera rays that meet a surface.
    """
    if budget.reflections == "none":
        return 0
    spread = math.sqrt(rays * hit_fraction * (1.0 - hit_fraction))
    needed = rays * hit_fraction + 6.0 * spread
    return min(rays, 64 * math.ceil(needed / 64))


def follow(geometry: Geometry, rays: Rays, *, bends: int) -> Followed:
    """Follows each ray through at most `bends` refractions and total reflections.

    Args:
      geometry: the scene.
      rays: any number of camera rays.
      bends: most bends; a path that would need more goes on along its last direction and says
        so in its status.
    """
    start = _begin(geometry, rays, bends)
    first = _meet(geometry, start)

    def more(walk: _Walk) -> Bool[Array, ""]:
        return (walk.bend < bends) & jnp.any(_alive(walk))

    walk = jax.lax.while_loop(more, lambda walk: _advance(geometry, walk), start)
    return Followed(_record(rays, walk), _alive(start), first)


def pack(followed: Followed, *, budget: Budget, capacity: int) -> Traced:
    """Joins refracted paths and first reflections of a batch into one list.

    The list holds the refracted paths first, in the order of the rays, then `capacity` slots
    for reflections, the strongest first. Weights are `1 - R` and `R` (paper, Fresnel blend).
    Where the first surface reflects totally, the followed path is that reflection already.

    Args:
      followed: the batch.
      budget: which light to follow.
      capacity: room for reflections; not used unless the budget asks for them.
    """
    count = followed.hit.shape[0]
    order = jnp.arange(count, dtype=jnp.int32)
    refracted = followed.paths._replace(rays=order)
    if budget.reflections == "none":
        return Traced(refracted, jnp.zeros_like(refracted.radii))
    partial = followed.hit & ~followed.first.total
    strength = jnp.where(partial, followed.first.reflectance, -1.0)
    strength_kept, kept = jax.lax.top_k(strength, capacity)
    share_kept = jnp.maximum(strength_kept, 0.0)
    share = jnp.zeros_like(strength).at[kept].set(share_kept)
    refracted = refracted._replace(weights=refracted.weights * (1.0 - share)[:, None])
    reflected = _reflections(followed, kept, share_kept, strength_kept >= 0.0)
    joined = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), refracted, reflected)
    return Traced(joined, jnp.maximum(strength, 0.0) - share)


def _reflections(
    followed: Followed,
    rays: Int[Array, " kept"],
    share: Float[Array, " kept"],
    real: Bool[Array, " kept"],
) -> LightPaths:
    """Returns the paths that some rays take by reflection at their first surface."""
    first = jax.tree.map(lambda x: x[rays], followed.first)
    camera = jax.tree.map(lambda x: x[rays], followed.paths)
    is_start = jnp.arange(camera.tau.shape[1]) == 0

    def two_segments(before: Array, after: Array) -> Array:
        mask = is_start.reshape(1, -1, *[1] * (before.ndim - 1))
        return jnp.where(mask, before[:, None], after[:, None])

    origin = camera.points[:, 0]
    tau = two_segments(jnp.zeros_like(share), numerics.length(first.position - origin))
    return LightPaths(
        points=two_segments(origin, first.position),
        directions=two_segments(camera.directions[:, 0], first.reflected),
        tau=jnp.where(jnp.arange(tau.shape[1])[None] <= 1, tau, jnp.inf),
        media=two_segments(first.medium_before, first.medium_before),
        rays=rays.astype(jnp.int32),
        weights=jnp.broadcast_to(share[:, None], origin.shape),
        radii=camera.radii,
        bends=jnp.ones_like(camera.bends),
        statuses=jnp.where(real, PathStatus.NOT_TRACED, PathStatus.EMPTY).astype(jnp.int32),
    )


def _alive(walk: _Walk) -> Bool[Array, " rays"]:
    return jnp.isfinite(walk.hits.distances)


def _begin(geometry: Geometry, rays: Rays, bends: int) -> _Walk:
    """Casts the camera rays and opens the record with their first segment."""
    count = rays.radii.shape[0]
    limits = jnp.full_like(rays.radii, jnp.inf if bends > 0 else -1.0)
    leaving = jnp.full(count, bvh.NO_SLOT, jnp.int32)
    hits = bvh.closest_hits(geometry.surfaces.bvh, rays, limits=limits, leaving=leaving)
    segments = bends + 1
    return _Walk(
        bend=jnp.zeros((), jnp.int32),
        direction=rays.directions,
        position=rays.origins,
        tau=jnp.zeros_like(rays.radii),
        hits=hits,
        points=jnp.broadcast_to(rays.origins, (segments, count, 3)),
        directions=jnp.broadcast_to(rays.directions, (segments, count, 3)),
        taus=jnp.full((segments, count), jnp.inf, rays.radii.dtype).at[0].set(0.0),
        media=jnp.full((segments, count), AMBIENT, jnp.int32),
    )


def _meet(geometry: Geometry, walk: _Walk) -> interaction.Interaction:
    """Returns what each ray's next surface does to it."""

    def meet_one(direction: Array, slot: Array, barycentric: Array) -> interaction.Interaction:
        point = surfaces.surface_point(geometry.surfaces, slot, barycentric)
        return interaction.meet(point, geometry.interfaces, direction)

    return jax.vmap(meet_one)(walk.direction, walk.hits.slots, walk.hits.barycentrics)


def _advance(geometry: Geometry, walk: _Walk) -> _Walk:
    """Bends the rays that are alive at their next surface, records it and casts them on."""
    alive = _alive(walk)
    met = _meet(geometry, walk)
    keep = alive[:, None]
    position = jnp.where(keep, met.position, walk.position)
    direction = jnp.where(keep, met.direction, walk.direction)
    tau = walk.tau + numerics.length(position - walk.position)
    hits = bvh.closest_hits(
        geometry.surfaces.bvh,
        Rays(met.restart, direction, jnp.zeros_like(tau)),
        limits=jnp.where(alive, jnp.inf, -1.0).astype(tau.dtype),
        leaving=walk.hits.slots,
    )
    segment = walk.bend + 1
    before = walk.media.at[segment - 1].set(
        jnp.where(alive, met.medium_before, walk.media[segment - 1])
    )
    return _Walk(
        bend=segment,
        direction=direction,
        position=position,
        tau=tau,
        hits=hits,
        points=walk.points.at[segment].set(position),
        directions=walk.directions.at[segment].set(direction),
        taus=walk.taus.at[segment].set(jnp.where(alive, tau, jnp.inf)),
        media=before.at[segment].set(jnp.where(alive, met.medium, AMBIENT)),
    )


def _record(rays: Rays, walk: _Walk) -> LightPaths:
    """Turns the record of a finished walk into one path a ray."""
    bends = jnp.sum(jnp.isfinite(walk.taus[1:]), axis=0, dtype=jnp.int32)
    ended = jnp.where(bends > 0, PathStatus.ESCAPED, PathStatus.MISSED)
    return LightPaths(
        points=jnp.moveaxis(walk.points, 0, 1),
        directions=jnp.moveaxis(walk.directions, 0, 1),
        tau=walk.taus.T,
        media=walk.media.T,
        rays=jnp.arange(bends.shape[0], dtype=jnp.int32),
        weights=jnp.ones_like(rays.directions),
        radii=rays.radii,
        bends=bends,
        statuses=jnp.where(_alive(walk), PathStatus.OUT_OF_BENDS, ended).astype(jnp.int32),
    )
