"""One ray meets one interface: where the light goes on.

Letters as in `snell`. The geometric normal decides from which side the ray comes and where it
starts again; the shading normal bends it.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from refref_jax import numerics
from refref_jax.geometry.surfaces import SurfacePoint
from refref_jax.optics import fresnel, media, snell


class Interaction(NamedTuple):
    """What an interface does to a ray.

    Attributes:
      position: the point on the interface.
      reflectance: Fresnel's `R`, 1 in total internal reflection.
      reflected: mirrored unit direction.
      direction: where the energy-carrying ray goes on: refracted, or mirrored in total internal
        reflection; unit.
      restart: origin of the ray that goes on, just off the surface.
      medium: the medium it goes on in.
      medium_before: the medium it came through.
      total: whether reflection is total.
    """

    position: Float[Array, "3"]
    reflectance: Float[Array, ""]
    reflected: Float[Array, "3"]
    direction: Float[Array, "3"]
    restart: Float[Array, "3"]
    medium: Int[Array, ""]
    medium_before: Int[Array, ""]
    total: Bool[Array, ""]


class _Split(NamedTuple):
    """The two rays that leave an interface under one choice of normal."""

    reflected: Float[Array, "3"]
    refracted: Float[Array, "3"]
    reflectance: Float[Array, ""]
    total: Bool[Array, ""]


def meet(
    point: SurfacePoint, interfaces: media.Interfaces, direction: Float[Array, "3"]
) -> Interaction:
    """Follows a ray through an interface.

    Where the shading normal would send either ray to the wrong side of the triangle, both
    follow the geometric normal instead.

    Args:
      point: where the ray meets the surface.
      interfaces: the scene's interfaces.
      direction: unit direction of the incident ray.
    """
    entering = jnp.dot(direction, point.geometric_normal) < 0.0
    sides = media.crossing(interfaces, media.nowhere(interfaces), point.part, entering)
    outward = jnp.where(entering, 1.0, -1.0).astype(direction.dtype)
    geometric, shading = outward * point.geometric_normal, outward * point.shading_normal

    smooth = _split(direction, shading, sides)
    flat = _split(direction, geometric, sides)
    valid = (
        (jnp.dot(direction, shading) < 0.0)
        & (jnp.dot(smooth.reflected, geometric) > 0.0)
        & (smooth.total | (jnp.dot(smooth.refracted, geometric) < 0.0))
    )
    reflected = jnp.where(valid, smooth.reflected, flat.reflected)
    refracted = jnp.where(valid, smooth.refracted, flat.refracted)
    total = jnp.where(valid, smooth.total, flat.total)
    onward = jnp.where(total, reflected, refracted)
    return Interaction(
        position=point.position,
        reflectance=jnp.where(valid, smooth.reflectance, flat.reflectance),
        reflected=reflected,
        direction=onward,
        restart=numerics.offset_origin(point.position, onward, geometric, point.scale),
        medium=jnp.where(total, sides.medium_near, sides.medium_far),
        medium_before=sides.medium_near,
        total=total,
    )


def _split(
    direction: Float[Array, "3"], normal: Float[Array, "3"], sides: media.Crossing
) -> _Split:
    """Reflects and refracts; lengths are renormalised, or rounding would add up over bends."""
    beta = -jnp.dot(direction, normal)
    near, far = sides.index_near, sides.index_far
    return _Split(
        reflected=numerics.normalize(snell.reflect(direction, normal)),
        refracted=numerics.normalize(snell.refract(direction, normal, near, far)),
        reflectance=fresnel.reflectance(beta, near, far),
        total=snell.transmission(beta, near, far).total,
    )
