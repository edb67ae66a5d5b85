"""Snell's law and the law of reflection at one point of an interface.

Symbols, as in the paper (arXiv 2505.05848, section 4.2): `n` unit normal on the side the light
comes from; `beta = -d.n` the cosine of incidence, in `[0, 1]`; `nu_0`, `nu_1` the indices of
refraction on the near and on the far side; `alpha = nu_0 / nu_1`; `gamma` the cosine of the
transmitted ray, `gamma^2 = 1 - alpha^2 (1 - beta^2)`; `gamma^2 < 0` is total internal
reflection (TIR).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from refref_jax import numerics


class Transmission(NamedTuple):
    """Transmission through an interface.

    Attributes:
      cosine: `gamma`, 0 in total internal reflection.
      total: whether reflection is total.
    """

    cosine: Float[Array, ""]
    total: Bool[Array, ""]


def transmission(
    beta: Float[Array, ""], index_near: Float[Array, ""], index_far: Float[Array, ""]
) -> Transmission:
    """Returns the cosine of the transmitted ray (the paper's `gamma`).

    It is computed as `gamma^2 = ((nu_1 - nu_0)(nu_1 + nu_0) + (nu_0 beta)^2) / nu_1^2`, which
    equals the paper's form but avoids its cancellation: with equal indices `gamma = beta` down to
    the smallest `beta`.

    Towards the critical angle, the gradient is unbounded, as `1 / gamma`; at it and beyond, it is
    0.
    """
    contrast = (index_far - index_near) * (index_far + index_near)
    squared = (contrast + jnp.square(index_near * beta)) / jnp.square(index_far)
    return Transmission(numerics.safe_sqrt(squared), squared < 0.0)


def reflect(direction: Float[Array, "3"], normal: Float[Array, "3"]) -> Float[Array, "3"]:
    """Returns the mirrored direction, for a unit normal on either side.

    Source: paper, law of reflection and total internal reflection.
    """
    return direction - 2.0 * numerics.dot(direction, normal) * normal


def refract(
    direction: Float[Array, "3"],
    normal: Float[Array, "3"],
    index_near: Float[Array, ""],
    index_far: Float[Array, ""],
) -> Float[Array, "3"]:
    """Returns the refracted unit direction, `alpha d + (alpha beta - gamma) n`.

    In total internal reflection there is no refracted ray; the result is then the tangent for
    `gamma = 0`, which is finite and longer than 1.

    Args:
      direction: incident unit direction.
      normal: unit normal on the incident side (`-direction . normal >= 0`).
      index_near: index of refraction on the incident side, > 0.
      index_far: index on the other side, > 0.

    Source: paper, Snell's law in vector form (Born and Wolf).
    """
    alpha = index_near / index_far
    beta = -numerics.dot(direction, normal)
    gamma = transmission(beta, index_near, index_far).cosine
    return alpha * direction + (alpha * beta - gamma) * normal
