"""Colours of media and interfaces that are learned: a few numbers a part.

Light of a path is dimmed at every meeting with a part's surface, reflected or not, and on its way
through the part's medium: `exp(-sum_p (n_p density_p + length_p absorption_p))`. The tint of a
surface is `exp(-density)`. Both are kept from making light by a softplus, which has a gradient
everywhere.

Source: the law of Beer and Lambert; the tint is the colour of Blender Cycles' glass.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from refref_jax.optics.light_paths import LightPaths

# Almost white, but where the softplus still has a slope.
_INITIAL = -3.0


class Dyes(NamedTuple):
    """Learned colours, before the softplus, linear RGB.

    Attributes:
      density: optical density of a part's surface, per meeting.
      absorption: of its medium, per scene radius.
    """

    density: Float[Array, "parts 3"]
    absorption: Float[Array, "parts 3"]


def init(parts: int) -> Dyes:
    """Returns the colours of parts that are nearly clear."""
    # Two arrays, since training gives the buffers of both away.
    initial = (jnp.full((parts, 3), _INITIAL, jnp.float32) for _ in Dyes._fields)
    return Dyes(*initial)


def tints(dyes: Dyes) -> Float[Array, "parts 3"]:
    """Returns the factor of linear RGB light at every meeting with a part's surface."""
    return jnp.exp(-jax.nn.softplus(dyes.density))


def absorptions(dyes: Dyes, radius: float) -> Float[Array, "parts 3"]:
    """Returns the absorption of every part's medium, linear RGB, per world unit.

    Args:
      dyes: the colours.
      radius: of the scene, world units.
    """
    return jax.nn.softplus(dyes.absorption) / radius


def optical_density(dyes: Dyes | None) -> Float[Array, ""]:
    """Returns the mean density of all surfaces and of all media over a scene radius; 0 for none.

    A little of it in a loss settles what images leave open: a tint at both ends of a passage looks
    much like absorption between them, and takes far less density.
    """
    if dyes is None:
        return jnp.zeros(())
    return jnp.mean(jax.nn.softplus(dyes.density)) + jnp.mean(jax.nn.softplus(dyes.absorption))


def dye(dyes: Dyes | None, paths: LightPaths, *, radius: float) -> LightPaths:
    """Dims the light of paths by the colours of what they passed.

    Args:
      dyes: the colours; none leave the paths as they are.
      paths: any number, with their parts tallied.
      radius: of the scene, world units.
    """
    if dyes is None:
        return paths
    passed = paths.passages @ absorptions(dyes, radius)
    met = paths.meetings @ jax.nn.softplus(dyes.density)
    return paths._replace(weights=paths.weights * jnp.exp(-met - passed))
