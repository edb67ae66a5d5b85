"""Every numerical guard of the library, in one place.

A guard keeps a value or a gradient finite where the plain formula would not. Each says what it
returns at its edge, what its gradient is there, and why that is the useful choice. Elsewhere a
value is clipped only where its meaning has a range, and nothing hides a NaN.

The pattern is the double `where`: JAX evaluates both branches of a `where` when it
differentiates, so the *argument* of the dangerous function is replaced as well as its result.
"""

import functools
import operator

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

# Directions closer to an axis than this are treated as parallel to the other two; a ray would
# have to travel 1e12 units before the difference shows.
_SMALLEST_COMPONENT = 1e-12

# Where `truncated_exponential` holds its value, and on either side its slope.
_LARGEST_EXPONENT = 40.0
_STEEPEST_EXPONENT = 15.0

# Rounding in the barycentric evaluation of a hit is a few units in the last place of the
# largest coordinate involved; eight of them clear it with room to spare.
_OFFSET_IN_ULPS = 8.0


def safe_sqrt(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Returns `sqrt(x)` where `x > 0`, else 0.

    At and below zero the gradient is 0 (the plain formula has infinity at 0 and NaN below).
    Just above zero it is the true `1 / (2 sqrt(x))`, which is unbounded.
    """
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


@jax.custom_jvp
def safe_divide(
    numerator: Float[Array, "*shape"], denominator: Float[Array, "*shape"]
) -> Float[Array, "*shape"]:
    """Returns `numerator / denominator`, and 0 with zero gradients where the denominator is 0.

    The gradient is formed from the quotient, never from the squared denominator, so it stays
    finite down to denominators whose square is below the smallest number.
    """
    nonzero = denominator != 0
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
    """Returns `1 / x`, with `|x|` held at 1e-12 or above and the sign of zero kept.

    For the slab test of rays parallel to a box face: the result is huge but finite, so that a
    product with zero stays zero and no NaN can arise. Not meant to be differentiated.
    """
    held = jnp.where(jnp.abs(x) < _SMALLEST_COMPONENT, jnp.copysign(_SMALLEST_COMPONENT, x), x)
    return 1.0 / held


def time_to_close(
    gap: Float[Array, "*shape"], speed: Float[Array, "*shape"]
) -> Float[Array, "*shape"]:
    """Returns `gap / speed`: when a gap closes that shrinks at a speed.

    `inf` with gradient 0 where the speed is not above 1e-12, and 0 with gradient 0 where the gap
    is closed already. Elsewhere the gradient is at most 1e12 times the quotient's own size.
    """
    closing = speed > _SMALLEST_COMPONENT
    left = jnp.where(gap > 0, gap, 0.0)
    return jnp.where(closing, left / jnp.where(closing, speed, 1.0), jnp.inf)


@jax.custom_jvp
def safe_atan2(y: Float[Array, "*shape"], x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Returns `atan2(y, x)`, and 0 with gradient 0 where the point is within 1e-12 of the origin.

    The gradient is formed from the unit vector, never from squares that vanish, and is at most
    1e12: it is unbounded, like `1 / sqrt(x^2 + y^2)`, as the origin is approached.
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
    """Returns the scalar product over the last axis, for vectors of few components.

    Component by component: XLA compiles a reduction over an axis of three into a loop of its own,
    which is three times slower and keeps its neighbours from being fused.
    """
    return _sum_components(a * b)


def length(vector: Float[Array, "*shape n"]) -> Float[Array, "*shape"]:
    """Returns the Euclidean norm over the last axis.

    Components are scaled by the largest first, so that neither 1e30 overflows nor 1e-30
    vanishes. The zero vector has length 0 and gradient 0.
    """
    scale = _scale(vector)
    return scale * safe_sqrt(_sum_components(jnp.square(vector / scale[..., None])))


def normalize(vector: Float[Array, "*shape n"]) -> Float[Array, "*shape n"]:
    """Returns the unit vector along the last axis; the zero vector stays zero, with gradient 0.

    Scaled like `length`, so any representable magnitude is normalised to rounding error.
    """
    scaled = vector / _scale(vector)[..., None]
    norm = length(scaled)[..., None]
    return scaled * safe_divide(jnp.ones_like(norm), norm)


def renormalize(vector: Float[Array, "*shape n"]) -> Float[Array, "*shape n"]:
    """Returns a vector that is a unit vector but for rounding, with its length mended.

    One step of Newton's method, without a division: an error `e` of the length leaves `1.5 e^2`.
    Other vectors stay finite, but not unit. The gradient is that of the formula: of `normalize`,
    but for `e`.
    """
    return vector * (1.5 - 0.5 * dot(vector, vector)[..., None])


def _sum_components(vector: Float[Array, "*shape n"]) -> Float[Array, "*shape"]:
    return functools.reduce(operator.add, (vector[..., i] for i in range(vector.shape[-1])))


def largest_component(vector: Float[Array, "*shape n"]) -> Float[Array, "*shape"]:
    """Returns the largest absolute component over the last axis, as a constant without gradient."""
    size = jax.lax.stop_gradient(jnp.abs(vector))
    return functools.reduce(jnp.maximum, (size[..., i] for i in range(size.shape[-1])))


def _scale(vector: Float[Array, "*shape n"]) -> Float[Array, "*shape"]:
    """Returns the largest absolute component, and 1 for the zero vector.

    Held at 8.5e37 in float32: compilers divide by a scale by multiplying with its reciprocal, which
    must stay a normal number.
    """
    largest = largest_component(vector)
    held = jnp.minimum(largest, 1.0 / jnp.finfo(vector.dtype).tiny)
    return jnp.where(largest > 0, held, 1.0)


def exponential_decay(
    rate: Float[Array, "*rates"], length: Float[Array, ""]
) -> Float[Array, "*rates"]:
    """Returns `exp(-rate * length)`, also over an infinite length.

    There a rate of 0 leaves everything and any other leaves nothing, both with gradient 0; the
    plain formula has NaN in the value of the first and in the gradient of the second. Over a
    finite length the gradients are the true ones, also at rate 0.
    """
    endless = jnp.isinf(length)
    decay = jnp.exp(-rate * jnp.where(endless, 0.0, length))
    return jnp.where(endless, jnp.where(rate > 0, 0.0, 1.0), decay)


@jax.custom_jvp
def truncated_exponential(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Returns `exp(x)`, held at `exp(40)`, with the slope held between `exp(-15)` and `exp(15)`.

    As a density 2e17 is opaque over every length that a float tells from 0, and its product with
    any length of a scene is a number. The slope is the true one for `|x| <= 15`; below, it never
    vanishes, so that a field which has become empty can come back.

    Source: the density of Nerfacto (`trunc_exp`, from torch-ngp), whose value is not held.
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
    """Returns where to restart a ray that leaves a surface, just off it.

    The step is proportional to `scale`, the largest coordinate that took part in computing
    `point`, because that sets the rounding error. At coordinates near 2 it is 2e-6 in float32: it
    clears the surface, and no wall worth modelling is that thin.

    Args:
      point: on the surface.
      towards: unit geometric normal on the side that the ray leaves to.
      scale: largest absolute coordinate involved, at least 0.

    Source: after Waechter and Binder, A Fast and Robust Method for Avoiding
    Self-Intersection, Ray Tracing Gems (2019), ch. 6.
    """
    return point + _OFFSET_IN_ULPS * jnp.finfo(point.dtype).eps * scale * towards
