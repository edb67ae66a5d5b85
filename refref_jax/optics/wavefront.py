"""Follows rays along their refracted paths, all together: the wavefront.

Every round casts all rays that are still inside the objects, and bends each at the surface that
it meets. Letters as in `light_paths`.

Source: paper (arXiv 2505.05848), section 4.2.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from refref_jax import numerics
from refref_jax.geometry import bvh, surfaces
from refref_jax.geometry.rays import Rays
from refref_jax.optics import interaction
from refref_jax.optics.light_paths import LightPaths, PathStatus
from refref_jax.optics.media import AMBIENT, Interfaces


class Geometry(NamedTuple):
    """All that light meets: surfaces, and the interfaces that they stand for."""

    surfaces: surfaces.Surfaces
    interfaces: Interfaces


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
