"""Snell's law, the law of reflection and the Fresnel equations at one point of an interface.

Symbols, as in the paper (arXiv 2505.05848, section 4.2): `n` unit normal on the side the light
comes from; `beta = -d.n` the cosine of incidence, in `[0, 1]`; `nu_0`, `nu_1` the indices of
refraction on the near and on the far side; `alpha = nu_0 / nu_1`; `gamma` the cosine of the
transmitted ray, `gamma^2 = 1 - alpha^2 (1 - beta^2)`; `gamma^2 < 0` is total internal
reflection (TIR).

Light is unpolarised; interfaces are those of dielectrics, of conductors and of thin sheets.
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


def reflectance(
    beta: Float[Array, ""], index_near: Float[Array, ""], index_far: Float[Array, ""]
) -> Float[Array, ""]:
    """Returns the fraction of light that a smooth dielectric interface reflects, in `[0, 1]`.

    `R = (R_p + R_s) / 2` with `R_p = ((nu_1 beta - nu_0 gamma) / (nu_1 beta + nu_0 gamma))^2`
    and `R_s = ((nu_0 beta - nu_1 gamma) / (nu_0 beta + nu_1 gamma))^2`; 1 in total internal
    reflection. Equal indices give 0 at every angle, including grazing incidence, where the plain
    formula is 0/0; the gradient there is 0. Just below the critical angle the gradient is
    unbounded, like that of `transmission`; beyond it, it is 0.

    Args:
      beta: cosine of incidence, in `[0, 1]`.
      index_near: index of refraction on the incident side, > 0.
      index_far: index on the other side, > 0.

    Source: paper, Fresnel equations; Hecht, Optics, section 4.6.
    """
    gamma, total = transmission(beta, index_near, index_far)
    parallel = _amplitude(index_far * beta, index_near * gamma)
    perpendicular = _amplitude(index_near * beta, index_far * gamma)
    partial = 0.5 * (jnp.square(parallel) + jnp.square(perpendicular))
    return jnp.where(total, 1.0, jnp.where(index_near == index_far, 0.0, partial))


def conductor_reflectance(
    beta: Float[Array, ""], eta: Float[Array, "3"], k: Float[Array, "3"]
) -> Float[Array, "3"]:
    """Returns the fraction of linear RGB light that a smooth conductor reflects, in `[0, 1]`.

    The formula is that of a complex index `eta + i k`; `k = 0` gives the reflectance of a
    dielectric of index `eta` >= 1. At grazing incidence everything is reflected.

    Args:
      beta: cosine of incidence, in `[0, 1]`.
      eta: real part of the index, relative to the surrounding medium, > 0.
      k: imaginary part, relative to the surrounding medium, >= 0.

    Source: Born and Wolf, Principles of Optics, section 14.2, as written by Lagarde, Memo on
    Fresnel equations (2013).
    """
    cos2 = jnp.square(beta)
    sin2 = 1.0 - cos2
    real = jnp.square(eta) - jnp.square(k) - sin2
    both = numerics.safe_sqrt(jnp.square(real) + 4.0 * jnp.square(eta * k))
    a = 2.0 * beta * numerics.safe_sqrt(0.5 * (both + real))
    perpendicular = numerics.safe_divide(both + cos2 - a, both + cos2 + a)
    c, d = cos2 * both + jnp.square(sin2), a * sin2
    parallel = perpendicular * numerics.safe_divide(c - d, c + d)
    return jnp.clip(0.5 * (perpendicular + parallel), 0.0, 1.0)


def sheet_reflectance(reflectance: Float[Array, ""]) -> Float[Array, ""]:
    """Returns the fraction of light that a thin wall reflects, of the reflectance of one side.

    Light that is reflected inside the wall any number of times is summed: `2 R / (1 + R)`.

    Source: the geometric series; Mitsuba's `thindielectric`.
    """
    return 2.0 * reflectance / (1.0 + reflectance)


def _amplitude(a: Float[Array, ""], b: Float[Array, ""]) -> Float[Array, ""]:
    return numerics.safe_divide(a - b, a + b)
