"""Intersection test of one ray with one axis-aligned box.

A ray's *octant* is the set of axes along which its direction is negative, as a 3-bit number (x is
the lowest bit). All rays of an octant enter and leave a box through the same faces, so the slab
test needs no sorting: the *entry corner* is where the three entered faces meet, the *exit corner*
where the three exited faces meet.

Source: the slab method, Kay and Kajiya (1986).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from refref_jax import numerics

# The products of plane and origin with the reciprocal are each rounded once, by half a unit in the
# last place of the second. Two units cover both.
_SLACK = 2.4e-7

# Two roundings up on the far side, so that a triangle that lies in a box face is never culled.
_FAR_PADDING = 1.0000004


class Slabs(NamedTuple):
    """A ray prepared for box tests, computed once for all boxes.

    The distance to a plane is one fused multiply-add, `plane * reciprocal - offset`. The offset
    is rounded so that boxes are entered early and left late.

    Attributes:
      reciprocals: reciprocals of the direction's components, all finite.
      entries: offsets for the planes through which a box is entered.
      exits: offsets for the planes through which a box is left.
    """

    reciprocals: Float[Array, "3"]
    entries: Float[Array, "3"]
    exits: Float[Array, "3"]


def octant(direction: Float[Array, "3"]) -> Int[Array, ""]:
    """Returns the octant of a direction, 0 to 7; zeros count by their sign bit, as in `slabs`."""
    x, y, z = jnp.signbit(direction).astype(jnp.int32)
    return x + 2 * y + 4 * z


def slabs(origin: Float[Array, "3"], direction: Float[Array, "3"]) -> Slabs:
    """Prepares a ray for `overlaps`."""
    reciprocals = numerics.safe_reciprocal(direction)
    offsets = origin * reciprocals
    slack = _SLACK * jnp.abs(offsets)
    return Slabs(reciprocals, offsets + slack, offsets - slack)


def overlaps(
    ray: Slabs,
    entry: Float[Array, "3"],
    exit: Float[Array, "3"],
    limit: Float[Array, ""],
) -> Bool[Array, ""]:
    """Returns whether the ray passes through the box at a distance in `[0, limit]`.

    Args:
      ray: the ray, from `slabs`.
      entry: entry corner of the box in the octant of the ray.
      exit: exit corner of the box.
      limit: farthest distance of interest; a negative limit overlaps no box.
    """
    # Written out by components and with `where` instead of `minimum`, which would propagate NaN:
    # in a packet each line is then one instruction for eight rays.
    kind = ray.reciprocals.dtype  # boxes are in single precision, rays in any
    enter_x, enter_y, enter_z = entry.astype(kind) * ray.reciprocals - ray.entries
    leave_x, leave_y, leave_z = exit.astype(kind) * ray.reciprocals - ray.exits
    near = _larger(_larger(enter_x, enter_y), _larger(enter_z, jnp.zeros_like(enter_z)))
    far = _smaller(_smaller(leave_x, leave_y), leave_z) * _FAR_PADDING
    return near <= _smaller(far, limit)


def _larger(a: Float[Array, ""], b: Float[Array, ""]) -> Float[Array, ""]:
    return jnp.where(a > b, a, b)


def _smaller(a: Float[Array, ""], b: Float[Array, ""]) -> Float[Array, ""]:
    return jnp.where(a < b, a, b)
