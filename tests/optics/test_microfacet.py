"""Rough surfaces against Walter's equations, written independently in NumPy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.optics import fresnel

_UP = jnp.array([0.0, 0.0, 1.0])


def _facets(direction, alpha, count=40_000, seed=0, normal=_UP):
    """Returns the facets that parallel rays meet at many points."""
    points = np.random.default_rng(seed).normal(size=(count, 3)).astype(np.float32)

    @jax.jit
    @jax.vmap
    def facet(point):
        numbers = fresnel.uniform_pair(point, direction)
        return fresnel.facet_normal(direction, normal, jnp.float32(alpha), numbers)

    return np.asarray(facet(jnp.asarray(points)), np.float64)


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


@pytest.mark.slow
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
    found = jnp.vectorize(fresnel.masking)(
        towards.astype(np.float32), leaving.astype(np.float32), np.float32(alpha)
    )
    one, other = (1.0 / _visible(x, alpha) - 1.0 for x in (towards, leaving))
    np.testing.assert_allclose(found, (1.0 + one) / (1.0 + one + other), rtol=2e-5)


@pytest.mark.slow
def test_masking_at_the_extremes_is_finite_with_finite_gradients():
    for towards in (0.0, 1e-20, 1e-6, 1.0):
        for leaving in (-1.0, -1e-9, 0.0, 1e-20, 1e-6, 1.0):
            for alpha in (0.0, 1e-8, 1.0):
                args = tuple(map(jnp.float32, (towards, leaving, alpha)))
                value, slopes = jax.value_and_grad(fresnel.masking, argnums=(0, 1, 2))(*args)
                assert 0.0 <= value <= 1.0 and (leaving > 0.0 or value == 0.0)
                assert np.all(np.isfinite(slopes))


def test_a_smooth_surface_has_its_own_normal():
    normal = jnp.array([0.6, 0.0, 0.8])
    assert np.all(_facets(_incident(30.0), 0.0, count=10, normal=normal) == np.asarray(normal))


@pytest.mark.slow
def test_a_ray_always_meets_the_same_facet_and_neighbours_another():
    assert np.array_equal(_facets(_UP * -1.0, 0.3), _facets(_UP * -1.0, 0.3))
    near = jnp.array([[1.0, 2.0, 3.0], [1.0 + 2e-7, 2.0, 3.0]], jnp.float32)
    pairs = jax.vmap(fresnel.uniform_pair, in_axes=(0, None))(near, -_UP)
    assert all(abs(float(one - other)) > 1e-3 for one, other in pairs)


def test_the_rays_of_a_pixel_share_the_numbers_evenly_at_their_first_bends():
    @jax.jit
    def noise(bends):
        """Returns how much the mean of a function over 64 rays varies between pixels."""

        def value(pixel, ray):
            stratum = fresnel.Stratum(pixel, ray, jnp.int32(64), bends)
            hit = jnp.stack([pixel, ray, bends]).astype(jnp.float32)
            u, v = fresnel.uniform_pair(hit, -_UP, stratum=stratum)
            return jnp.sin(2.0 * jnp.pi * u) + jnp.cos(2.0 * jnp.pi * v)

        rays, pixels = jnp.arange(64, dtype=jnp.int32), jnp.arange(300, dtype=jnp.int32)
        values = jax.vmap(lambda pixel: jax.vmap(lambda ray: value(pixel, ray))(rays))(pixels)
        return jnp.std(jnp.mean(values, axis=1))

    independent = 1.0 / 8.0
    assert all(noise(jnp.int32(bends)) < 0.5 * independent for bends in range(3))
    np.testing.assert_allclose(noise(jnp.int32(5)), independent, rtol=0.2)


@jax.jit
@functools.partial(jax.jacfwd, argnums=(0, 1))
def _facet_slopes(direction, alpha):
    numbers = fresnel.uniform_pair(jnp.ones(3), direction)
    return fresnel.facet_normal(direction, _UP, alpha, numbers)


@pytest.mark.parametrize("degrees", [0.0, 60.0, 90.0])
def test_gradients_of_a_facet_are_finite(degrees):
    for alpha in (0.0, 1e-6, 0.3):
        slopes = _facet_slopes(_incident(degrees), jnp.float32(alpha))
        assert all(np.all(np.isfinite(slope)) for slope in slopes)
