"""Splits one ray at a surface into a reflected and a transmitted ray.

Both tracers, `wavefront` and `single_path`, are built from these steps.

Source: paper (arXiv 2505.05848), section 4.2. Letters as in `light_paths`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from refref_jax import numerics
from refref_jax.geometry import surfaces, triangles
from refref_jax.geometry.bvh import NO_SLOT
from refref_jax.geometry.rays import Rays
from refref_jax.optics import footprints, interaction, media, splitting
from refref_jax.optics.budgets import Budget
from refref_jax.optics.footprints import Bend, Spread
from refref_jax.optics.light_paths import PathStatus
from refref_jax.optics.scene import Scene


class RayState(NamedTuple):
    """State of a ray along its path.

    Attributes:
      origin: origin of the next cast, just off the surface, world units.
      point: start of the current segment, on the surface.
      direction: unit vector.
      tau: arc length from the camera to `point`.
      weight: throughput, the share of the camera ray's linear RGB.
      bends: number of bends so far.
      leaving: excluded primitive, the triangle slot that the segment starts on.
      inside: interior list, the parts that the ray is in (see `media`).
      spread: ray differential of the current segment (see `footprints`).
    """

    origin: Float[Array, "*rays 3"]
    point: Float[Array, "*rays 3"]
    direction: Float[Array, "*rays 3"]
    tau: Float[Array, "*rays"]
    weight: Float[Array, "*rays 3"]
    bends: Int[Array, "*rays"]
    leaving: Int[Array, "*rays"]
    inside: Int[Array, "*rays slots"]
    spread: Spread


class Arrival(NamedTuple):
    """A ray's hit of a surface.

    Attributes:
      interaction: interaction of the ray with the interface.
      length: length of the segment that ends at the hit.
      weight: throughput after absorption along the segment and the surface's tint.
      reflected: ray differential of the reflected ray.
      transmitted: ray differential of the transmitted ray.
    """

    interaction: interaction.Interaction
    length: Float[Array, "*rays"]
    weight: Float[Array, "*rays 3"]
    reflected: Spread
    transmitted: Spread


class Branches(NamedTuple):
    """The two rays that leave a surface; branches of weight 0 are not followed."""

    reflected: RayState
    transmitted: RayState


def begin(ray: Rays, inside: Int[Array, " slots"], spread: Spread) -> RayState:
    """Returns the state of a camera ray before its first surface."""
    return RayState(
        origin=ray.origins,
        point=ray.origins,
        direction=ray.directions,
        tau=jnp.zeros_like(ray.radii),
        weight=jnp.ones_like(ray.origins),
        bends=jnp.zeros((), jnp.int32),
        leaving=jnp.full((), NO_SLOT, jnp.int32),
        inside=inside,
        spread=spread,
    )


def arrive(geometry: Scene, state: RayState, slot: Int[Array, ""]) -> Arrival:
    """Advances a ray to the triangle that it hits; finite but meaningless for `NO_SLOT`.

    The hit point is recomputed from the corners of the triangle, so it has gradients and the
    precision of the corners rather than that of the BVH traversal.
    """

    def surface(
        origin: Float[Array, "3"], direction: Float[Array, "3"]
    ) -> tuple[Bend, interaction.Interaction]:
        corners = geometry.surfaces.bvh.triangles[slot]
        found = triangles.intersect(origin, direction, corners).barycentric
        # A ray without a hit reads an arbitrary triangle: keep it out of values and gradients.
        barycentric = jnp.where(slot == NO_SLOT, 1.0 / 3.0, found)
        point = surfaces.surface_point(geometry.surfaces, slot, barycentric)
        # Otherwise XLA would gather the triangle again for every result that depends on it.
        point = jax.lax.optimization_barrier(point)
        met = interaction.meet(point, geometry.interfaces, state.inside, direction)
        return Bend(met.position, met.reflected, met.transmitted), met

    met, reflected, transmitted = footprints.bend(
        surface, state.origin, state.direction, state.spread
    )
    length = numerics.length(met.position - state.point)
    passed = media.transmittance(geometry.interfaces, met.sides.medium_near, length)
    weight = state.weight * passed * met.sides.tint
    return Arrival(met, length, weight, reflected, transmitted)


def ending(
    budget: Budget, state: RayState, arrival: Arrival, hit: Bool[Array, ""]
) -> Int[Array, ""]:
    """Returns the status of a path that ends here; `EMPTY` if it bends and continues.

    Args:
      budget: path settings.
      state: state of the ray.
      arrival: the ray's hit.
      hit: whether the ray hits anything.
    """
    missed = jnp.where(state.bends > 0, PathStatus.ESCAPED, PathStatus.MISSED)
    met = jnp.where(state.bends < budget.bends, PathStatus.EMPTY, PathStatus.OUT_OF_BENDS)
    if budget.total_reflection == "ended":
        met = jnp.where(arrival.interaction.total, PathStatus.TOTALLY_REFLECTED, met)
    return jnp.where(hit, met, missed).astype(jnp.int32)


def shown(budget: Budget, weight: Float[Array, "3"], status: Int[Array, ""]) -> Float[Array, "3"]:
    """Returns the weight that a path contributes when it ends with a status."""
    if budget.unfinished == "kept":
        return weight
    return jnp.where(status == PathStatus.OUT_OF_BENDS, 0.0, weight)


def branch(budget: Budget, state: RayState, arrival: Arrival, slot: Int[Array, ""]) -> Branches:
    """Returns both rays that leave the surface, with their shares of the throughput."""
    met = arrival.interaction
    share = splitting.shares(
        budget,
        reflectance=met.reflectance,
        total=met.total,
        first=state.bends == 0,
        strength=jnp.max(arrival.weight),
    )
    after = state._replace(
        point=met.position,
        tau=state.tau + arrival.length,
        bends=state.bends + 1,
        leaving=slot,
    )
    return Branches(
        reflected=after._replace(
            origin=met.restart_reflected,
            direction=met.reflected,
            weight=arrival.weight * share.reflected,
            spread=arrival.reflected,
        ),
        transmitted=after._replace(
            origin=met.restart_transmitted,
            direction=met.transmitted,
            weight=arrival.weight * share.transmitted,
            inside=met.sides.inside_after,
            spread=arrival.transmitted,
        ),
    )
