"""How the rays of one pixel spread around the one that is traced: ray differentials.

A pixel is seen along a bundle of rays. To first order the bundle is known by how its middle ray
moves with two coordinates across the pixel: the derivatives of point and direction, carried through
every bend by forward-mode differentiation of the very steps that bend the ray. Behind a ball of
glass a pixel is several times wider than behind as much air, and a flat ellipse rather than a disc.

Coordinates are such that a ray which never bends has, at distance `t`, two derivatives at right
angles of length `radius * t`: the cone of `Rays.radii`. Which way they point is arbitrary, since a
square pixel has the same second moments in all directions.

Source: Igehy, Tracing Ray Differentials (1999).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from refref_jax import numerics
from refref_jax.choices import Footprint
from refref_jax.geometry.rays import Rays, orthonormal_basis

# Where a bundle is focused on the critical angle its derivatives have no bound. A footprint as
# wide as this blurs all there is, and its square is still a number.
_WIDEST = 1e6


class Spread(NamedTuple):
    """The derivatives of a ray across its pixel; no axis at all where none are carried.

    Attributes:
      points: of the start of the segment, world units.
      directions: of its unit direction.
    """

    points: Float[Array, "*rays axes 3"]
    directions: Float[Array, "*rays axes 3"]


class Bend(NamedTuple):
    """What a surface makes of a ray, as far as it is differentiated.

    Attributes:
      point: on the surface, world units.
      reflected: mirrored unit direction.
      transmitted: refracted unit direction.
    """

    point: Float[Array, "3"]
    reflected: Float[Array, "3"]
    transmitted: Float[Array, "3"]


def begin(ray: Rays, footprint: Footprint) -> Spread:
    """Returns the spread of a camera ray: all rays of a pixel start in one point."""
    if footprint == "cone":
        return nothing(ray.origins)
    sides = ray.radii * jnp.stack(orthonormal_basis(ray.directions))
    return Spread(jnp.zeros_like(sides), sides)


def nothing(like: Float[Array, "3"]) -> Spread:
    """Returns the spread of a ray whose derivatives are not carried."""
    none = jnp.zeros((0, 3), like.dtype)
    return Spread(none, none)


def bend(
    surface: Callable[[Array, Array], tuple[Bend, object]],
    origin: Float[Array, "3"],
    direction: Float[Array, "3"],
    spread: Spread,
) -> tuple[object, Spread, Spread]:
    """Bends a ray and what is carried with it.

    Args:
      surface: takes origin and direction of a ray; returns where it bends it to, and anything.
      origin: of the ray.
      direction: of the ray.
      spread: of the ray.

    Returns:
      What `surface` returned besides, and the spreads of the reflected and the transmitted ray.
    """
    if spread.points.shape[0] == 0:
        return surface(origin, direction)[1], spread, spread
    _, push, result = jax.linearize(surface, origin, direction, has_aux=True)
    moved = jax.vmap(push)(spread.points, spread.directions)
    moved = jax.tree.map(lambda x: jnp.clip(x, -_WIDEST, _WIDEST), moved)
    return result, Spread(moved.point, moved.reflected), Spread(moved.point, moved.transmitted)


def across(
    spread: Spread, along: Float[Array, ""], direction: Float[Array, "3"]
) -> Float[Array, "axes 3"]:
    """Returns the half axes of a footprint that is cut across its ray.

    Args:
      spread: of the segment.
      along: distance from the segment's start, world units.
      direction: of the segment.
    """
    moved = spread.points + along * spread.directions
    rows = jnp.broadcast_to(direction, moved.shape)
    return moved - numerics.dot(moved, rows)[:, None] * rows
