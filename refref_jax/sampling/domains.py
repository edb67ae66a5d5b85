"""From world space to the unit cube that a field is stored in.

A bounded scene is a cube, scaled, and a spherical one the ball in it. An unbounded one is
contracted: a ball around the origin stays as it is and all of the space beyond it is squeezed into
a shell of the same thickness.

Source: Barron et al., Mip-NeRF 360 (2022), Eq 10; Zip-NeRF (2023), section 2, for the scale of a
contracted Gaussian.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from refref_jax import numerics
from refref_jax.choices import Space
from refref_jax.sampling.cones import Gaussians


class Domain(NamedTuple):
    """The part of space that a field stores.

    Attributes:
      radius: half edge of a bounded scene's cube, or radius of a spherical scene or of an
        unbounded scene's uncontracted ball; world units.
      space: whether all there is lies in the cube, or in the ball, or space beyond the ball is
        contracted.
    """

    radius: float
    space: Space


def to_unit_cube(domain: Domain, gaussian: Gaussians) -> Gaussians:
    """Maps world-space Gaussians to `[0, 1]^3`; scales become fractions of the cube's edge.

    Points outside the cube of a scene that is not unbounded are moved to its nearest face.
    """
    positions = gaussian.positions / domain.radius
    scales = gaussian.scales / domain.radius
    if domain.space == "unbounded":
        return Gaussians(0.25 * contract(positions) + 0.5, 0.25 * scales * shrinkage(positions))
    return Gaussians(jnp.clip(0.5 * positions + 0.5, 0.0, 1.0), 0.5 * scales)


def nearest_within(domain: Domain, point: Float[Array, "3"]) -> Float[Array, "3"]:
    """Returns the point of the domain that is nearest to a point: that itself, if it is within."""
    if domain.space == "unbounded":
        return point
    if domain.space == "spherical":
        return point * (domain.radius / jnp.maximum(numerics.length(point), domain.radius))
    return jnp.clip(point, -domain.radius, domain.radius)


def exit_distance(
    domain: Domain, origin: Float[Array, "3"], direction: Float[Array, "3"]
) -> Float[Array, ""]:
    """Returns how far a ray goes before it leaves a bounded scene's cube, or the ball, for good.

    `inf` for a ray that never meets it and in an unbounded scene. The gradient is not meant to be
    used: which face is left changes abruptly.

    Source: for the cube the slab method, Kay and Kajiya (1986).
    """
    if domain.space == "unbounded":
        return jnp.full_like(origin[0], jnp.inf)
    if domain.space == "spherical":
        middle, half = chord(domain.radius, origin, direction)
        return jnp.where((half > 0.0) & (middle + half >= 0.0), middle + half, jnp.inf)
    inverse = numerics.safe_reciprocal(direction)
    first = (-domain.radius - origin) * inverse
    second = (domain.radius - origin) * inverse
    enter, leave = jnp.max(jnp.minimum(first, second)), jnp.min(jnp.maximum(first, second))
    return jnp.where((enter <= leave) & (leave >= 0.0), leave, jnp.inf)


def chord(
    radius: float | Float[Array, ""], origin: Float[Array, "3"], direction: Float[Array, "3"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Returns which part of a line lies in a sphere around the origin.

    Args:
      radius: of the sphere, world units.
      origin: a point of the line.
      direction: of the line, unit.

    Returns:
      From the point to the chord's middle, and half the chord: 0 of a line that misses the sphere,
      whose middle is its point nearest to the origin.
    """
    along = numerics.dot(origin, direction)
    beyond = numerics.dot(origin, origin) - jnp.square(radius)
    return -along, numerics.safe_sqrt(jnp.square(along) - beyond)


def contract(x: Float[Array, "*shape 3"]) -> Float[Array, "*shape 3"]:
    """Contracts points to the ball of radius 2: `(2 - 1 / |x|) x / |x|` where `|x| > 1`."""
    norm = numerics.length(x)[..., None]
    outside = norm > 1.0
    inverse = 1.0 / jnp.where(outside, norm, 1.0)
    return jnp.where(outside, (2.0 - inverse) * inverse * x, x)


def shrinkage(x: Float[Array, "*shape 3"]) -> Float[Array, "*shape"]:
    """Returns by how much `contract` scales a small Gaussian at `x`: `|det J|^(1/3)`.

    Where `|x| > 1` that is `(2 - 1 / |x|)^(2/3) |x|^(-4/3)`.
    """
    norm = numerics.length(x)
    inverse = 1.0 / jnp.where(norm > 1.0, norm, 1.0)
    return (2.0 - inverse) ** (2.0 / 3.0) * inverse ** (4.0 / 3.0)
