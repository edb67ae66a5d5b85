"""Hits of level sets: against roots of polynomials; gradients against closed forms, in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.geometry.bvh import NO_PRIMITIVE
from refref_jax.geometry.surfaces import closest, meet, slope
from tests.factories import level_sets
from tests.laws import gradients

_CENTRE, _RADIUS = np.array([0.1, 0.2, -0.1]), 1.2
_TORUS = np.array([1.1, 0.4])


@pytest.fixture(autouse=True)
def _doubles():
    with jax.enable_x64(True):
        yield


def _hit(surface, origin, direction):
    nothing = jnp.int32(NO_PRIMITIVE)
    found = closest(surface, origin, direction, jnp.full_like(origin[0], jnp.inf), nothing)
    return found, meet(surface, found, origin, direction)


_compiled_hit, _compiled_closest = jax.jit(_hit), jax.jit(closest)


def _rays(count, seed=0, distance=4.0):
    rng = np.random.default_rng(seed)
    origins = rng.normal(size=(count, 3))
    origins *= distance / np.linalg.norm(origins, axis=-1, keepdims=True)
    directions = rng.uniform(-1.0, 1.0, (count, 3)) - origins
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    return jnp.asarray(origins), jnp.asarray(directions)


def _ball_distance(origin, direction, centre, radius):
    """The nearer intersection, by the quadratic formula; `nan` for a miss."""
    offset = origin - centre
    along = jnp.sum(offset * direction) / jnp.sum(direction**2)
    gap = (jnp.sum(offset**2) - radius**2) / jnp.sum(direction**2)
    return -along - jnp.sqrt(along**2 - gap)


def _torus_distance(origin, direction):
    """The first root of the quartic of a torus around z; `inf` if there is none."""
    large, small = _TORUS
    square = np.poly1d([1.0, 2.0 * origin @ direction, origin @ origin])
    total = square + (large**2 - small**2)
    flat = np.poly1d(
        [
            direction[:2] @ direction[:2],
            2.0 * origin[:2] @ direction[:2],
            origin[:2] @ origin[:2],
        ]
    )
    roots = (total * total - 4.0 * large**2 * flat).roots
    real = roots[np.abs(roots.imag) < 1e-9].real
    return min(real[real > 1e-6], default=np.inf)


@pytest.mark.parametrize("factor", [1.0, 0.2, 5.0])
def test_hits_of_a_ball_are_roots_of_its_quadratic(factor):
    origins, directions = _rays(300)
    surface = level_sets.ball(_CENTRE, _RADIUS, factor)
    found, points = jax.jit(jax.vmap(_hit, in_axes=(None, 0, 0)))(surface, origins, directions)
    exact = jax.vmap(_ball_distance, in_axes=(0, 0, None, None))(
        origins, directions, jnp.asarray(_CENTRE), jnp.float64(_RADIUS)
    )
    met = np.isfinite(exact)
    assert 50 < met.sum() < 300
    np.testing.assert_array_equal(found != NO_PRIMITIVE, met)
    distances = np.linalg.norm(points.position - origins, axis=-1)
    np.testing.assert_allclose(distances[met], exact[met], atol=1e-11)
    normals = (np.asarray(points.position) - _CENTRE) / _RADIUS
    np.testing.assert_allclose(points.shading_normal[met], normals[met], atol=1e-8)
    assert gradients.all_finite(points)


def test_hits_of_a_torus_are_roots_of_its_quartic():
    origins, directions = _rays(300, seed=1)
    surface = level_sets.torus(_TORUS)
    found, points = jax.jit(jax.vmap(_hit, in_axes=(None, 0, 0)))(surface, origins, directions)
    pairs = zip(np.asarray(origins), np.asarray(directions), strict=True)
    exact = np.array([_torus_distance(*pair) for pair in pairs])
    met = np.isfinite(exact)
    # A chord of less than a stretch may be missed: few of these rays only graze the torus.
    assert np.mean((found != NO_PRIMITIVE) != met) < 0.02
    both = met & (np.asarray(found) != NO_PRIMITIVE)
    distances = np.linalg.norm(points.position - origins, axis=-1)
    assert both.sum() > 100
    np.testing.assert_allclose(distances[both], exact[both], atol=1e-9)


@pytest.mark.parametrize("factor", [1.0, 3.0])
def test_the_gradient_of_a_hit_is_the_closed_form(factor):
    origins, directions = _rays(40, seed=2)

    def implicit(origin, direction, centre, radius, factor):
        surface = level_sets.ball(centre, radius, factor)
        point = _hit(surface, origin, direction / jnp.linalg.norm(direction))[1]
        return jnp.linalg.norm(point.position - origin)

    def exact(origin, direction, centre, radius, factor):
        del factor
        return _ball_distance(origin, direction / jnp.linalg.norm(direction), centre, radius)

    shape = jnp.asarray(_CENTRE), jnp.float64(_RADIUS), jnp.float64(factor)
    ours, theirs = (
        jax.jit(jax.vmap(jax.grad(f, argnums=range(5)), in_axes=(0, 0, None, None, None)))
        for f in (implicit, exact)
    )
    found, expected = (f(origins, directions, *shape) for f in (ours, theirs))
    # The derivative by the radius is the inverse of the cosine, which is bounded at grazing.
    steep = np.isfinite(expected[3]) & (np.abs(expected[3]) < 1.0 / 0.06)
    assert steep.sum() > 10
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one[steep], other[steep], rtol=1e-7, atol=1e-9)
    assert gradients.all_finite(found)


@pytest.mark.slow
def test_normals_have_gradients_too():
    origin, direction = (x[0] for x in _rays(1, seed=6))
    towards = jnp.asarray(_CENTRE) - origin

    def normal(origin, radius):
        aim = towards / jnp.linalg.norm(towards) + 0.1 * direction
        surface = level_sets.ball(_CENTRE, radius)
        return _hit(surface, origin, aim / jnp.linalg.norm(aim))[1].shading_normal

    gradients.assert_numerical(normal, origin, _RADIUS, modes=("rev",), rtol=1e-4)


def test_a_ray_from_the_surface_meets_its_other_side():
    surface, up = level_sets.ball(_CENTRE, _RADIUS), jnp.array([0.0, 0.0, 1.0])
    top = jnp.asarray(_CENTRE) + _RADIUS * up
    found, point = _compiled_hit(surface, top, -up)
    assert found != NO_PRIMITIVE
    np.testing.assert_allclose(point.position, _CENTRE - _RADIUS * np.array(up), atol=1e-11)
    assert _compiled_hit(surface, top, up)[0] == NO_PRIMITIVE
    limited = _compiled_closest(surface, top, -up, jnp.float64(1.0), jnp.int32(NO_PRIMITIVE))
    assert limited == NO_PRIMITIVE


@pytest.mark.slow
def test_a_normal_that_faces_the_wrong_way_is_mirrored():
    """A slope by differences may be beyond grazing: the side is that of the values."""

    def values(points):  # a plane, with a slope that begins beside the point
        return points[:, 2] + 20.0 * jax.nn.relu(points[:, 0] - 0.4)

    coarse = level_sets.level_set(values)._replace(step=jnp.float64(0.5))
    direction = jnp.array([0.6, 0.0, -0.8])
    point = _compiled_hit(coarse, -direction, direction)[1]
    np.testing.assert_allclose(point.position, 0.0, atol=1e-9)
    assert jnp.dot(slope(coarse, point.position), direction) > 0.0
    assert jnp.dot(point.shading_normal, direction) < 0.0
    np.testing.assert_allclose(jnp.linalg.norm(point.shading_normal), 1.0, rtol=1e-12)
