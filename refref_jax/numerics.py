"""Numerical guards of the library.

A guard keeps a value or gradient finite where the plain formula would not. Each docstring states
the value and gradient at the singularity, and the reason for them. Elsewhere in the library, values
are clipped only to the range of their definition, and NaNs are never hidden.

The pattern is the double `where`: JAX evaluates both branches of a `where` when it differentiates,
so the *argument* of the singular function is replaced as well as its result.
"""

import functools
import operator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

# Direction components are clamped to at least this: a ray would have to travel 1e12 units before
# the difference matters.
_SMALLEST_COMPONENT = 1e-12

# Exponents at which `truncated_exponential` clamps its value, and, on both sides, its slope.
_LARGEST_EXPONENT = 40.0
_STEEPEST_EXPONENT = 15.0

# The rounding error of a hit point from barycentrics is a few units in the last place of the
# largest coordinate involved; eight units exceed it by a safe margin.
_OFFSET_IN_ULPS = 8.0


def safe_sqrt(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Returns `sqrt(x)` where `x > 0`, else 0.

    At and below zero the gradient is 0 (the plain formula gives infinity at 0 and NaN below).
    Above zero it is the true `1 / (2 sqrt(x))`, which is unbounded near 0.
    """
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


@jax.custom_jvp
def safe_divide(
    numerator: Float[Array, "*shape"], denominator: Float[Array, "*shape"]
) -> Float[Array, "*shape"]:
    """Returns `numerator / denominator`, and 0 with zero gradients where the denominator is 0.

    The gradient is computed from the quotient instead of the squared denominator, so it is finite
    even for denominators whose square underflows. Subnormal denominators count as 0 on all devices,
    as those of single precision do on a CPU: on a GPU, their reciprocals would be infinite.
    """
    nonzero = ~(jnp.abs(denominator) < jnp.finfo(denominator.dtype).tiny)
    return jnp.where(nonzero, numerator / jnp.where(nonzero, denominator, 1.0), 0.0)


@safe_divide.defjvp
def _safe_divide_jvp(
    primals: tuple[Array, Array], tangents: tuple[Array, Array]
) -> tuple[Array, Array]:
    numerator, denominator = primals
    quotient = safe_divide(numerator, denominator)
    change = tangents[0] - quotient * tangents[1]
    return quotient, safe_divide(change, denominator)


def safe_reciprocal(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Returns `1 / x`, with `|x|` clamped to at least 1e-12, respecting the sign of zero.

    This is for the slab test of rays parallel to a box face: the result is huge but finite, so that
    its product with zero is zero instead of NaN. Do not differentiate it.
    """
    held = jnp.where(jnp.abs(x) < _SMALLEST_COMPONENT, jnp.copysign(_SMALLEST_COMPONENT, x), x)
    return 1.0 / held


def time_to_close(
    gap: Float[Array, "*shape"], speed: Float[Array, "*shape"]
) -> Float[Array, "*shape"]:
    """Returns `gap / speed`, the time until a gap that shrinks at a speed is closed.

    The result is `inf` with gradient 0 if the speed is at most 1e-12, and 0 with gradient 0 if the
    gap is already closed. Elsewhere the gradient is at most 1e12 times the quotient.
    """
    closing = speed > _SMALLEST_COMPONENT
    left = jnp.where(gap > 0, gap, 0.0)
    return jnp.where(closing, left / jnp.where(closing, speed, 1.0), jnp.inf)


@jax.custom_jvp
def safe_atan2(y: Float[Array, "*shape"], x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Returns `atan2(y, x)`, and 0 with gradient 0 where the point is within 1e-12 of the origin.

    The gradient is computed from the unit vector instead of squares that underflow. It grows as
    `1 / sqrt(x^2 + y^2)` towards the origin, and is at most 1e12.
    """
    near = length(jnp.stack([x, y], axis=-1)) < _SMALLEST_COMPONENT
    return jnp.where(near, 0.0, jnp.arctan2(y, jnp.where(near, 1.0, x)))


@safe_atan2.defjvp
def _safe_atan2_jvp(
    primals: tuple[Array, Array], tangents: tuple[Array, Array]
) -> tuple[Array, Array]:
    y, x = primals
    radius = length(jnp.stack([x, y], axis=-1))
    near = radius < _SMALLEST_COMPONENT
    held = jnp.where(near, 1.0, radius)
    turn = ((x / held) * tangents[0] - (y / held) * tangents[1]) / held
    return safe_atan2(y, x), jnp.where(near, 0.0, turn)


def dot(a: Float[Array, "*shape n"], b: Float[Array, "*shape n"]) -> Float[Array, "*shape"]:
    """Returns the dot product over the last axis, for vectors of few components.

    It is computed component by component: XLA compiles a reduction over an axis of size 3 to a
    separate loop, which is three times slower and prevents fusion with neighbouring operations.
    """
    return _sum_components(a * b)


def product(a: Float[Array, "..."], b: Float[Array, "..."]) -> Float[Array, "..."]:
    """Returns the matrix product `a @ b`, with all digits of the factors on every device.

    GPUs and TPUs round the factors of other products to 10 or 7 bits.
    """
    return jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)


def length(vector: Float[Array, "*shape n"]) -> Float[Array, "*shape"]:
    """Returns the Euclidean norm over the last axis.

    Components are first scaled by the largest, so that 1e30 does not overflow and 1e-30 does not
    underflow. The zero vector has length 0 and gradient 0.
    """
    scale = _scale(vector)
    return scale * safe_sqrt(_sum_components(jnp.square(vector / scale[..., None])))


def normalize(vector: Float[Array, "*shape n"]) -> Float[Array, "*shape n"]:
    """Returns the unit vector along the last axis; the zero vector stays zero, with gradient 0.

    Components are scaled as in `length`, so vectors of any magnitude are normalised to rounding
    error.
    """
    scaled = vector / _scale(vector)[..., None]
    norm = length(scaled)[..., None]
    return scaled * safe_divide(jnp.ones_like(norm), norm)


def renormalize(vector: Float[Array, "*shape n"]) -> Float[Array, "*shape n"]:
    """Normalises a vector that is a unit vector up to rounding.

    This is one step of Newton's method, without a division: it reduces an error `e` of the length
    to `1.5 e^2`. Other vectors stay finite, but are not normalised. The gradient is that of the
    formula, which equals that of `normalize` up to `e`.
    """
    return vector * (1.5 - 0.5 * dot(vector, vector)[..., None])


def _sum_components(vector: Float[Array, "*shape n"]) -> Float[Array, "*shape"]:
    return functools.reduce(operator.add, (vector[..., i] for i in range(vector.shape[-1])))


def largest_component(vector: Float[Array, "*shape n"]) -> Float[Array, "*shape"]:
    """Returns the largest absolute component over the last axis, without gradient."""
    size = jax.lax.stop_gradient(jnp.abs(vector))
    return functools.reduce(jnp.maximum, (size[..., i] for i in range(size.shape[-1])))


def _scale(vector: Float[Array, "*shape n"]) -> Float[Array, "*shape"]:
    """Returns the largest absolute component, and 1 for the zero vector.

    The scale is clamped to at most 8.5e37 in float32: compilers replace the division by a
    multiplication with the reciprocal, which must be a normal number.
    """
    largest = largest_component(vector)
    held = jnp.minimum(largest, 1.0 / jnp.finfo(vector.dtype).tiny)
    return jnp.where(largest > 0, held, 1.0)


def exponential_decay(
    rate: Float[Array, "*rates"], length: Float[Array, ""]
) -> Float[Array, "*rates"]:
    """Returns `exp(-rate * length)`, including for infinite length.

    For infinite length the result is 1 if the rate is 0, and 0 for other rates, both with gradient
    0; the plain formula gives NaN in the value of the former and the gradient of the latter. For
    finite length the gradients are exact, including at rate 0.
    """
    endless = jnp.isinf(length)
    decay = jnp.exp(-rate * jnp.where(endless, 0.0, length))
    return jnp.where(endless, jnp.where(rate > 0, 0.0, 1.0), decay)


@jax.custom_jvp
def truncated_exponential(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Returns `exp(x)`, clamped to `exp(40)`, with slope clamped to `[exp(-15), exp(15)]`.

    A density of 2e17 is opaque over every length that a float can distinguish from 0, and its
    product with any length in a scene is finite. The slope is exact for `|x| <= 15`; below, it does
    not vanish, so that an empty field can recover.

    Source: the density of Nerfacto (`trunc_exp`, from torch-ngp), which does not clamp the value.
    """
    return jnp.exp(jnp.minimum(x, _LARGEST_EXPONENT))


@truncated_exponential.defjvp
def _truncated_exponential_jvp(
    primals: tuple[Array], tangents: tuple[Array]
) -> tuple[Array, Array]:
    (x,), (tangent,) = primals, tangents
    slope = jnp.exp(jnp.clip(x, -_STEEPEST_EXPONENT, _STEEPEST_EXPONENT))
    return truncated_exponential(x), slope * tangent


def offset_origin(
    point: Float[Array, "3"], towards: Float[Array, "3"], scale: Float[Array, ""]
) -> Float[Array, "3"]:
    """Returns the origin of a ray that leaves a surface, offset from the surface.

    The offset is proportional to `scale`, the largest coordinate used to compute `point`, which
    determines the rounding error. At coordinates near 2 the offset is 2e-6 in float32, which clears
    the surface and is much thinner than any modelled wall.

    Args:
      point: point on the surface.
      towards: unit geometric normal on the side of the new ray.
      scale: largest absolute coordinate involved, at least 0.

    Source: after Waechter and Binder, A Fast and Robust Method for Avoiding
    Self-Intersection, Ray Tracing Gems (2019), ch. 6.
    """
    return point + _OFFSET_IN_ULPS * jnp.finfo(point.dtype).eps * scale * towards


def host_array(values: np.ndarray | np.generic) -> Any:
    """Returns NumPy values as they are, for a record whose fields are annotated as arrays of JAX.

    Records such as `Surfaces` are built on the host and hold NumPy arrays until JAX moves them to a
    device. JAX takes both, so the type is left open here, and the annotations of the fields stay
    those of the functions that compute with them.
    """
    return values
