"""Paths and a radiance function to colours."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.geometry.cameras import image_rays, orbit
from refref_jax.optics import light_paths, path_tracing
from refref_jax.optics.light_paths import PathStatus
from refref_jax.optics.path_settings import TREE
from refref_jax.render import render_known, shade
from tests.factories import scenes
from tests.laws import gradients


@functools.cache
@jax.jit
def _paths():
    """Two straight paths of ray 1, one of ray 0, and an empty slot that looks nowhere."""
    rays = scenes.rays(np.zeros((4, 3)), [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])
    paths = light_paths.straight(rays)
    return paths._replace(
        directions=paths.directions.at[3].set(0.0),
        rays=jnp.array([1, 1, 0, 0], jnp.int32),
        throughput=jnp.array([0.75, 0.25, 0.5, 9.0])[:, None] * jnp.ones((1, 3)),
        statuses=paths.statuses.at[3].set(PathStatus.EMPTY),
    )


_shade = jax.jit(shade, static_argnums=1, static_argnames="rays")


def _unit_direction(origin, direction):
    # Of a zero direction it is no number.
    return direction / jnp.sqrt(jnp.sum(jnp.square(direction)))


def test_a_ray_is_the_weighted_sum_of_its_paths():
    seen = _shade(_paths(), _unit_direction, rays=3)
    np.testing.assert_allclose(seen, [[0, 0, 0.5], [0.75, 0.25, 0], [0, 0, 0]], atol=1e-7)


def test_an_empty_slot_brings_neither_light_nor_gradient():
    def light(scale, paths):
        return jnp.sum(shade(paths, lambda o, d: _unit_direction(o, scale * d), rays=2))

    value, slope = jax.jit(jax.value_and_grad(light))(jnp.float32(2.0), _paths())
    assert gradients.all_finite((value, slope))
    np.testing.assert_allclose(slope, 0.0, atol=1e-6)


def test_the_last_segment_is_what_is_seen():
    """Only as many segments count as are used; a slot without any has some segment."""
    straight = jax.jit(light_paths.straight)(scenes.rays(np.zeros((2, 3)), np.eye(3)[:2]))
    bent = straight._replace(
        points=jnp.arange(18.0).reshape(2, 3, 3),
        directions=jnp.arange(18.0, 36.0).reshape(2, 3, 3),
        tau=jnp.array([[0.0, 2.0, jnp.inf], [jnp.inf, jnp.inf, jnp.inf]]),
        media=jnp.array([[0, 1, 7], [5, 7, 7]], jnp.int32),
    )
    ends = jax.jit(light_paths.ends_of)(bent)
    np.testing.assert_array_equal(ends.origins, [[3, 4, 5], [9, 10, 11]])
    np.testing.assert_array_equal(ends.directions, [[21, 22, 23], [27, 28, 29]])
    np.testing.assert_array_equal(ends.tau[0], 2.0)
    np.testing.assert_array_equal(ends.media, [1, 5])


def test_one_path_alone_is_shaded_too():
    one = jax.tree.map(lambda x: x[0], _paths())._replace(rays=jnp.int32(0))
    np.testing.assert_allclose(_shade(one, _unit_direction, rays=1), [[0.75, 0, 0]], atol=1e-7)


def test_paths_of_mapped_rays_are_refused_with_the_remedy():
    mapped = jax.tree.map(lambda x: jnp.stack([x, x]), _paths())
    with pytest.raises(ValueError, match=r"axes \(2, 4\).*Apply jax.vmap to shade"):
        shade(mapped, _unit_direction, rays=2)


@pytest.mark.parametrize("wrong", [lambda o, d: d[0], lambda o, d: d[:2]])
def test_a_radiance_function_gives_three_numbers(wrong):
    with pytest.raises(ValueError, match="Return linear RGB, of shape"):
        shade(_paths(), wrong, rays=2)


@pytest.mark.slow
def test_it_sees_what_a_picture_shows():
    glass = scenes.build(scenes.ball(1.3, subdivisions=2))
    rays = image_rays(orbit(1, distance=4.0, elevation=0.3, size=8, angle_x=0.8), 0)
    sky = lambda origin, direction: 0.5 + 0.5 * direction
    roomy = dataclasses.replace(TREE, live_per_ray=20.0, paths_per_ray=20.0)
    image = render_known(glass, sky, rays, settings=TREE)
    flat = jax.tree.map(lambda x: jnp.asarray(x.reshape(64, *x.shape[2:])), rays)
    traced = jax.jit(lambda rays: path_tracing.trace(glass, rays, settings=roomy))(flat)
    np.testing.assert_array_equal(traced.dropped, 0.0)
    seen = shade(traced.paths, sky, rays=64)
    np.testing.assert_allclose(seen, image.linear.reshape(64, 3), atol=2e-5)
