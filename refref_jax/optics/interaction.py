"""One ray meets one interface: where the light goes on.

Letters as in `snell`. The geometric normal decides from which side the ray comes and where it
starts again; the shading normal bends it.
"""

from typing import NamedTuple

import jax
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
      total: whether reflection is total.
      reflected: mirrored unit direction.
      transmitted: refracted unit direction; finite, without meaning, if reflection is total.
      restart_reflected: origin of the mirrored ray, just off the surface.
      restart_transmitted: origin of the refracted ray, just off the surface on its other side.
      sides: the media on both sides.
    """

    position: Float[Array, "3"]
    reflectance: Float[Array, ""]
    total: Bool[Array, ""]
    reflected: Float[Array, "3"]
    transmitted: Float[Array, "3"]
    restart_reflected: Float[Array, "3"]
    restart_transmitted: Float[Array, "3"]
    sides: media.Crossing


class _Split(NamedTuple):
    """The two rays that leave an interface under one choice of normal."""

    reflected: Float[Array, "3"]
    refracted: Float[Array, "3"]
    reflectance: Float[Array, ""]
    total: Bool[Array, ""]


def meet(
    point: SurfacePoint,
    interfaces: media.Interfaces,
    inside: Int[Array, " slots"],
    direction: Float[Array, "3"],
) -> Interaction:
    """Follows a ray to an interface and beyond it.

    Where the shading normal would send either ray to the wrong side of the triangle, both
    follow the geometric normal instead.

    Args:
      point: where the ray meets the surface.
      interfaces: the scene's interfaces.
      inside: the parts that the ray is in (see `media`).
      direction: unit direction of the incident ray.
    """
    entering = jnp.dot(direction, point.geometric_normal) < 0.0
    sides = media.crossing(interfaces, inside, point.part, entering)
    outward = jnp.where(entering, 1.0, -1.0).astype(direction.dtype)
    geometric, shading = outward * point.geometric_normal, outward * point.shading_normal

    smooth = _split(direction, shading, sides)
    flat = _split(direction, geometric, sides)
    valid = (
        (jnp.dot(direction, shading) < 0.0)
        & (jnp.dot(smooth.reflected, geometric) > 0.0)
        & (smooth.total | (jnp.dot(smooth.refracted, geometric) < 0.0))
    )
    split = jax.tree.map(lambda a, b: jnp.where(valid, a, b), smooth, flat)
    return Interaction(
        position=point.position,
        reflectance=split.reflectance,
        total=split.total,
        reflected=split.reflected,
        transmitted=split.refracted,
        restart_reflected=numerics.offset_origin(point.position, geometric, point.scale),
        restart_transmitted=numerics.offset_origin(point.position, -geometric, point.scale),
        sides=sides,
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
