"""Fresnel equations for unpolarised light. Symbols as in `snell`."""

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


def _amplitude(a: Float[Array, ""], b: Float[Array, ""]) -> Float[Array, ""]:
    return numerics.safe_divide(a - b, a + b)
