"""Rays with the footprints of their pixels, in the world frame and world units.

Directions are unit vectors, so a distance along a ray is arc length, never depth along an optical
axis.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int


class Rays(NamedTuple):
    """A ray, or a batch of them along the leading axes.

    Attributes:
      origins: start points, world units.
      directions: unit vectors.
      radii: footprint of the pixel, as the cone radius at unit distance (world units per world
        unit).
      strata: index of the pixel, index of the ray in the pixel, and number of rays in the pixel, so
        that the rays of a pixel meet different facets of a rough surface (`cameras.strata`); `None`
        for rays without relation.
    """

    origins: Float[Array, "*rays 3"]
    directions: Float[Array, "*rays 3"]
    radii: Float[Array, "*rays"]
    strata: Int[Array, "*rays 3"] | None = None


def orthonormal_basis(
    direction: Float[Array, "3"],
) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Returns two unit vectors that complete a unit vector to a right-handed basis.

    Source: Duff et al., Building an Orthonormal Basis, Revisited (2017).
    """
    x, y, z = direction
    sign = jnp.copysign(jnp.ones_like(z), z)
    a = -1.0 / (sign + z)
    b = x * y * a
    right = jnp.stack([1.0 + sign * x * x * a, sign * b, -sign * x])
    up = jnp.stack([b, sign + y * y * a, -y])
    return right, up
