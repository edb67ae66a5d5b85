"""One bounce of one ray: intersection, refraction, reflection and the split of its throughput.

Both tracers, `wavefront` and `differentiable_paths`, are built from these steps.

Symbols as in `snell` and `light_paths`. The geometric normal determines the side that a ray comes
from and the origins of the new rays; the shading normal determines their directions.

Source: paper (arXiv 2505.05848), section 4.2, with its Fresnel blend; the energy-conserving
throughput threshold is ours.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from refref_jax import numerics
from refref_jax.geometry import surfaces
from refref_jax.geometry.bvh import NO_PRIMITIVE
from refref_jax.geometry.rays import Rays
from refref_jax.geometry.surfaces import SurfacePoint
from refref_jax.optics import fresnel, light_paths, media
from refref_jax.optics.fresnel import Stratum
from refref_jax.optics.light_paths import Bend, PathStatus, RayDifferential, Stop
from refref_jax.optics.media import Scene
from refref_jax.optics.path_settings import PathSettings

# Sine of the angle at which a ray that was turned leaves the triangle, as a share of that at which
# it would have entered it.
_BEYOND = 0.01


class Interaction(NamedTuple):
    """Reflection and refraction of a ray at an interface.

    Attributes:
      position: hit point on the interface.
      reflectance: Fresnel's `R`, 1 in total internal reflection.
      total: whether reflection is total.
      reflected: mirrored unit direction.
      transmitted: refracted unit direction; finite but meaningless if reflection is total.
      restart_reflected: origin of the mirrored ray, just off the surface.
      restart_transmitted: origin of the refracted ray, just off the surface on its other side.
      sides: media on both sides; the tint of a conductor includes its reflectance.
      unmasked: shares of the reflected and of the transmitted light that a rough surface does not
        hide; `None` in scenes without rough surfaces.
      radiance: linear RGB radiance of an opaque surface; `None` if it is unknown.
    """

    position: Float[Array, "3"]
    reflectance: Float[Array, ""]
    total: Bool[Array, ""]
    reflected: Float[Array, "3"]
    transmitted: Float[Array, "3"]
    restart_reflected: Float[Array, "3"]
    restart_transmitted: Float[Array, "3"]
    sides: media.Crossing
    unmasked: Float[Array, "2"] | None = None
    radiance: Float[Array, "3"] | None = None


def interact(
    point: SurfacePoint,
    interfaces: media.Interfaces,
    interior_list: Int[Array, " slots"],
    direction: Float[Array, "3"],
    *,
    stratum: Stratum | None = None,
    tilt: Float[Array, "2"] | None = None,
) -> Interaction:
    """Reflects and refracts a ray at an interface.

    A ray that the shading normal would send to the wrong side of the triangle is turned until it
    just leaves it. If the shading normal points away from the incident ray, the geometric normal is
    used. On a rough surface, both rays leave one facet (see `fresnel`).

    Args:
      point: hit point of the ray.
      interfaces: interfaces of the scene.
      interior_list: interior list of the ray (see `media`).
      direction: unit direction of the incident ray.
      stratum: place of the ray among those of its pixel, if it is known.
      tilt: tilt of the facet of a rough surface, as a slope; 0 by default.
    """
    entering = numerics.dot(direction, point.geometric_normal) < 0.0
    sides = media.crossing(interfaces, interior_list, point.part, entering)
    outward = jnp.where(entering, 1.0, -1.0).astype(direction.dtype)
    geometric, shading = outward * point.geometric_normal, outward * point.shading_normal

    normal = jnp.where(numerics.dot(direction, shading) < 0.0, shading, geometric)
    alpha = interfaces.alpha[point.part] if interfaces.alpha.shape[0] else None
    facet = normal
    if alpha is not None:
        numbers = fresnel.uniform_pair(point.position, direction, stratum=stratum)
        facet = fresnel.facet_normal(direction, normal, alpha, numbers)
        facet = facet if tilt is None else fresnel.tilted(facet, tilt)
    near, far = sides.index_near, sides.index_far
    beta = -numerics.dot(direction, facet)
    total = fresnel.transmission(beta, near, far).total
    # Nothing is transmitted in total internal reflection, where `refract` returns a tangent as long
    # as the ratio of indices: `_on_side` would take the root of a negative number, and its NaN
    # would reach the gradient of the reflected ray.
    refracted = jnp.where(total, direction, fresnel.refract(direction, facet, near, far))
    # Directions are renormalised, or rounding errors would accumulate over bends.
    met = Interaction(
        position=point.position,
        reflectance=fresnel.reflectance(beta, near, far),
        total=total,
        reflected=numerics.renormalize(fresnel.reflect(direction, facet)),
        transmitted=numerics.renormalize(refracted),
        restart_reflected=numerics.offset_origin(point.position, geometric, point.scale),
        restart_transmitted=numerics.offset_origin(point.position, -geometric, point.scale),
        sides=sides,
        radiance=point.radiance,
    )
    met = _at_other_kinds(met, interfaces, direction, beta)
    if alpha is not None:  # light that a facet sends to the wrong side is hidden, and not turned
        met = met._replace(unmasked=_unmasked(met, direction, normal, alpha))
    return met._replace(
        reflected=_on_side(met.reflected, geometric),
        transmitted=_on_side(met.transmitted, -geometric),
    )


def _at_other_kinds(
    met: Interaction,
    interfaces: media.Interfaces,
    direction: Float[Array, "3"],
    beta: Float[Array, ""],
) -> Interaction:
    """Returns the interaction with a conductor or thin sheet in place of a dielectric."""
    kind = met.sides.kind
    if kind is None:
        return met
    metal, sheet = kind == media.CONDUCTOR, kind == media.THIN_SHEET
    met = met._replace(
        reflectance=jnp.where(
            metal,
            1.0,
            jnp.where(sheet, fresnel.sheet_reflectance(met.reflectance), met.reflectance),
        ),
        total=metal | met.total,
        transmitted=jnp.where(sheet, direction, met.transmitted),
    )
    if interfaces.complex_index.shape[0] == 0:
        return met
    eta, k = interfaces.complex_index[met.sides.part] / met.sides.index_near
    reflected = jnp.where(metal, fresnel.conductor_reflectance(beta, eta, k), 1.0)
    return met._replace(sides=met.sides._replace(tint=met.sides.tint * reflected))


def _unmasked(
    met: Interaction,
    direction: Float[Array, "3"],
    normal: Float[Array, "3"],
    alpha: Float[Array, ""],
) -> Float[Array, "2"]:
    """Returns the shares of light that leave a rough surface reflected, and transmitted."""
    towards = -numerics.dot(direction, normal)
    leaving = jnp.stack(
        [numerics.dot(met.reflected, normal), -numerics.dot(met.transmitted, normal)]
    )
    shares = jax.vmap(fresnel.masking, in_axes=(None, 0, None))(towards, leaving, alpha)
    if met.sides.kind is None:
        return shares
    # A thin sheet transmits straight on, without facets.
    return shares.at[1].set(jnp.where(met.sides.kind == media.THIN_SHEET, 1.0, shares[1]))


def _on_side(
    direction: Float[Array, "3"], geometric_normal: Float[Array, "3"]
) -> Float[Array, "3"]:
    """Returns a unit direction, turned just to the side that a normal points to."""
    below = jnp.maximum(-numerics.dot(direction, geometric_normal), 0.0)
    # The squared length of the sum, at least that for the opposite of the normal.
    squared = 1.0 - (1.0 - _BEYOND**2) * jnp.square(below)
    return (direction + (1.0 + _BEYOND) * below * geometric_normal) / jnp.sqrt(squared)


class Shares(NamedTuple):
    """Shares of the incident throughput, which sum to 1. Branches of share 0 are not followed."""

    reflected: Float[Array, ""]
    transmitted: Float[Array, ""]


def shares(
    settings: PathSettings,
    *,
    reflectance: Float[Array, ""],
    total: Bool[Array, ""],
    first: Bool[Array, ""],
    strength: Float[Array, ""],
) -> Shares:
    """Divides throughput between the two branches.

    If a reflection is not followed, the transmitted branch takes its share. If the weaker branch
    falls below the throughput threshold, the stronger one takes all, so the threshold neither
    darkens the image nor adds noise. If a branch is below the threshold, the shares are constant,
    with gradient 0; otherwise, their gradient is that of `reflectance`.

    Args:
      settings: path settings.
      reflectance: Fresnel's `R`.
      total: whether reflection is total.
      first: whether this is the first surface of a path.
      strength: largest RGB component of incident throughput times the interface's tint.
    """
    if settings.reflections == "all":
        partial = reflectance
    elif settings.reflections == "first":
        partial = jnp.where(first, reflectance, 0.0)
    else:
        partial = jnp.zeros_like(reflectance)
    reflected = jnp.where(total, jnp.ones_like(partial), partial)
    weaker = jnp.minimum(reflected, 1.0 - reflected)
    winner = jnp.where(reflected > 0.5, jnp.ones_like(reflected), jnp.zeros_like(reflected))
    reflected = jnp.where(weaker * strength < settings.min_throughput, winner, reflected)
    return Shares(reflected, 1.0 - reflected)


class RayState(NamedTuple):
    """State of a ray along its path.

    Attributes:
      origin: origin of the next cast, just off the surface, world units.
      point: start of the current segment, on the surface.
      direction: unit vector.
      tau: arc length from the camera to `point`.
      throughput: throughput, the share of the camera ray's linear RGB.
      num_bends: number of bends so far.
      exclude_primitive: triangle that the segment starts on, which it cannot hit.
      interior_list: interior list, the parts that the ray is in (see `media`).
      differential: ray differential of the current segment (see `RayDifferential`).
      strata: pixel, number of the ray and number of rays, see `Rays`.
    """

    origin: Float[Array, "*rays 3"]
    point: Float[Array, "*rays 3"]
    direction: Float[Array, "*rays 3"]
    tau: Float[Array, "*rays"]
    throughput: Float[Array, "*rays 3"]
    num_bends: Int[Array, "*rays"]
    exclude_primitive: Int[Array, "*rays"]
    interior_list: Int[Array, "*rays slots"]
    differential: RayDifferential
    strata: Int[Array, "*rays 3"] | None = None


class Arrival(NamedTuple):
    """A ray's hit of a surface.

    Attributes:
      interaction: interaction of the ray with the interface.
      length: length of the segment that ends at the hit.
      throughput: throughput after absorption along the segment and the surface's tint.
      reflected: ray differential of the reflected ray.
      transmitted: ray differential of the transmitted ray.
    """

    interaction: Interaction
    length: Float[Array, "*rays"]
    throughput: Float[Array, "*rays 3"]
    reflected: RayDifferential
    transmitted: RayDifferential


class Branches(NamedTuple):
    """The two rays that leave a surface; branches of throughput 0 are not followed."""

    reflected: RayState
    transmitted: RayState


def begin(
    ray: Rays, interior_list: Int[Array, " slots"], differential: RayDifferential
) -> RayState:
    """Returns the state of a camera ray before its first surface."""
    return RayState(
        origin=ray.origins,
        point=ray.origins,
        direction=ray.directions,
        tau=jnp.zeros_like(ray.radii),
        throughput=jnp.ones_like(ray.origins),
        num_bends=jnp.zeros((), jnp.int32),
        exclude_primitive=jnp.full((), NO_PRIMITIVE, jnp.int32),
        interior_list=interior_list,
        differential=differential,
        strata=ray.strata,
    )


def arrive(scene: Scene, state: RayState, primitive_id: Int[Array, ""]) -> Arrival:
    """Advances a ray to the triangle that it hits; finite but meaningless for `NO_PRIMITIVE`.

    The hit point is recomputed from the corners of the triangle, so it has gradients and the
    precision of the corners rather than that of the BVH traversal. On a level set, a stretch of the
    ray takes the place of the triangle (`surfaces.meet`).
    """
    interfaces, stratum = scene.interfaces, None
    if state.strata is not None:
        stratum = Stratum(state.strata[0], state.strata[1], state.strata[2], state.num_bends)
    if media.has_dispersion(interfaces):  # the ray carries light of one channel
        interfaces = media.interfaces_of_channel(interfaces, jnp.argmax(state.throughput))

    def surface(
        origin: Float[Array, "3"], direction: Float[Array, "3"], tilt: Float[Array, "2"] | None
    ) -> tuple[Bend, Interaction]:
        point = surfaces.meet(scene.surfaces, primitive_id, origin, direction)
        # Otherwise XLA would gather the triangle again for every result that depends on it.
        point = jax.lax.optimization_barrier(point)
        met = interact(
            point, interfaces, state.interior_list, direction, stratum=stratum, tilt=tilt
        )
        return Bend(met.position, met.reflected, met.transmitted), met

    # The ray stands for the facets between it and the other rays of its pixel, too.
    tilts = None
    if stratum is not None and interfaces.alpha.shape[0]:
        part = media.meshes_of(scene).parts[primitive_id]
        tilts = fresnel.spacing(interfaces.alpha[part], stratum)
    met, reflected, transmitted = light_paths.bend(
        surface, state.origin, state.direction, state.differential, tilts=tilts
    )
    length = numerics.length(met.position - state.point)
    passed = media.transmittance(scene.interfaces, met.sides.medium_near, length)
    throughput = state.throughput * passed * met.sides.tint
    return Arrival(met, length, throughput, reflected, transmitted)


def end_status(
    settings: PathSettings, state: RayState, arrival: Arrival, hit: Bool[Array, ""]
) -> Int[Array, ""]:
    """Returns the status of a path that ends here; `EMPTY` if it bends and continues.

    Args:
      settings: path settings.
      state: state of the ray.
      arrival: the ray's hit.
      hit: whether the ray hits anything.
    """
    missed = jnp.where(state.num_bends > 0, PathStatus.ESCAPED, PathStatus.MISSED)
    met = jnp.where(state.num_bends < settings.max_bends, PathStatus.EMPTY, PathStatus.OUT_OF_BENDS)
    kind, opaque = arrival.interaction.sides.kind, arrival.interaction.sides.opaque
    if settings.total_reflection == "ended":
        total = arrival.interaction.total
        if kind is not None:  # a mirror is not a total internal reflection
            total &= kind != media.CONDUCTOR
        met = jnp.where(total, PathStatus.TOTALLY_REFLECTED, met)
    if opaque is not None:
        met = jnp.where(opaque, PathStatus.OPAQUE, met)
    return jnp.where(hit, met, missed).astype(jnp.int32)


def contribution(
    settings: PathSettings, throughput: Float[Array, "3"], status: Int[Array, ""]
) -> Float[Array, "3"]:
    """Returns the throughput that a path contributes when it ends with a status."""
    if settings.truncated_paths == "background":
        return throughput
    return jnp.where(status == PathStatus.OUT_OF_BENDS, 0.0, throughput)


def stop(state: RayState, arrival: Arrival, status: Int[Array, ""]) -> tuple[RayState, Stop | None]:
    """Returns the state of a ray that ends with a status, and where it stops.

    Light that ends on an opaque surface has passed the medium before it; in other cases the state
    is unchanged. There is no stop in scenes without opaque parts.
    """
    met = arrival.interaction
    if met.sides.opaque is None:
        return state, None
    ends = status == PathStatus.OPAQUE
    throughput = jnp.where(ends, arrival.throughput, state.throughput)
    tau = jnp.where(ends, state.tau + arrival.length, jnp.inf)
    return state._replace(throughput=throughput), Stop(tau, met.radiance)


def branch(
    settings: PathSettings, state: RayState, arrival: Arrival, primitive_id: Int[Array, ""]
) -> Branches:
    """Returns both rays that leave the surface, with their shares of the throughput."""
    met = arrival.interaction
    share = shares(
        settings,
        reflectance=met.reflectance,
        total=met.total,
        first=state.num_bends == 0,
        strength=jnp.max(arrival.throughput),
    )
    after = state._replace(
        point=met.position,
        tau=state.tau + arrival.length,
        num_bends=state.num_bends + 1,
        exclude_primitive=primitive_id,
    )
    reflected = arrival.throughput * share.reflected
    transmitted = arrival.throughput * share.transmitted
    if met.unmasked is not None:
        reflected, transmitted = reflected * met.unmasked[0], transmitted * met.unmasked[1]
    return Branches(
        reflected=after._replace(
            origin=met.restart_reflected,
            direction=met.reflected,
            throughput=reflected,
            differential=arrival.reflected,
        ),
        transmitted=after._replace(
            origin=met.restart_transmitted,
            direction=met.transmitted,
            throughput=transmitted,
            interior_list=met.sides.interior_list_after,
            differential=arrival.transmitted,
        ),
    )
