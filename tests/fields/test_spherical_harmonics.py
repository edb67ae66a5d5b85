import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.fields import hash_grid
from tests.laws import gradients, transformations
from tests.oracles import reference_sampling

# Cubic polynomials of float32 components.
_POLYNOMIAL = 2e-6

_encode = jax.jit(jax.vmap(hash_grid.spherical_harmonics))


def _directions(count=50):
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    vectors = np.concatenate([axes, np.random.default_rng(0).normal(size=(count, 3))])
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def test_spherical_harmonics_by_hand():
    # Sloan's table at the pole: only the orders 0 are not zero there, sqrt((2 l + 1) / (4 pi)).
    expected = np.zeros(16)
    expected[[0, 2, 6, 12]] = np.sqrt(np.array([1.0, 3.0, 5.0, 7.0]) / (4.0 * np.pi))
    got = hash_grid.spherical_harmonics(jnp.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(got, expected, atol=_POLYNOMIAL)


def test_spherical_harmonics_against_scipy():
    directions = _directions()
    expected = [reference_sampling.spherical_harmonics(x) for x in directions]
    got = _encode(jnp.asarray(directions, jnp.float32))
    assert got.shape[-1] == 16
    np.testing.assert_allclose(got, expected, atol=_POLYNOMIAL)


def test_the_zero_vector_is_finite():
    functions = hash_grid.spherical_harmonics, jax.jacrev(hash_grid.spherical_harmonics)
    assert gradients.all_finite([jax.jit(function)(jnp.zeros(3)) for function in functions])


def test_spherical_harmonics_check_grads():
    gradients.assert_numerical(hash_grid.spherical_harmonics, _directions()[-1])


@pytest.mark.parametrize("transformation", transformations.ALL)
def test_transformations_change_nothing(transformation):
    directions = jnp.asarray(_directions()[:8], jnp.float32)
    transformation(hash_grid.spherical_harmonics, (directions,))


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_two_linear_layers_in_a_row_are_one(precision):
    # Off CPUs, the bottleneck is not formed: values and slopes are those of both layers in turn.
    numbers = np.random.default_rng(1)
    shapes = (8,), (16,), ((8, 6), (6,)), ((5 + 16, 7), (7,))
    arguments = jax.tree.map(
        lambda shape: jnp.asarray(numbers.normal(size=shape), jnp.float32),
        shapes,
        is_leaf=lambda x: isinstance(x[0], int),
    )
    affine = hash_grid.affine(precision)

    def value_and_slopes(layers):
        def squares(*arguments):
            density, outputs = layers(affine, *arguments)
            return density**2 + jnp.sum(outputs.astype(jnp.float32) ** 2)

        return jax.jit(jax.value_and_grad(squares, argnums=(0, 1, 2, 3)))(*arguments)

    both = value_and_slopes(hash_grid.in_turn), value_and_slopes(hash_grid.joined)
    tolerance = 1e-5 if precision == "float32" else 0.05
    for one, other in zip(*map(jax.tree.leaves, both), strict=True):
        np.testing.assert_allclose(one, other, atol=tolerance * np.abs(one).max())
