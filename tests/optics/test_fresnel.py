import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from refref_jax.optics import fresnel
from tests.oracles import reference

_TOLERANCE = 2e-6


def _reflectance(theta, near, far):
    return fresnel.reflectance(jnp.float32(np.cos(theta)), jnp.float32(near), jnp.float32(far))


@pytest.mark.parametrize(("near", "far"), [(1.0, 1.5), (1.5, 1.0)])
def test_glass_reflects_four_percent_head_on(near, far):
    np.testing.assert_allclose(_reflectance(0.0, near, far), 0.04, atol=_TOLERANCE)


@pytest.mark.parametrize(
    ("near", "far"), [(1.0, 1.5), (1.5, 1.0), (1.0, 2.418), (2.418, 1.0), (1.5, 1.333)]
)
def test_reflectance_equals_the_sine_and_tangent_laws(near, far):
    theta = np.radians(np.linspace(0.5, 89.5, 90))
    expected = [reference.fresnel_by_angles(angle, near, far) for angle in theta]
    found = [_reflectance(angle, near, far) for angle in theta]
    # Near the critical angle the cosine's rounding is amplified.
    np.testing.assert_allclose(found, expected, atol=2e-4)
    assert np.median(np.abs(np.array(found) - expected)) < _TOLERANCE


def test_parallel_light_is_not_reflected_at_brewsters_angle():
    brewster = np.arctan(1.5)
    perpendicular = ((1.0 - 1.5**2) / (1.0 + 1.5**2)) ** 2
    np.testing.assert_allclose(
        _reflectance(brewster, 1.0, 1.5), 0.5 * perpendicular, atol=_TOLERANCE
    )


def test_reflectance_is_the_same_from_both_sides():
    theta = np.radians(np.linspace(1.0, 88.0, 30))
    inner = np.arcsin(np.sin(theta) / 1.5)
    for outside, inside in zip(theta, inner, strict=True):
        # Grazing inner angles lie close to the critical one, where rounding is amplified.
        np.testing.assert_allclose(
            _reflectance(outside, 1.0, 1.5), _reflectance(inside, 1.5, 1.0), atol=5e-4
        )


@pytest.mark.parametrize(("near", "far"), [(1.0, 1.5), (1.0, 1.0001), (1.5, 1.0)])
def test_everything_is_reflected_at_grazing_incidence(near, far):
    assert fresnel.reflectance(jnp.float32(0.0), jnp.float32(near), jnp.float32(far)) == 1.0


@pytest.mark.parametrize("beta", [1.0, 0.5, 1e-4, 1e-9, 1e-18, 0.0])
def test_equal_indices_reflect_nothing(beta):
    args = (jnp.float32(beta), jnp.float32(1.37), jnp.float32(1.37))
    value, slopes = jax.value_and_grad(fresnel.reflectance, argnums=(1, 2))(*args)
    assert value <= 1e-12
    assert np.all(np.isfinite(slopes))


def test_reflectance_lies_between_none_and_all_over_the_whole_range():
    beta = jnp.asarray(np.concatenate([[0.0], np.logspace(-20, 0, 500)]), jnp.float32)
    for near, far in [(1.0, 1.5), (1.5, 1.0), (1.0, 100.0), (1.0, 1.0 + 1e-7)]:
        found = jax.vmap(fresnel.reflectance, in_axes=(0, None, None))(
            beta, jnp.float32(near), jnp.float32(far)
        )
        assert np.all(found >= 0.0) and np.all(found <= 1.0 + 1e-6)


def test_reflectance_falls_from_grazing_to_head_on_from_the_thin_side():
    beta = jnp.linspace(0.0, 1.0, 200)
    found = jax.vmap(fresnel.reflectance, in_axes=(0, None, None))(
        beta, jnp.float32(1.0), jnp.float32(2.418)
    )
    # Unpolarised light dips a little before head-on, by less than one part in a hundred.
    assert np.all(np.diff(found) < 2e-3)


@pytest.mark.parametrize(
    ("beta", "near", "far"), [(0.9, 1.0, 1.5), (0.3, 1.0, 1.5), (0.95, 1.5, 1.0)]
)
def test_gradients(beta, near, far):
    with jax.enable_x64(True):
        args = (jnp.array(beta), jnp.array(near), jnp.array(far))
        check_grads(jax.jit(fresnel.reflectance), args, order=1, eps=1e-6)


@pytest.mark.parametrize("beta", [0.0, 1e-20, 0.745355, 0.745356, 0.745357, 1.0])
@pytest.mark.parametrize(("near", "far"), [(1.5, 1.0), (1.0, 1.5), (1.0, 1.0), (1.0, 1e6)])
def test_gradients_are_finite_at_the_edges(beta, near, far):
    args = (jnp.float32(beta), jnp.float32(near), jnp.float32(far))
    assert np.all(np.isfinite(jax.grad(fresnel.reflectance, argnums=(0, 1, 2))(*args)))


def test_gradient_is_zero_in_total_reflection():
    slopes = jax.grad(fresnel.reflectance, argnums=(0, 1, 2))(
        jnp.float32(0.1), jnp.float32(1.5), jnp.float32(1.0)
    )
    assert np.all(np.asarray(slopes) == 0.0)
