import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax import numerics
from tests.laws import gradients, transformations

# A few float32 roundings.
_ROUNDING = 5e-7

_EPSILON = np.finfo(np.float32).eps
_TINY = np.finfo(np.float32).tiny

# Every magnitude of float32 that is a normal number, from the smallest up.
_POSITIVE = np.array([_TINY, *(10.0 ** np.arange(-37, 39))], np.float32)
_LATTICE = np.concatenate([-_POSITIVE[::-1], [-0.0, 0.0], _POSITIVE]).astype(np.float32)

_DIRECTIONS = np.array(
    [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.6, 0.0, -0.8], [1.0, 1.0, 1.0], [1.0, 1e-9, -1e-20]],
    np.float32,
)

_MAGNITUDES = [1e-37, 1e-30, 1e-6, 1.0, 1e6, 1e30, 1e38]


def _vectors(magnitude):
    """Returns vectors of a magnitude; components that are no normal numbers are 0."""
    vectors = _DIRECTIONS * np.float32(magnitude)
    return np.where(abs(vectors) < _TINY, np.float32(0.0), vectors)


_safe_sqrt = jax.jit(numerics.safe_sqrt)
_safe_divide = jax.jit(numerics.safe_divide)
_safe_reciprocal = jax.jit(numerics.safe_reciprocal)
_length = jax.jit(numerics.length)
_normalize = jax.jit(numerics.normalize)
_offset_origin = jax.jit(numerics.offset_origin)
_normalize_jacobian = jax.jit(jax.jacrev(numerics.normalize))


@functools.partial(jax.jit, static_argnums=0)
def _compiled_gradient(function, *arguments):
    total = lambda *x: jnp.sum(function(*x))
    return jax.grad(total, argnums=tuple(range(len(arguments))))(*arguments)


def _gradient(function, *arguments):
    """Returns the gradients of a function of arrays, element by element."""
    return _compiled_gradient(function, *map(jnp.asarray, arguments))


def test_safe_sqrt_over_all_magnitudes():
    got = _safe_sqrt(jnp.asarray(_LATTICE))
    expected = np.sqrt(np.maximum(_LATTICE, 0.0).astype(np.float64))
    np.testing.assert_allclose(got, expected, rtol=_ROUNDING)


def test_safe_sqrt_gradient_over_all_magnitudes():
    (gradient,) = _gradient(numerics.safe_sqrt, _LATTICE)
    held = np.where(_LATTICE > 0.0, _LATTICE, 1.0).astype(np.float64)
    expected = np.where(_LATTICE > 0.0, 0.5 / np.sqrt(held), 0.0)
    assert np.isfinite(gradient).all()
    np.testing.assert_allclose(gradient, expected, rtol=_ROUNDING)


@pytest.mark.parametrize("x", [-np.inf, -1.0, -_TINY, -0.0, 0.0])
def test_safe_sqrt_gradient_is_exactly_zero_at_and_below_zero(x):
    for derivative in (jax.jacrev, jax.jacfwd):
        assert jax.jit(derivative(numerics.safe_sqrt))(jnp.float32(x)) == 0.0


def test_safe_divide_over_all_magnitudes():
    numerator, denominator = (x.ravel() for x in np.meshgrid(_LATTICE, _LATTICE))
    wide = denominator.astype(np.float64)
    expected = np.where(wide != 0.0, numerator / np.where(wide != 0.0, wide, 1.0), 0.0)
    representable = (expected == 0.0) | ((abs(expected) >= _TINY) & (abs(expected) < 3e38))
    got = _safe_divide(jnp.asarray(numerator), jnp.asarray(denominator))
    np.testing.assert_allclose(got[representable], expected[representable], rtol=_ROUNDING)


@pytest.mark.parametrize("numerator", [0.0, 1.0, -1e30, np.inf])
@pytest.mark.parametrize("denominator", [0.0, -0.0, 1e-40, -1e-45])
def test_safe_divide_by_zero_is_zero_with_zero_gradients(numerator, denominator):
    arguments = np.float32(numerator), np.float32(denominator)
    assert _safe_divide(*map(jnp.asarray, arguments)) == 0.0
    assert _gradient(numerics.safe_divide, *arguments) == (0.0, 0.0)


def test_safe_divide_hides_no_nan():
    nan = np.float32(np.nan)
    assert np.isnan(_safe_divide(jnp.ones(()), jnp.asarray(nan)))
    assert np.isnan(_safe_divide(jnp.asarray(nan), jnp.ones(())))
    assert np.isnan(_gradient(numerics.safe_divide, np.float32(1.0), nan)).all()


@pytest.mark.parametrize("magnitude", [1e-35, 1e-25, 1e-18, 1.0, 1e18, 1e25, 1e35])
def test_safe_divide_gradient_is_finite_where_the_square_is_not_representable(magnitude):
    size = np.float32(magnitude)
    by_numerator, by_denominator = _gradient(numerics.safe_divide, 2.0 * size, size)
    np.testing.assert_allclose(by_numerator, 1.0 / magnitude, rtol=_ROUNDING)
    np.testing.assert_allclose(by_denominator, -2.0 / magnitude, rtol=_ROUNDING)


def test_safe_reciprocal_over_all_magnitudes():
    # The reciprocal of more than 1e37 is no normal number.
    x = _LATTICE[abs(_LATTICE) < 5e37]
    expected = 1.0 / np.copysign(np.maximum(abs(x).astype(np.float64), 1e-12), x)
    np.testing.assert_allclose(_safe_reciprocal(jnp.asarray(x)), expected, rtol=_ROUNDING)


def test_safe_reciprocal_times_zero_is_zero():
    assert (0.0 * _safe_reciprocal(jnp.asarray(_LATTICE)) == 0.0).all()


@pytest.mark.parametrize(
    ("vector", "expected"),
    [
        ([3.0, 4.0, 0.0], 5.0),
        ([-2.0, 3.0, -6.0], 7.0),
        ([0.0, 0.0, 0.0], 0.0),
        ([-2.0], 2.0),
        ([1.0, 1.0, 1.0, 1.0, 0.0], 2.0),
    ],
)
def test_length_by_hand(vector, expected):
    np.testing.assert_allclose(_length(jnp.array(vector)), expected, rtol=_ROUNDING)


@pytest.mark.parametrize("magnitude", _MAGNITUDES)
def test_length_over_magnitudes(magnitude):
    vectors = _vectors(magnitude)
    expected = np.linalg.norm(vectors.astype(np.float64), axis=-1)
    np.testing.assert_allclose(_length(jnp.asarray(vectors)), expected, rtol=_ROUNDING)


@pytest.mark.parametrize("magnitude", _MAGNITUDES)
def test_length_gradient_is_the_unit_vector_at_any_magnitude(magnitude):
    vectors = _vectors(magnitude)
    wide = vectors.astype(np.float64)
    unit = wide / np.linalg.norm(wide, axis=-1, keepdims=True)
    (gradient,) = _gradient(numerics.length, vectors)
    np.testing.assert_allclose(gradient, unit, rtol=_ROUNDING, atol=_ROUNDING)


def test_length_of_zero_has_zero_gradient():
    (gradient,) = _gradient(numerics.length, np.zeros((2, 3), np.float32))
    np.testing.assert_array_equal(gradient, np.zeros((2, 3)))


def test_length_keeps_leading_axes():
    assert _length(jnp.ones((4, 2, 3))).shape == (4, 2)


def test_normalize_by_hand():
    got = _normalize(jnp.array([[3.0, 0.0, -4.0], [0.0, 0.0, 0.5]]))
    np.testing.assert_allclose(got, [[0.6, 0.0, -0.8], [0.0, 0.0, 1.0]], rtol=_ROUNDING)


def test_normalize_keeps_zero_with_zero_gradient():
    zero = jnp.zeros(3)
    np.testing.assert_array_equal(_normalize(zero), zero)
    for jacobian in (jax.jacrev, jax.jacfwd):
        got = jax.jit(jacobian(numerics.normalize))(zero)
        np.testing.assert_array_equal(got, np.zeros((3, 3)))


@pytest.mark.parametrize("magnitude", _MAGNITUDES)
def test_normalize_over_magnitudes(magnitude):
    vectors = _vectors(magnitude)
    wide = vectors.astype(np.float64)
    expected = wide / np.linalg.norm(wide, axis=-1, keepdims=True)
    got = _normalize(jnp.asarray(vectors))
    np.testing.assert_allclose(got, expected, rtol=_ROUNDING)


# At 1e-38 the entries of the Jacobian, of size 1 / |v|, reach the largest number.
@pytest.mark.parametrize("magnitude", [1e-36, 1e-30, 1e-6, 1.0, 1e6, 1e30, 1e36])
def test_normalize_gradient_projects_and_divides_by_the_length(magnitude):
    for vector in _vectors(magnitude):
        wide = vector.astype(np.float64)
        norm = np.linalg.norm(wide)
        expected = np.eye(3) - np.outer(wide, wide) / norm**2
        got = np.asarray(_normalize_jacobian(jnp.asarray(vector)), np.float64) * norm
        np.testing.assert_allclose(got, expected, rtol=1e-6, atol=1e-6)


_NORMALS = np.array(
    [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.6, -0.8, 0.0], [1.0, 1.0, 1.0] / np.sqrt(3.0)],
    np.float32,
)

# Rounding the moved point costs up to half a unit in the last place on each axis.
_STEP_BOUNDS_IN_ULPS = (7.0, 9.0)


def _offset(point, towards, scale):
    return _offset_origin(*(jnp.asarray(x, jnp.float32) for x in (point, towards, scale)))


@pytest.mark.parametrize("coordinate", [1e-3, 1e-1, 1.0, 2.0, 1e2, 1e4, 1e6])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_offset_origin_steps_off_the_surface(coordinate, side):
    low, high = (bound * _EPSILON * coordinate for bound in _STEP_BOUNDS_IN_ULPS)
    points = np.float32(coordinate) * np.array(
        [[1.0, 1.0, 1.0], [-1.0, 0.3, 0.0], [0.0, 0.7, -1.0]], np.float32
    )
    for point, normal in itertools.product(points, _NORMALS):
        step = np.asarray(_offset(point, side * normal, coordinate), np.float64) - point
        assert low <= side * np.dot(step, normal) <= high
        assert np.linalg.norm(step) <= high


def test_offset_origin_with_no_scale_is_the_point():
    point = np.array([0.4, -0.3, 1.0], np.float32)
    np.testing.assert_array_equal(_offset(point, _NORMALS[3], 0.0), point)


def test_offset_origin_moves_with_its_point():
    rest = (jnp.asarray(_NORMALS[2]), jnp.float32(1.0))
    jacobian = jax.jacrev(numerics.offset_origin)(jnp.ones(3), *rest)
    np.testing.assert_array_equal(jacobian, np.eye(3))


# --- dot, renormalize ---


def test_dot_is_the_scalar_product():
    a, b = np.random.default_rng(0).normal(size=(2, 50, 3)).astype(np.float32)
    np.testing.assert_allclose(
        numerics.dot(jnp.asarray(a), jnp.asarray(b)), np.sum(a * b, axis=-1), atol=1e-6
    )
    gradients.assert_numerical(numerics.dot, a, b)


@pytest.mark.parametrize("error", [-1e-3, -1e-6, 0.0, 1e-6, 1e-3])
def test_renormalize_mends_the_length_of_a_unit_vector(error):
    unit = np.array([0.6, 0.0, -0.8], np.float32)
    mended = numerics.renormalize(jnp.asarray((1.0 + error) * unit, jnp.float32))
    np.testing.assert_allclose(mended, unit, atol=1.6 * error**2 + 2.0 * _EPSILON)


def test_renormalize_stays_finite_where_a_vector_is_not_unit():
    for vector in (np.zeros(3), np.full(3, 1e3), np.full(3, 1e-30)):
        value = numerics.renormalize(jnp.asarray(vector, jnp.float32))
        assert np.all(np.isfinite(value))


# --- transformations ---


@pytest.mark.parametrize(
    ("gap", "speed", "expected"),
    [
        (3.0, 2.0, 1.5),
        (0.0, 2.0, 0.0),
        (-1.0, 2.0, 0.0),
        (3.0, 0.0, np.inf),
        (3.0, -2.0, np.inf),
        (0.0, 0.0, np.inf),
        (3.0, 1e-13, np.inf),
    ],
)
def test_time_to_close_by_hand(gap, speed, expected):
    found = numerics.time_to_close(jnp.float32(gap), jnp.float32(speed))
    np.testing.assert_allclose(found, np.float32(expected), rtol=_ROUNDING)


def test_gradients_of_time_to_close_are_finite():
    gap, speed = np.meshgrid([-1.0, 0.0, 1e-20, 1.0, 1e6], [-1.0, 0.0, 1e-13, 1e-11, 1.0])
    derive = jax.vmap(jax.grad(numerics.time_to_close, (0, 1)))
    by_gap, by_speed = derive(*(jnp.asarray(x.ravel(), jnp.float32) for x in (gap, speed)))
    assert gradients.all_finite((by_gap, by_speed))
    still = (speed.ravel() < 1e-12) | (gap.ravel() <= 0.0)
    assert np.all(np.asarray(by_gap)[still] == 0.0) and np.all(np.asarray(by_speed)[still] == 0.0)


def test_safe_atan2_is_numpy_s_over_all_magnitudes():
    y, x = np.meshgrid(_LATTICE, _LATTICE)
    found = np.asarray(jax.jit(numerics.safe_atan2)(jnp.asarray(y), jnp.asarray(x)))
    away = np.hypot(y.astype(float), x) > 2e-12
    np.testing.assert_allclose(found[away], np.arctan2(y, x)[away], rtol=1e-6, atol=1e-37)
    assert np.all(found[np.hypot(y.astype(float), x) < 5e-13] == 0.0)


@pytest.mark.parametrize("magnitude", [0.0, 1e-38, 1e-20, 1e-13, 1e-11, 1.0, 1e30])
def test_gradients_of_safe_atan2_are_finite_and_end_at_the_origin(magnitude):
    y, x = jnp.float32(magnitude), jnp.float32(-magnitude)
    by_y, by_x = jax.grad(numerics.safe_atan2, (0, 1))(y, x)
    expected = -0.5 / magnitude if magnitude > 1e-12 else 0.0
    np.testing.assert_allclose([by_y, by_x], [expected, expected], rtol=1e-5, atol=1e-37)


_VECTORS = np.concatenate([_DIRECTIONS, np.zeros((1, 3), np.float32)])
_SCALARS = np.array([-1.0, 0.0, 1e-20, 0.5, 3.0, 1e20], np.float32)

_CASES = {
    "safe_sqrt": (numerics.safe_sqrt, (_SCALARS,)),
    "safe_divide": (numerics.safe_divide, (_SCALARS[::-1], _SCALARS)),
    "safe_reciprocal": (numerics.safe_reciprocal, (_SCALARS,)),
    "time_to_close": (numerics.time_to_close, (_SCALARS[::-1], _SCALARS)),
    "safe_atan2": (numerics.safe_atan2, (_SCALARS[::-1], _SCALARS)),
    "length": (numerics.length, (_VECTORS,)),
    "normalize": (numerics.normalize, (_VECTORS,)),
    "truncated_exponential": (numerics.truncated_exponential, (_SCALARS,)),
    "offset_origin": (
        numerics.offset_origin,
        (_VECTORS, _VECTORS[::-1], abs(_SCALARS)),
    ),
}


@pytest.mark.parametrize("transformation", transformations.ALL)
@pytest.mark.parametrize("name", _CASES)
def test_transformations_change_nothing(name, transformation):
    function, batches = _CASES[name]
    transformation(function, tuple(jnp.asarray(np.ascontiguousarray(x)) for x in batches))


@pytest.mark.parametrize(
    ("function", "arguments", "order"),
    [
        (numerics.safe_sqrt, [[0.1, 1.0, 7.0]], 2),
        (numerics.safe_divide, [[1.0, -2.0, 0.0], [0.5, 3.0, -1.0]], 2),
        (numerics.length, [[[0.3, -0.4, 1.2], [2.0, 0.1, 0.5]]], 1),
        (numerics.normalize, [[[0.3, -0.4, 1.2], [2.0, 0.1, 0.5]]], 1),
        (numerics.renormalize, [[[0.6, 0.0, -0.8], [0.0, 1.0, 0.0]]], 1),
        (numerics.time_to_close, [[0.3, 2.0], [1.5, 0.2]], 2),
        (numerics.safe_atan2, [[0.3, -2.0, 1.0], [1.5, 0.2, -1.0]], 1),
        (numerics.truncated_exponential, [[0.3, -2.0, 3.0]], 1),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_check_grads(function, arguments, order):
    gradients.assert_numerical(function, *arguments, order=order)


# --- exponential_decay ---


def _decay_gradients(rate, length):
    arguments = jnp.float32(rate), jnp.float32(length)
    return jax.grad(numerics.exponential_decay, argnums=(0, 1))(*arguments)


@pytest.mark.parametrize(
    ("rate", "length", "expected"),
    [
        (0.0, 3.0, 1.0),
        (2.0, 0.0, 1.0),
        (2.0, 0.5, np.exp(-1.0)),
        (0.0, np.inf, 1.0),
        (1e-30, np.inf, 0.0),
        (1e30, 1e30, 0.0),
    ],
)
def test_decay_by_hand(rate, length, expected):
    found = numerics.exponential_decay(jnp.float32(rate), jnp.float32(length))
    np.testing.assert_allclose(found, expected, rtol=_ROUNDING)


@pytest.mark.parametrize("length", [0.0, 1.0, 1e30, np.inf])
@pytest.mark.parametrize("rate", [0.0, 1e-30, 1.0, 1e30])
def test_gradients_of_decay_are_finite(rate, length):
    assert np.all(np.isfinite(_decay_gradients(rate, length)))


def test_decay_has_its_true_gradients_without_absorption():
    np.testing.assert_allclose(_decay_gradients(0.0, 0.7), [-0.7, 0.0], rtol=_ROUNDING)


def test_decay_passes_nan_on():
    assert np.isnan(numerics.exponential_decay(jnp.float32(1.0), jnp.float32(np.nan)))


@pytest.mark.parametrize(
    ("x", "expected"), [(0.0, 1.0), (1.0, np.e), (-200.0, 0.0), (40.0, np.exp(40.0))]
)
def test_truncated_exponential_by_hand(x, expected):
    found = numerics.truncated_exponential(jnp.float32(x))
    np.testing.assert_allclose(found, expected, rtol=10 * _ROUNDING)


@pytest.mark.parametrize(
    ("x", "slope"),
    [
        (0.0, 1.0),
        (15.0, np.exp(15.0)),
        (30.0, np.exp(15.0)),
        (1e30, np.exp(15.0)),
        (-30.0, np.exp(-15.0)),
        (-1e30, np.exp(-15.0)),
    ],
)
def test_truncated_exponential_is_finite_and_its_slope_never_vanishes(x, slope):
    value, found = jax.value_and_grad(numerics.truncated_exponential)(jnp.float32(x))
    np.testing.assert_allclose(value, np.exp(min(x, 40.0)), rtol=10 * _ROUNDING)
    np.testing.assert_allclose(found, slope, rtol=10 * _ROUNDING)
    # A density times any length of a scene is a number.
    assert np.isfinite(np.float32(value) * np.float32(1e6))
