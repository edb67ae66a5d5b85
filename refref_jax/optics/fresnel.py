"""Snell's law, the law of reflection, the Fresnel equations, and the microfacets of rough surfaces.

All of them are for one ray at one point of an interface.

Symbols, as in the paper (arXiv 2505.05848, section 4.2): `n` unit normal on the side the light
comes from; `beta = -d.n` the cosine of incidence, in `[0, 1]`; `nu_0`, `nu_1` the indices of
refraction on the near and on the far side; `alpha = nu_0 / nu_1`; `gamma` the cosine of the
transmitted ray, `gamma^2 = 1 - alpha^2 (1 - beta^2)`; `gamma^2 < 0` is total internal
reflection (TIR).

Light is unpolarised; interfaces are those of dielectrics, of conductors and of thin sheets.

A rough surface consists of microscopic facets, each of them smooth. A ray meets one facet, whose
normal `m` is drawn from the facets that the ray can see; it is reflected and refracted there by the
laws of smooth surfaces. Facets in front hide a part of the light that leaves (`masking`). The mean
over the rays of a pixel converges to the integral over all facets; light that several facets would
scatter in turn is lost, as in Cycles' distribution `GGX`.

Random numbers are a hash of the ray's hit point and direction. So a ray always meets the same
facet, two rays of a pixel meet different ones, and tracing needs no random key. Where it is known
which rays belong to a pixel, they share the numbers evenly at their first three bends: a Kronecker
sequence in six dimensions, shifted for each pixel, whose noise is lower.

Symbols of rough surfaces: `n` unit normal of the surface on the incident side, `m` unit normal of
the facet, `d` unit direction of the ray, `alpha` width of the distribution.

Sources: Walter et al., Microfacet Models for Refraction through Rough Surfaces (2007); Heitz,
Sampling the GGX Distribution of Visible Normals (2018).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt

from refref_jax import numerics
from refref_jax.geometry.rays import orthonormal_basis


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


# Constants of the 32-bit hash lowbias32 (Wellons, Prospecting for Hash Functions, 2018).
_FIRST, _SECOND = 0x7FEB352D, 0x846CA68B

# Steps of the sequences that a pixel's rays follow at their first bends: powers of the root of
# x^7 = x + 1 (Roberts, The Unreasonable Effectiveness of Quasirandom Sequences, 2018).
_EARLY_BENDS = 3
_STEPS = 1.1127756842787055 ** -np.arange(1.0, 1.0 + 2 * _EARLY_BENDS).reshape(_EARLY_BENDS, 2)

# Offset between the hashes of two numbers: the golden ratio times 2^32.
_NEXT = 0x9E3779B9


class Stratum(NamedTuple):
    """The place of a ray among those of its pixel.

    Attributes:
      pixel: index of the pixel.
      ray: index of the ray in the pixel.
      num_rays: number of rays in the pixel.
      num_bends: number of bends of the ray so far.
    """

    pixel: Int[Array, ""]
    ray: Int[Array, ""]
    num_rays: Int[Array, ""]
    num_bends: Int[Array, ""]


Pair = tuple[Float[Array, ""], Float[Array, ""]]
"""Two numbers in `[0, 1)`."""


def facet_normal(
    direction: Float[Array, "3"],
    normal: Float[Array, "3"],
    alpha: Float[Array, ""],
    numbers: Pair,
) -> Float[Array, "3"]:
    """Returns the unit normal of the facet that a ray meets; the surface's if `alpha` is 0.

    Args:
      direction: unit direction of the ray.
      normal: unit normal of the surface on the incident side.
      alpha: width of the distribution, >= 0.
      numbers: uniform numbers that select the facet.

    Source: Heitz (2018), listing 1.
    """
    tangent, bitangent = orthonormal_basis(normal)
    frame = jnp.stack([tangent, bitangent, normal])
    towards = -numerics.product(frame, direction)
    # The ray as seen by a hemisphere that is stretched to alpha = 1.
    stretched = numerics.normalize(towards * jnp.stack([alpha, alpha, jnp.ones_like(alpha)]))
    across, along = _disc_axes(stretched)
    radius, angle = numerics.safe_sqrt(numbers[0]), 2.0 * jnp.pi * numbers[1]
    u, v = radius * jnp.cos(angle), radius * jnp.sin(angle)
    half = 0.5 * (1.0 + stretched[2])
    v = (1.0 - half) * numerics.safe_sqrt(1.0 - jnp.square(u)) + half * v
    up = numerics.safe_sqrt(1.0 - jnp.square(u) - jnp.square(v))
    facet = u * across + v * along + up * stretched
    facet = jnp.stack([alpha * facet[0], alpha * facet[1], jnp.maximum(facet[2], 0.0)])
    return jnp.where(alpha > 0.0, numerics.normalize(numerics.product(facet, frame)), normal)


def tilted(facet: Float[Array, "3"], tilt: Float[Array, "2"]) -> Float[Array, "3"]:
    """Returns the unit normal of a facet, tilted by a slope.

    Args:
      facet: unit normal of the facet.
      tilt: slope along two directions in the facet.
    """
    return numerics.normalize(facet + numerics.product(tilt, jnp.stack(orthonormal_basis(facet))))


def spacing(alpha: Float[Array, ""], stratum: Stratum) -> Float[Array, "2 2"]:
    """Returns the distance between the facet slopes of neighbouring rays of a pixel, as two axes.

    `num_rays` cells cover the disc of slopes with radius `alpha`. Like `Rays.radii`, the length of
    the axes is the edge of a square cell over the root of 3, so it is `alpha / sqrt(num_rays)`
    within 3 %. It is 0 for a single ray, which would blur what it sees by all facets.

    Entry and exit of a body would cancel if they shared their axes: every other bend turns them.

    Args:
      alpha: width of the distribution, >= 0.
      stratum: place of the ray among those of its pixel.
    """
    cells = 3.0 / jnp.pi * jnp.maximum(stratum.num_rays, 1).astype(alpha.dtype)
    length = jnp.where(stratum.num_rays > 1, alpha / jnp.sqrt(cells), 0.0)
    zero = jnp.zeros_like(length)
    straight, turned = jnp.stack([length, zero]), jnp.stack([zero, length])
    odd = stratum.num_bends % 2 == 1
    return jnp.where(odd, jnp.stack([turned, -straight]), jnp.stack([straight, turned]))


def masking(
    cos_in: Float[Array, ""], cos_out: Float[Array, ""], alpha: Float[Array, ""]
) -> Float[Array, ""]:
    """Returns the share of the light from a facet that other facets do not hide, in `[0, 1]`.

    It is `G2 / G1`, the height-correlated masking and shadowing of both directions over the masking
    of the incident one.

    Args:
      cos_in: cosine between the surface's normal and the incident ray, in `[0, 1]`.
      cos_out: cosine between the outgoing ray and the surface's normal on its side; at or below 0
        it is on the wrong side of the surface, and the share is 0.
      alpha: width of the distribution, >= 0.

    Source: Heitz, Understanding the Masking-Shadowing Function (2014), equation 99.
    """
    above = cos_out > 0.0
    cos_out = jnp.where(above, cos_out, 1.0)
    here = cos_in + _slope_length(cos_in, alpha)
    product = here * cos_out
    excess = cos_in * jnp.maximum(_slope_length(cos_out, alpha) - cos_out, 0.0)
    return jnp.where(above, numerics.safe_divide(product, product + excess), 0.0)


def _slope_length(cosine: Float[Array, ""], alpha: Float[Array, ""]) -> Float[Array, ""]:
    """Returns `sqrt(cos^2 + alpha^2 sin^2)`, which is `cos (1 + 2 Lambda)`."""
    squared = jnp.square(cosine)
    return numerics.safe_sqrt(squared + jnp.square(alpha) * (1.0 - squared))


def _disc_axes(stretched: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Returns two unit axes perpendicular to a direction, the first one horizontal."""
    x, y, _ = stretched
    zero = jnp.zeros_like(x)
    tilted = (x != 0.0) | (y != 0.0)
    level = numerics.normalize(jnp.stack([-y, x, zero]))
    across = jnp.where(tilted, level, jnp.stack([jnp.ones_like(x), zero, zero]))
    return across, jnp.cross(stretched, across)


def uniform_pair(
    position: Float[Array, "3"], direction: Float[Array, "3"], *, stratum: Stratum | None = None
) -> Pair:
    """Returns two uniform numbers that the hit of a ray determines; they are constants.

    Args:
      position: hit point of the ray.
      direction: unit direction of the ray.
      stratum: place of the ray among those of its pixel, if it is known.
    """
    words = jax.lax.stop_gradient(jnp.concatenate([position, direction])).astype(jnp.float32)
    alone = _pair(jax.lax.bitcast_convert_type(words, jnp.uint32), position)
    if stratum is None:
        return alone
    shift = _pair(jnp.stack([stratum.pixel, stratum.num_bends]).astype(jnp.uint32), position)
    steps = jnp.asarray(_STEPS, position.dtype)
    step = steps[jnp.minimum(stratum.num_bends, _EARLY_BENDS - 1)]
    ray, early = stratum.ray.astype(position.dtype), stratum.num_bends < _EARLY_BENDS
    even = (jnp.mod(shift[i] + ray * step[i], 1.0) for i in range(2))
    first, second = (jnp.where(early, a, b) for a, b in zip(even, alone, strict=True))
    return first, second


def _pair(words: UInt[Array, " words"], like: Float[Array, "3"]) -> Pair:
    """Returns two uniform numbers as a hash of words."""
    state = jnp.uint32(0)
    for word in words:
        state = _mixed(state ^ word)
    return _unit(state, like), _unit(_mixed(state + jnp.uint32(_NEXT)), like)


def _mixed(state: UInt[Array, ""]) -> UInt[Array, ""]:
    state = (state ^ (state >> 16)) * jnp.uint32(_FIRST)
    state = (state ^ (state >> 15)) * jnp.uint32(_SECOND)
    return state ^ (state >> 16)


def _unit(state: UInt[Array, ""], like: Float[Array, "3"]) -> Float[Array, ""]:
    # 24 bits are what float32 holds exactly.
    return (state >> 8).astype(like.dtype) * 2.0**-24
