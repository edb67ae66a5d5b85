import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from refref_jax.optics import fresnel
from tests.oracles import reference

_INDICES = [(1.0, 1.5), (1.5, 1.0), (1.0, 2.418), (1.333, 1.5), (1.5, 1.333), (1.0, 1.0 + 1e-6)]

# Directions are unit vectors in float32.
_TOLERANCE = 1e-6


def _incident(theta):
    """Returns a direction that meets the plane z = 0 from above at an angle."""
    return jnp.array([np.sin(theta), 0.0, -np.cos(theta)], jnp.float32)


_UP = jnp.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize(("near", "far"), _INDICES)
@pytest.mark.parametrize("degrees", [0.0, 1e-3, 20.0, 41.0, 60.0, 89.0, 89.99])
def test_refraction_equals_the_textbook(near, far, degrees):
    theta = np.radians(degrees)
    near, far = float(np.float32(near)), float(np.float32(far))
    expected = reference.refract_by_angles(
        np.array([np.sin(theta), 0.0, -np.cos(theta)]), np.array([0.0, 0.0, 1.0]), near, far
    )
    found = fresnel.transmission(jnp.float32(np.cos(theta)), jnp.float32(near), jnp.float32(far))
    assert bool(found.total) == (expected is None)
    if expected is not None:
        direction = fresnel.refract(_incident(theta), _UP, jnp.float32(near), jnp.float32(far))
        np.testing.assert_allclose(direction, expected, atol=5 * _TOLERANCE)


@pytest.mark.parametrize(("near", "far"), _INDICES)
def test_snells_law_holds_for_any_orientation(near, far):
    generator = np.random.default_rng(0)
    normals = generator.normal(size=(500, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    directions = generator.normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    flip = np.sum(normals * directions, axis=-1, keepdims=True) > 0
    normals = np.where(flip, -normals, normals)

    def bend(direction, normal):
        beta = -jnp.dot(direction, normal)
        total = fresnel.transmission(beta, jnp.float32(near), jnp.float32(far)).total
        return fresnel.refract(direction, normal, jnp.float32(near), jnp.float32(far)), total

    refracted, total = jax.vmap(bend)(jnp.float32(directions), jnp.float32(normals))
    kept = ~np.asarray(total)
    assert kept.sum() > 100
    before = near * np.cross(directions, normals)[kept]
    after = far * np.cross(np.asarray(refracted), normals)[kept]
    np.testing.assert_allclose(after, before, atol=10 * _TOLERANCE)
    np.testing.assert_allclose(np.linalg.norm(refracted[kept], axis=-1), 1.0, atol=_TOLERANCE)


def test_refraction_is_reversible():
    theta = np.linspace(0.0, 1.5, 40)
    for angle in theta:
        inwards = fresnel.refract(_incident(angle), _UP, jnp.float32(1.0), jnp.float32(1.5))
        outwards = fresnel.refract(-inwards, -_UP, jnp.float32(1.5), jnp.float32(1.0))
        np.testing.assert_allclose(outwards, -_incident(angle), atol=5 * _TOLERANCE)


@pytest.mark.parametrize("degrees", [0.0, 30.0, 89.999])
def test_equal_indices_do_not_bend(degrees):
    direction = _incident(np.radians(degrees))
    bent = fresnel.refract(direction, _UP, jnp.float32(1.4), jnp.float32(1.4))
    np.testing.assert_allclose(bent, direction, atol=_TOLERANCE)


@pytest.mark.parametrize("beta", [1.0, 1e-3, 1e-6, 1e-12, 1e-18])
def test_equal_indices_keep_the_cosine_down_to_grazing(beta):
    found = fresnel.transmission(jnp.float32(beta), jnp.float32(1.5), jnp.float32(1.5))
    assert not found.total
    np.testing.assert_allclose(found.cosine, beta, rtol=1e-6)


@pytest.mark.parametrize(("near", "far"), [(1.5, 1.0), (2.418, 1.0), (1.5, 1.333)])
def test_reflection_is_total_just_beyond_the_critical_angle_and_not_before(near, far):
    critical = np.sqrt(1.0 - (far / near) ** 2)
    inside = fresnel.transmission(
        jnp.float32(critical * 1.0001), jnp.float32(near), jnp.float32(far)
    )
    beyond = fresnel.transmission(
        jnp.float32(critical * 0.9999), jnp.float32(near), jnp.float32(far)
    )
    assert not inside.total and inside.cosine > 0.0
    assert beyond.total and beyond.cosine == 0.0


def test_reflection_mirrors_and_is_its_own_inverse():
    direction = _incident(np.radians(35.0))
    mirrored = fresnel.reflect(direction, _UP)
    np.testing.assert_allclose(mirrored, direction * jnp.array([1.0, 1.0, -1.0]), atol=_TOLERANCE)
    np.testing.assert_allclose(fresnel.reflect(mirrored, _UP), direction, atol=_TOLERANCE)
    np.testing.assert_allclose(fresnel.reflect(direction, -_UP), mirrored, atol=_TOLERANCE)


@pytest.mark.parametrize(("near", "far"), [(1.0, 1.5), (1.5, 1.0), (1.5, 1.5)])
@pytest.mark.parametrize("degrees", [5.0, 30.0])
def test_gradients_of_refraction(near, far, degrees):
    with jax.enable_x64(True):
        theta = np.radians(degrees)
        direction = jnp.array([np.sin(theta), 0.0, -np.cos(theta)])
        normal = jnp.array([0.0, 0.0, 1.0])
        arguments = (direction, normal, jnp.array(near), jnp.array(far))
        check_grads(jax.jit(fresnel.refract), arguments, order=1, eps=1e-6)


def test_gradient_of_the_index_is_right_where_the_indices_are_equal():
    with jax.enable_x64(True):
        beta = jnp.array(0.6)
        slope = jax.grad(lambda far: fresnel.transmission(beta, jnp.array(1.5), far).cosine)
        # d gamma / d nu_1 = (1 - beta^2) / (nu beta) at equal indices.
        np.testing.assert_allclose(slope(jnp.array(1.5)), (1 - 0.36) / (1.5 * 0.6), rtol=1e-12)


@pytest.mark.parametrize("beta", [0.0, 1e-20, 0.3, 0.745355, 0.7453560, 0.745357, 1.0])
@pytest.mark.parametrize(("near", "far"), [(1.5, 1.0), (1.0, 1.5), (1.0, 1.0)])
def test_values_and_gradients_are_finite_everywhere(beta, near, far):
    def cosine(*args):
        return fresnel.transmission(*args).cosine

    args = (jnp.float32(beta), jnp.float32(near), jnp.float32(far))
    value, gradients = jax.value_and_grad(cosine, argnums=(0, 1, 2))(*args)
    assert np.isfinite(value) and np.all(np.isfinite(gradients))


def test_gradient_is_zero_in_total_reflection():
    slope = jax.grad(
        lambda beta: fresnel.transmission(beta, jnp.float32(1.5), jnp.float32(1)).cosine
    )
    assert slope(jnp.float32(0.1)) == 0.0
