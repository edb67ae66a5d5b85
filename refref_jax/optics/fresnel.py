"""Fresnel equations for unpolarised light at dielectrics, conductors and thin sheets.

Symbols as in `snell`.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from refref_jax import numerics
from refref_jax.optics import snell


def reflectance(
    beta: Float[Array, ""], index_near: Float[Array, ""], index_far: Float[Array, ""]
) -> Float[Array, ""]:
    """Returns the fraction of light that a smooth dielectric interface reflects, in `[0, 1]`.

    `R = (R_p + R_s) / 2` with `R_p = ((nu_1 beta - nu_0 gamma) / (nu_1 beta + nu_0 gamma))^2`
    and `R_s = ((nu_0 beta - nu_1 gamma) / (nu_0 beta + nu_1 gamma))^2`; 1 in total internal
    reflection. Equal indices give 0 at every angle, including grazing incidence, where the plain
    formula is 0/0; the gradient there is 0. Just below the critical angle the gradient is
    unbounded, like that of `snell.transmission`; beyond it, it is 0.

    Args:
      beta: cosine of incidence, in `[0, 1]`.
      index_near: index of refraction on the incident side, > 0.
      index_far: index on the other side, > 0.

    Source: paper, Fresnel equations; Hecht, Optics, section 4.6.
    """
    gamma, total = snell.transmission(beta, index_near, index_far)
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
