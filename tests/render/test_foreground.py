"""What is in front of a backdrop: closed forms of a planted field, and gradients."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import refref_jax
from refref_jax.fields import registry
from refref_jax.fields.base import Radiance
from refref_jax.geometry.cameras import image_rays
from refref_jax.geometry.rays import Rays
from refref_jax.optics.light_paths import Stop
from refref_jax.optics.path_settings import PATH_PRESETS
from refref_jax.render import Model, backdrop, pixels, render_image, render_rays, volume_rendering
from refref_jax.render.model import (
    BackdropConfig,
    Layers,
    LayersWithHull,
    Params,
    init_params,
    surface_of,
)
from refref_jax.sampling import scene_bounds
from tests.factories import made_paths
from tests.factories.small_model import CAMERAS, MODEL, initial

_SURFACE = BackdropConfig(8, in_front="field")
_INSIDE = dataclasses.replace(MODEL, backdrop=_SURFACE)
_CLEAR = dataclasses.replace(MODEL, backdrop=_SURFACE, interior="clear")
# A ball of which masks show the half above z = 0.
_IN_BALL = dataclasses.replace(
    MODEL, backdrop=dataclasses.replace(_SURFACE, field_ball=(0.0, 0.0, 0.0, 2.0))
)
_HULLS = {_IN_BALL: jnp.zeros((2, 2, 2)).at[:, :, 1].set(1.0)}
_GREY = 0.7
_ONE = jnp.float32(1.0)


def _bent():
    """Enters an object after 2 units, is inside for 1.5, and leaves along the last direction."""
    return made_paths.path(
        [2.0, 1.5], [(0, 0, -1), (0, 0.6, -0.8), (0, 0, -1)], [0, 1, 0], origin=(0, 0, 3)
    )


def _straight():
    return made_paths.path([], [(0, 0, -1)], [0], origin=(0, 0, 3), segments=3)


def test_a_field_in_a_ball_ends_on_the_background():
    room = MODEL.radius
    surface = dataclasses.replace(_SURFACE, field_ball=(0.0, 0.0, -room, 2.0))
    config, path = dataclasses.replace(MODEL, backdrop=surface), _straight()
    line = volume_rendering.polyline(config, jax.tree.map(jnp.asarray, path))
    np.testing.assert_allclose(line.points[0], [0.0, 0.0, 2.0 - room], atol=1e-5)
    np.testing.assert_allclose(line.stop, 2.0, atol=1e-5)  # not 4: the wall is in its middle


@functools.partial(jax.jit, static_argnums=0)
def _planted(config, path, fog, hull):
    """Renders one path through the field of `plant`, without which it is not called."""
    paths = jax.tree.map(lambda x: x[None], path)
    layers = Layers(fog, backdrop.init(8, radiance=_GREY))
    if config.backdrop.field_ball is not None:
        layers = LayersWithHull(*layers, hull)
    params = Params((fog,), layers)
    jitter = pixels.no_jitter(config, 1)
    seen = pixels.render_paths(params, config, paths, jitter, anneal=_ONE)
    return jax.tree.map(lambda x: x[0], seen)


@pytest.fixture
def plant(monkeypatch):
    """Returns a function that renders one path; the field's colour is the direction."""

    def density(fog, config, gaussians):
        return fog

    def radiance(fog, config, gaussians, direction):
        return Radiance(fog, direction)

    monkeypatch.setattr(registry, "density", density)
    monkeypatch.setattr(registry, "radiance", radiance)
    return lambda config, path, fog: _planted(config, path, jnp.float32(fog), _HULLS.get(config))


@pytest.mark.parametrize("fog", [0.0, 1e-6, 0.8, 30.0, 1e6])
def test_light_of_the_backdrop_is_dimmed_by_the_field_inside_the_objects(plant, fog):
    seen = plant(_INSIDE, _bent(), fog).composite
    passed = np.exp(-fog * 1.5 / MODEL.radius)
    expected = passed * _GREY + (1.0 - passed) * np.array([0.0, 0.6, -0.8])
    np.testing.assert_allclose(seen.rgb, expected, atol=2e-5)
    np.testing.assert_allclose(seen.accumulation, 1.0, atol=1e-6)
    # From (0, 0.9, -0.2), the path goes down to the wall at -7.5.
    wall = 3.5 + 7.3
    if fog == 0.0:
        np.testing.assert_allclose([seen.median, seen.mean], wall, rtol=1e-5)
    if fog == 1e6:
        np.testing.assert_allclose(seen.median, 2.0, atol=0.1)


@pytest.mark.parametrize("fog", [0.0, 0.8, 1e6])
def test_paths_beside_the_objects_see_nothing_but_the_backdrop(plant, fog):
    seen = plant(_INSIDE, _straight(), fog)
    np.testing.assert_allclose(seen.composite.rgb, _GREY, atol=1e-6)
    np.testing.assert_allclose(seen.composite.median, 10.5, rtol=1e-5)
    np.testing.assert_allclose(seen.histograms[-1].weights, 0.0)


@pytest.mark.parametrize("fog", [0.0, 0.8, 30.0, 1e6])
def test_a_field_in_a_ball_dims_light_beside_the_objects(plant, monkeypatch, fog):
    monkeypatch.setitem(_HULLS, _IN_BALL, jnp.ones((2, 2, 2)))
    seen = plant(_IN_BALL, _straight(), fog).composite
    passed = np.exp(-fog * 4.0 / MODEL.radius)
    expected = passed * _GREY + (1.0 - passed) * np.array([0.0, 0.0, -1.0])
    np.testing.assert_allclose(seen.rgb, expected, atol=2e-5)
    if fog == 1e6:
        np.testing.assert_allclose(seen.median, 1.0, atol=0.1)


def test_a_field_in_a_ball_is_empty_where_masks_show_nothing_but_inside_objects(plant):
    def depth(path):
        seen = plant(_IN_BALL, path, 0.8)
        return -np.log(seen.composite.rgb[0] / _GREY) * MODEL.radius / 0.8

    interval = 4.0 / MODEL.samples
    np.testing.assert_allclose(depth(_straight()), 2.0, atol=interval)  # from z = 2 to z = 0
    ways = [(0, 0, -1)] * 3
    inside = made_paths.path([3.0, 2.0], ways, [0, 1, 0], origin=(0, 0, 3))
    np.testing.assert_allclose(depth(inside), 4.0, rtol=1e-4)  # and on to z = -2


def test_proposals_have_weights_where_masks_show_nothing(plant):
    # The interlevel loss compares them with weights that are blurred beyond the edge of the hull.
    proposed, final = plant(_IN_BALL, _straight(), 0.8).histograms
    assert np.all(np.asarray(proposed.weights) > 0.0)
    np.testing.assert_array_equal(np.asarray(final.weights) > 0.0, final.edges[1:] < 0.6)


def test_a_path_that_ends_on_an_opaque_surface_sees_the_field_there(plant):
    inside = made_paths.path([2.0], [(0, 0, -1), (0, 0.6, -0.8)], [0, 1], origin=(0, 0, 3))
    stopped = inside._replace(stop=Stop(jnp.float32(2.75), None))
    seen = plant(_CLEAR, stopped, 0.8)
    np.testing.assert_allclose(seen.composite.rgb, [0.0, 0.6, -0.8], atol=1e-6)
    np.testing.assert_allclose([seen.composite.median, seen.composite.mean], 2.75, rtol=1e-6)
    assert seen.histograms == ()
    free = inside._replace(stop=Stop(jnp.float32(jnp.inf), None))
    np.testing.assert_allclose(plant(_CLEAR, free, 0.8).composite.rgb, _GREY, atol=1e-6)


def test_opaque_surfaces_in_front_of_an_environment_have_finite_distances(plant):
    sky = dataclasses.replace(_CLEAR, space="unbounded")
    inside = made_paths.path([2.0], [(0, 0, -1), (0, 0.6, -0.8)], [0, 1], origin=(0, 0, 3))
    seen = plant(sky, inside._replace(stop=Stop(jnp.float32(2.75), None)), 0.8).composite
    np.testing.assert_allclose([seen.median, seen.mean], 2.75, rtol=1e-6)
    free = plant(sky, inside._replace(stop=Stop(jnp.float32(jnp.inf), None)), 0.8).composite
    assert np.all(np.isposinf([free.median, free.mean])) and np.all(np.isfinite(free.rgb))


@pytest.mark.slow
@pytest.mark.parametrize("config", [_INSIDE, _IN_BALL], ids=["inside", "in a ball"])
def test_only_the_field_in_front_of_the_backdrop_has_gradients(config):
    paths = jax.tree.map(lambda x: jnp.asarray(x)[None], _bent())
    params = jax.jit(lambda: init_params(jax.random.key(0), config))()
    jitter = pixels.no_jitter(config, 1)

    @jax.jit
    @jax.grad
    def slope(params):
        light = pixels.gather_light(params, config, paths, jitter, rays=1, anneal=_ONE)
        return jnp.sum(light.linear)

    slopes = slope(params)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(slopes))
    assert any(np.any(leaf != 0.0) for leaf in jax.tree.leaves(slopes.field.field))
    fixed = slopes.field[1:]
    assert not any(np.any(leaf != 0.0) for leaf in jax.tree.leaves(fixed))


@pytest.mark.slow
def test_only_given_parts_are_sampled(plant):
    first, second = (dataclasses.replace(_CLEAR, field_parts=parts) for parts in ((0,), (1,)))
    passed = np.exp(-0.8 * 1.5 / MODEL.radius)
    expected = passed * _GREY + (1.0 - passed) * np.array([0.0, 0.6, -0.8])
    np.testing.assert_allclose(plant(first, _bent(), 0.8).composite.rgb, expected, atol=2e-5)
    np.testing.assert_allclose(plant(second, _bent(), 0.8).composite.rgb, _GREY, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("config", [_INSIDE, _IN_BALL], ids=["inside", "in a ball"])
def test_rays_that_meet_no_field_are_left_to_the_backdrop(config):
    glass = refref_jax.single_object(trimesh.creation.icosphere(subdivisions=2), index=1.5)
    params = initial(config)
    if config is _IN_BALL:
        params = params._replace(field=params.field._replace(hull=_HULLS[config]))
    walls = jnp.linspace(0.1, 0.9, surface_of(params)[0].size).reshape(surface_of(params)[0].shape)
    field = params.field._replace(backdrop=(walls, *surface_of(params)[1:]))
    model = Model(config, PATH_PRESETS["tree"], glass, params._replace(field=field))
    rays = image_rays(CAMERAS, 0)
    seen = render_image(model, rays)
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rays)
    render = jax.jit(
        lambda params, scene: render_rays(model._replace(scene=scene, params=params), flat)
    )
    expected = render(model.params, model.scene)
    for ours, theirs in zip(seen, expected, strict=True):
        np.testing.assert_allclose(ours.reshape(theirs.shape), theirs, atol=2e-5)


@pytest.mark.parametrize(
    ("origin", "direction", "meets"),
    [
        ((0, 0, 5), (0, 0, -1), True),
        ((0, 0, 5), (0, 0, 1), False),
        ((0, 0, -1), (0, 0, -1), False),
        ((0, 0, -1), (0, 0, 1), True),
        ((1, 0, 1), (1, 0, 0), True),
        ((5, 0, -1), (-1, 0, 0), False),
        ((5, 3, 1), (-1, 0, 0), False),
    ],
)
def test_rays_meet_cells_in_front_of_them(origin, direction, meets):
    ray = Rays(*(jnp.asarray(x, jnp.float32) for x in (origin, direction)), jnp.float32(1e-3))
    grid = scene_bounds.OccupancyGrid(_HULLS[_IN_BALL], _IN_BALL.backdrop.field_ball)
    assert bool(scene_bounds.meets_occupied(grid, ray)) is meets
