"""Interfaces between media: what a ray crosses when it meets a mesh part.

Every part is the boundary of a body and has an index of refraction on its inside and one on its
outside. A *medium* is named by an integer: 0 is the surrounding air (`AMBIENT`), `1 + k` is the
inside of part `k`.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

AMBIENT = 0
"""The medium outside every body."""


class Interfaces(NamedTuple):
    """The interfaces of a scene, one a part; made by `interface_rules`.

    Attributes:
      index_inside: index of refraction inside the part.
      index_outside: index on the other side of its surface.
      medium_outside: the medium on the other side.
    """

    index_inside: Float[Array, " parts"]
    index_outside: Float[Array, " parts"]
    medium_outside: Int[Array, " parts"]


class Crossing(NamedTuple):
    """The two sides of an interface as a ray meets them.

    Attributes:
      index_near: index of refraction on the incident side.
      index_far: index on the other side.
      medium_near: medium on the incident side.
      medium_far: medium on the other side.
    """

    index_near: Float[Array, ""]
    index_far: Float[Array, ""]
    medium_near: Int[Array, ""]
    medium_far: Int[Array, ""]


def crossing(interfaces: Interfaces, part: Int[Array, ""], entering: Bool[Array, ""]) -> Crossing:
    """Returns the media of a ray that meets a part from outside (`entering`) or from inside."""
    index_inside = interfaces.index_inside[part]
    index_outside = interfaces.index_outside[part]
    inside = part + 1
    outside = interfaces.medium_outside[part]
    return Crossing(
        index_near=jnp.where(entering, index_outside, index_inside),
        index_far=jnp.where(entering, index_inside, index_outside),
        medium_near=jnp.where(entering, outside, inside),
        medium_far=jnp.where(entering, inside, outside),
    )
