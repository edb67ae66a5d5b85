"""Rays: where light is followed from.

World frame and world units throughout. Directions are unit vectors, so a distance along a ray
is arc length, never depth along an optical axis.
"""

from typing import NamedTuple

from jaxtyping import Array, Float


class Rays(NamedTuple):
    """A ray, or a batch of them along the leading axes.

    Attributes:
      origins: start points, world units.
      directions: unit vectors.
      radii: footprint of a pixel as the radius of its cone at unit distance (world units per
        world unit).
    """

    origins: Float[Array, "*rays 3"]
    directions: Float[Array, "*rays 3"]
    radii: Float[Array, "*rays"]
