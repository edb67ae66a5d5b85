"""Rough surfaces against Walter's equations, written independently in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.optics import microfacet

_UP = jnp.array([0.0, 0.0, 1.0])


def _facets(direction, alpha, count=40_000, seed=0, normal=_UP):
    """Returns the facets that parallel rays meet at many points."""
    points = np.random.default_rng(seed).normal(size=(count, 3)).astype(np.float32)
    facet = jax.jit(jax.vmap(microfacet.facet_normal, in_axes=(0, None, None, None)))
    return np.asarray(facet(points, direction, normal, jnp.float32(alpha)), np.float64)


def _incident(degrees):
    angle = np.radians(degrees)
    return jnp.array([np.sin(angle), 0.0, -np.cos(angle)], jnp.float32)


def _distribution(cosine, alpha):
    """GGX (Walter et al., equation 33)."""
    tan2 = 1.0 / cosine**2 - 1.0
    return alpha**2 / (np.pi * cosine**4 * (alpha**2 + tan2) ** 2)


def _visible(cosine, alpha):
    """Masking of one direction (Walter et al., equation 34)."""
    return 2.0 / (1.0 + np.sqrt(1.0 + alpha**2 * (1.0 / cosine**2 - 1.0)))


@pytest.mark.parametrize("degrees", [0.0, 40.0, 85.0])
@pytest.mark.parametrize("alpha", [0.01, 0.09, 0.5, 1.0])
def test_facets_have_the_distribution_of_visible_normals(degrees, alpha):
    direction = _incident(degrees)
    towards = -np.asarray(direction, np.float64)
    facets = _facets(direction, alpha)
    assert np.all(facets @ towards >= -1e-6)
    np.testing.assert_allclose(np.linalg.norm(facets, axis=1), 1.0, atol=1e-5)
    # The mean cosine by quadrature over the hemisphere: D_v = G1 max(0, v.m) D / cos.
    z = (np.arange(4000) + 0.5) / 4000
    turn = 2.0 * np.pi * (np.arange(400) + 0.5) / 400
    # Slopes follow D closely, so that small alpha is resolved, too.
    slope = alpha * np.sqrt(z / (1.0 - z))
    cosine = 1.0 / np.sqrt(1.0 + slope**2)
    sine = np.sqrt(1.0 - cosine**2)
    seen = towards[0] * sine[:, None] * np.cos(turn) + towards[2] * cosine[:, None]
    share = np.maximum(seen, 0.0) / cosine[:, None]  # z is uniform under D cos
    weight = share * _visible(towards[2], alpha) / towards[2]
    np.testing.assert_allclose(weight.mean(), 1.0, rtol=1e-2)
    mean = (weight * cosine[:, None]).mean() / weight.mean()
    spread = facets[:, 2].std() / np.sqrt(len(facets))
    np.testing.assert_allclose(facets[:, 2].mean(), mean, atol=5.0 * spread + 2e-4)


@pytest.mark.parametrize("alpha", [0.05, 0.3, 1.0])
def test_masking_equals_the_formula_of_two_lambdas(alpha):
    cosines = np.linspace(0.02, 1.0, 25)
    towards, leaving = np.meshgrid(cosines, cosines)
    found = jnp.vectorize(microfacet.masking)(
        towards.astype(np.float32), leaving.astype(np.float32), np.float32(alpha)
    )
    one, other = (1.0 / _visible(x, alpha) - 1.0 for x in (towards, leaving))
    np.testing.assert_allclose(found, (1.0 + one) / (1.0 + one + other), rtol=2e-5)


def test_masking_at_the_extremes_is_finite_with_finite_gradients():
    for towards in (0.0, 1e-20, 1e-6, 1.0):
        for leaving in (-1.0, -1e-9, 0.0, 1e-20, 1e-6, 1.0):
            for alpha in (0.0, 1e-8, 1.0):
                args = tuple(map(jnp.float32, (towards, leaving, alpha)))
                value, slopes = jax.value_and_grad(microfacet.masking, argnums=(0, 1, 2))(*args)
                assert 0.0 <= value <= 1.0 and (leaving > 0.0 or value == 0.0)
                assert np.all(np.isfinite(slopes))


def test_a_smooth_surface_has_its_own_normal():
    normal = jnp.array([0.6, 0.0, 0.8])
    assert np.all(_facets(_incident(30.0), 0.0, count=10, normal=normal) == np.asarray(normal))


def test_a_ray_always_meets_the_same_facet_and_neighbours_another():
    assert np.array_equal(_facets(_UP * -1.0, 0.3), _facets(_UP * -1.0, 0.3))
    near = jnp.array([[1.0, 2.0, 3.0], [1.0 + 2e-7, 2.0, 3.0]], jnp.float32)
    facet = jax.vmap(microfacet.facet_normal, in_axes=(0, None, None, None))
    one, other = facet(near, -_UP, _UP, jnp.float32(0.3))
    assert np.max(np.abs(one - other)) > 1e-3


@pytest.mark.parametrize("degrees", [0.0, 60.0, 90.0])
def test_gradients_of_a_facet_are_finite(degrees):
    def facet(direction, alpha):
        return microfacet.facet_normal(jnp.ones(3), direction, _UP, alpha)

    for alpha in (0.0, 1e-6, 0.3):
        slopes = jax.jacfwd(facet, argnums=(0, 1))(_incident(degrees), jnp.float32(alpha))
        assert all(np.all(np.isfinite(slope)) for slope in slopes)
