import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.fields import mlps
from tests.laws import gradients, transformations
from tests.oracles import reference_sampling

# Cubic polynomials of float32 components.
_POLYNOMIAL = 2e-6

_encode = jax.jit(jax.vmap(mlps.spherical_harmonics))


def _directions(count=50):
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    vectors = np.concatenate([axes, np.random.default_rng(0).normal(size=(count, 3))])
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def test_spherical_harmonics_by_hand():
    # Sloan's table at the pole: only the orders 0 are not zero there, sqrt((2 l + 1) / (4 pi)).
    expected = np.zeros(16)
    expected[[0, 2, 6, 12]] = np.sqrt(np.array([1.0, 3.0, 5.0, 7.0]) / (4.0 * np.pi))
    got = mlps.spherical_harmonics(jnp.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(got, expected, atol=_POLYNOMIAL)


def test_the_first_degree_is_the_direction():
    directions = jnp.asarray(_directions(), jnp.float32)
    got = _encode(directions)[:, 1:4] / np.sqrt(3.0 / (4.0 * np.pi))
    np.testing.assert_allclose(got, directions[:, jnp.array([1, 2, 0])], atol=_POLYNOMIAL)


def test_spherical_harmonics_against_scipy():
    directions = _directions()
    expected = [reference_sampling.spherical_harmonics(x) for x in directions]
    got = _encode(jnp.asarray(directions, jnp.float32))
    assert got.shape[-1] == 16
    np.testing.assert_allclose(got, expected, atol=_POLYNOMIAL)


def test_spherical_harmonics_are_orthonormal_over_the_sphere():
    # Gauss-Legendre in z and even steps round the axis are exact for products of degree 6.
    z, weights = np.polynomial.legendre.leggauss(8)
    angle = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    ring = np.sqrt(1.0 - z**2)[:, None]
    x, y = ring * np.cos(angle), ring * np.sin(angle)
    directions = np.stack([x, y, np.broadcast_to(z[:, None], x.shape)], axis=-1).reshape(-1, 3)
    area = np.repeat(weights, angle.size) * 2.0 * np.pi / angle.size
    values = np.asarray(_encode(jnp.asarray(directions, jnp.float32)), np.float64)
    np.testing.assert_allclose(values.T @ (area[:, None] * values), np.eye(16), atol=1e-5)


def test_odd_degrees_change_sign_with_the_direction():
    directions = jnp.asarray(_directions(), jnp.float32)
    sign = np.concatenate([np.full(2 * degree + 1, (-1.0) ** degree) for degree in range(4)])
    np.testing.assert_array_equal(_encode(-directions), sign * np.asarray(_encode(directions)))


def test_the_squares_of_a_degree_sum_to_a_constant():
    # Unsoeld's theorem: (2 l + 1) / (4 pi).
    squares = np.square(_encode(jnp.asarray(_directions(), jnp.float32)))
    for degree in range(4):
        total = squares[:, degree**2 : (degree + 1) ** 2].sum(axis=-1)
        np.testing.assert_allclose(total, (2 * degree + 1) / (4.0 * np.pi), rtol=1e-5)


def test_the_zero_vector_is_finite():
    functions = mlps.spherical_harmonics, jax.jacrev(mlps.spherical_harmonics)
    assert gradients.all_finite([jax.jit(function)(jnp.zeros(3)) for function in functions])


def test_spherical_harmonics_check_grads():
    gradients.assert_numerical(mlps.spherical_harmonics, _directions()[-1])


@pytest.mark.parametrize("transformation", transformations.ALL)
def test_transformations_change_nothing(transformation):
    directions = jnp.asarray(_directions()[:8], jnp.float32)
    transformation(mlps.spherical_harmonics, (directions,))
