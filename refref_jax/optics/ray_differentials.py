"""Ray differentials: the footprint of a pixel along its traced ray.

To first order, the bundle of rays of a pixel is described by the derivatives of the central ray's
point and direction with respect to two coordinates across the pixel. They are propagated through
every bend by forward-mode differentiation of the steps that bend the ray. Behind a glass ball, the
footprint is several times wider than after the same distance in air, and a flat ellipse rather than
a disc.

The coordinates are scaled so that, at distance `t`, a straight ray has two orthogonal derivatives
of length `radius * t`: the cone of `Rays.radii`. Their orientation is arbitrary, since a square
pixel has the same second moments in all directions.

Source: Igehy, Tracing Ray Differentials (1999).
"""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from refref_jax import numerics
from refref_jax.choices import Footprint
from refref_jax.geometry.rays import Rays, orthonormal_basis

# Near the critical angle the derivatives are unbounded. A footprint of this width covers the
# scene, and its square is still finite.
_WIDEST = 1e6

_Result = TypeVar("_Result")


class RayDifferential(NamedTuple):
    """Ray differential: derivatives of a ray across its pixel; empty if they are not carried.

    Attributes:
      points: derivatives of the segment's start, world units.
      directions: derivatives of the segment's unit direction.
    """

    points: Float[Array, "*rays axes 3"]
    directions: Float[Array, "*rays axes 3"]


class Bend(NamedTuple):
    """Differentiated results of a ray's interaction with a surface.

    Attributes:
      point: hit point on the surface, world units.
      reflected: mirrored unit direction.
      transmitted: refracted unit direction.
    """

    point: Float[Array, "3"]
    reflected: Float[Array, "3"]
    transmitted: Float[Array, "3"]


def begin(ray: Rays, footprint: Footprint) -> RayDifferential:
    """Returns the ray differential of a camera ray: all rays of a pixel start at one point."""
    if footprint == "cone":
        return no_differential(ray.origins)
    sides = ray.radii * jnp.stack(orthonormal_basis(ray.directions))
    return RayDifferential(jnp.zeros_like(sides), sides)


def no_differential(like: Float[Array, "3"]) -> RayDifferential:
    """Returns the empty ray differential of a ray whose derivatives are not carried."""
    none = jnp.zeros((0, 3), like.dtype)
    return RayDifferential(none, none)


def bend(
    surface: Callable[[Array, Array, Array | None], tuple[Bend, _Result]],
    origin: Float[Array, "3"],
    direction: Float[Array, "3"],
    differential: RayDifferential,
    *,
    tilts: Float[Array, "2 2"] | None = None,
) -> tuple[_Result, RayDifferential, RayDifferential]:
    """Bends a ray and its differential.

    Args:
      surface: function of origin, direction and tilt of the surface (two slopes) that returns a
        `Bend` and an auxiliary output.
      origin: origin of the ray.
      direction: unit direction of the ray.
      differential: differential of the ray.
      tilts: tilt of the surface per unit of each coordinate across the pixel; 0 by default.

    Returns:
      The auxiliary output, and the differentials of the reflected and the transmitted ray.
    """
    if differential.points.shape[0] == 0:
        return surface(origin, direction, None)[1], differential, differential
    none = None if tilts is None else jnp.zeros(2, origin.dtype)
    _, push, result = jax.linearize(surface, origin, direction, none, has_aux=True)
    moved = jax.vmap(push)(differential.points, differential.directions, tilts)
    moved = jax.tree.map(lambda x: jnp.clip(x, -_WIDEST, _WIDEST), moved)
    return (
        result,
        RayDifferential(moved.point, moved.reflected),
        RayDifferential(moved.point, moved.transmitted),
    )


def across(
    differential: RayDifferential, along: Float[Array, ""], direction: Float[Array, "3"]
) -> Float[Array, "axes 3"]:
    """Returns the half axes of a footprint in the plane perpendicular to its ray.

    Args:
      differential: ray differential of the segment.
      along: distance from the segment's start, world units.
      direction: unit direction of the segment.
    """
    moved = differential.points + along * differential.directions
    rows = jnp.broadcast_to(direction, moved.shape)
    return moved - numerics.dot(moved, rows)[:, None] * rows
