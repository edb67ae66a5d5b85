"""Interaction of one ray with one interface: the reflected and the refracted ray.

Letters as in `snell`. The geometric normal determines the side that the ray comes from and the
origins of the new rays; the shading normal determines their directions.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from refref_jax import numerics
from refref_jax.geometry.surfaces import SurfacePoint
from refref_jax.optics import fresnel, media, snell


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
      sides: media on both sides.
    """

    position: Float[Array, "3"]
    reflectance: Float[Array, ""]
    total: Bool[Array, ""]
    reflected: Float[Array, "3"]
    transmitted: Float[Array, "3"]
    restart_reflected: Float[Array, "3"]
    restart_transmitted: Float[Array, "3"]
    sides: media.Crossing


def meet(
    point: SurfacePoint,
    interfaces: media.Interfaces,
    inside: Int[Array, " slots"],
    direction: Float[Array, "3"],
) -> Interaction:
    """Reflects and refracts a ray at an interface.

    If the shading normal would send either ray to the wrong side of the triangle, the geometric
    normal is used for both.

    Args:
      point: hit point of the ray.
      interfaces: interfaces of the scene.
      inside: interior list of the ray (see `media`).
      direction: unit direction of the incident ray.
    """
    entering = numerics.dot(direction, point.geometric_normal) < 0.0
    sides = media.crossing(interfaces, inside, point.part, entering)
    outward = jnp.where(entering, 1.0, -1.0).astype(direction.dtype)
    geometric, shading = outward * point.geometric_normal, outward * point.shading_normal

    normal = jnp.where(_keeps_sides(direction, shading, geometric, sides), shading, geometric)
    near, far = sides.index_near, sides.index_far
    beta = -numerics.dot(direction, normal)
    # Directions are renormalised, or rounding errors would accumulate over bends.
    return Interaction(
        position=point.position,
        reflectance=fresnel.reflectance(beta, near, far),
        total=snell.transmission(beta, near, far).total,
        reflected=numerics.renormalize(snell.reflect(direction, normal)),
        transmitted=numerics.renormalize(snell.refract(direction, normal, near, far)),
        restart_reflected=numerics.offset_origin(point.position, geometric, point.scale),
        restart_transmitted=numerics.offset_origin(point.position, -geometric, point.scale),
        sides=sides,
    )


def _keeps_sides(
    direction: Float[Array, "3"],
    shading: Float[Array, "3"],
    geometric: Float[Array, "3"],
    sides: media.Crossing,
) -> Bool[Array, ""]:
    """Returns whether the shading normal sends both rays to the correct side of the triangle."""
    near, far = sides.index_near, sides.index_far
    beta = -numerics.dot(direction, shading)
    total = snell.transmission(beta, near, far).total
    reflected = snell.reflect(direction, shading)
    refracted = snell.refract(direction, shading, near, far)
    return (
        (beta > 0.0)
        & (numerics.dot(reflected, geometric) > 0.0)
        & (total | (numerics.dot(refracted, geometric) < 0.0))
    )
